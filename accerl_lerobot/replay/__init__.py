# SPDX-License-Identifier: Apache-2.0
"""Where collecting and learning meet: a bounded store of segments, and the pace at which both sides may
go."""

from __future__ import annotations

from accerl_lerobot.replay.buffer import MixedReplay, Replay, ReplayCounters
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
