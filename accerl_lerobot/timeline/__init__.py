# SPDX-License-Identifier: Apache-2.0
"""What every worker of a run did when: recorded by each, read and drawn afterwards."""

from accerl_lerobot.timeline.clock import Clock, NoClock, open_clock
from accerl_lerobot.timeline.states import (
    CHECKPOINT,
    COMPUTE,
    EVALUATION,
    RECOVERY,
    TIMELINE,
    TRAINING,
    TRANSPORT,
    WAIT_IN,
    WAIT_OUT,
    WEIGHT_SYNC,
)

__all__ = [
    "CHECKPOINT", "COMPUTE", "EVALUATION", "RECOVERY", "TIMELINE", "TRAINING", "TRANSPORT", "WAIT_IN",
    "WAIT_OUT", "WEIGHT_SYNC", "Clock", "NoClock", "open_clock",
]  # fmt: skip
