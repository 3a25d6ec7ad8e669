# SPDX-License-Identifier: Apache-2.0
"""The timeline: every worker's activity over time, recorded by each, read and drawn afterwards."""

from accerl_lerobot.timeline.clock import (
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
    Clock,
    NoClock,
    open_clock,
)

__all__ = [
    "CHECKPOINT", "COMPUTE", "EVALUATION", "RECOVERY", "TIMELINE", "TRAINING", "TRANSPORT", "WAIT_IN",
    "WAIT_OUT", "WEIGHT_SYNC", "Clock", "NoClock", "open_clock",
]  # fmt: skip
