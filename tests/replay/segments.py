# SPDX-License-Identifier: Apache-2.0
"""Small segments for the replay tests, and what is so of every store."""

import math
from typing import Any

import numpy as np

from accerl_lerobot.experience import Segment, SegmentStart
from accerl_lerobot.replay.buffer import Replay


def make_segment(key: str, n: int = 4, version: int | list[int] = 0, **replace: Any) -> Segment:
    """A segment of `n` decisions with one state, one latent and two log-prob factors."""
    versions = np.broadcast_to(np.asarray(version, np.int64), (n,)).copy()
    fields: dict[str, Any] = {
        "observations": {"observation.state": np.zeros((n + 1, 2), np.float32)},
        "task": "push",
        "latent": {"x": np.zeros((n, 3), np.float32)},
        "log_prob": np.zeros((n, 2), np.float32),
        "reward": np.ones(n, np.float32),
        "version": versions,
        "actions": np.zeros((n, 1, 1), np.float32),
        "steps": np.ones(n, np.int64),
        "time_limit": 100,
        "origin": SegmentStart("push-v3", seed=0, decision=0),
        "terminated": False,
        "success": False,
        "key": key,
    }
    return Segment(**{**fields, **replace})


def assert_books_balance(replay: Replay) -> None:
    """All that came in is here or gone, and no segment is drawn more often than it may."""
    c, entries = replay.counters, replay._entries
    assert c.inserted_segments == len(entries) + c.removed_segments
    assert c.inserted_decisions == replay.stored_decisions + c.removed_decisions
    assert replay.stored_decisions == sum(len(e.segment) for e in entries)
    assert c.unique_decisions <= c.trained_decisions
    assert replay.stored_decisions <= replay.config.capacity
    assert replay.available_decisions == sum(len(e.segment) for e in entries if e.uses < e.draws)
    assert all(e.uses <= e.draws <= math.ceil(replay.config.samples_per_insert) for e in entries)
