# SPDX-License-Identifier: Apache-2.0
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
ROLES = ("driver", "local", "rollout", "imagination", "inference", "replay", "trainer", "world learning")
"""In the order in which they are shown."""
TIMELINE = "timeline"
"""Name of the folder in a run's."""


def role_of(worker: str) -> str:
    """``rollout`` of ``rollout 3``."""
    return worker.rstrip("0123456789").rstrip()


def bubble(shares: Mapping[str, float]) -> float:
    """Share of its time that a worker waits for others, of its shares by state."""
    return shares.get("wait_in", 0.0) + shares.get("wait_out", 0.0)
