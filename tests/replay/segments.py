# SPDX-License-Identifier: Apache-2.0
"""Small segments for the replay tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from accerl_lerobot.experience import Origin, Segment


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
        "origin": Origin("push-v3", seed=0, decision=0),
        "terminated": False,
        "success": False,
        "key": key,
    }
    return Segment(**{**fields, **replace})
