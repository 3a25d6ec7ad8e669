# SPDX-License-Identifier: Apache-2.0
"""Timelines that tests choose, and what is so of every timeline."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from accerl_lerobot.timeline import STATES, TIMELINE, Clock, Row, Timeline

SECOND = 10**9


def write_worker(run: Path, worker: str, spans: Iterable[tuple[str, float]], *, at_s: float = 0.0) -> None:
    """One process of a worker, to its end; `spans`: states, and how many seconds it was in each."""
    now = 10**18 + round(at_s * SECOND)
    clock = Clock(run / TIMELINE, worker, lambda: now)
    for state, length in spans:
        clock.enter(STATES.index(state))
        now += round(length * SECOND)
    clock.close()


def adds_up(timeline: Timeline) -> None:
    """A worker is in one state at a time, and every moment of its processes is in one."""
    for row in timeline.rows:
        whole = int(row.ends[-1] - row.starts[0] - gaps(row).sum())
        assert row.spent((0.0, timeline.seconds + 1.0)).sum() == pytest.approx(whole, rel=1e-9) and whole > 0
    for own in timeline.shares().values():
        assert sum(own.values()) == pytest.approx(1.0)


def gaps(row: Row) -> np.ndarray:
    """Lengths of the times between two processes of a worker."""
    between: np.ndarray = row.starts[1:] - row.ends[:-1]
    assert (between >= 0).all()
    return between[between > 0]
