# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
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
