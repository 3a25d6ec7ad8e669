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
"""Where collecting and learning meet: a bounded store of segments, and the pace at which both sides may
go."""

from __future__ import annotations

from accerl_lerobot.replay.buffer import Replay, ReplayCounters
from accerl_lerobot.replay.mixed import MixedReplay
from accerl_lerobot.replay.pacing import (
    Pace,
    ReplayConfig,
    decisions_under_way,
    lag_bound,
    may_insert,
    may_sample,
)

__all__ = [
    "MixedReplay",
    "Pace",
    "Replay",
    "ReplayConfig",
    "ReplayCounters",
    "decisions_under_way",
    "lag_bound",
    "may_insert",
    "may_sample",
]
