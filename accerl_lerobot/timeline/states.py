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
"""The states of a worker, which is in exactly one at any time; see ``docs/performance.md``."""

from __future__ import annotations

from collections.abc import Mapping

STATES = (
    "compute", "wait_in", "wait_out", "transport", "weights", "checkpoint", "recovery", "training",
    "evaluation",
)  # fmt: skip
"""Names, at the numbers that stand for them on disk: append only. The last two are the driver's."""
(COMPUTE, WAIT_IN, WAIT_OUT, TRANSPORT, WEIGHT_SYNC, CHECKPOINT, RECOVERY, TRAINING, EVALUATION) = range(
    len(STATES)
)
ROLES = ("driver", "local", "rollout", "dream", "inference", "replay", "trainer", "world learning")
"""In the order in which they are shown."""
TIMELINE = "timeline"
"""Name of the folder in a run's."""


def role_of(worker: str) -> str:
    """``rollout`` of ``rollout 3``."""
    return worker.rstrip("0123456789").rstrip()


def bubble(shares: Mapping[str, float]) -> float:
    """Share of its time that a worker waits for others, of its shares by state."""
    return shares.get("wait_in", 0.0) + shares.get("wait_out", 0.0)
