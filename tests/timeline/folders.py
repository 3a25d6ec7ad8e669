# SPDX-License-Identifier: Apache-2.0
"""Timelines that tests choose, a clock that they turn, and what is so of every timeline."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from accerl_lerobot.timeline import TIMELINE, Clock, Row, Timeline

SECOND = 10**9
BEGIN = 10**18  # time of the calendar when a test begins


class Hands:
    """Hands of a clock, which stand still unless a test turns them."""

    def __init__(self, at_s: float) -> None:
        self.now = BEGIN + round(at_s * SECOND)

    def __call__(self) -> int:
        return self.now


def a_clock(run: Path, worker: str = "trainer", *, at_s: float = 0.0) -> tuple[Clock, Hands]:
    """A worker's clock, whose process begins at a second of the calendar, and its hands."""
    hands = Hands(at_s)
    return Clock(run / TIMELINE, worker, hands), hands


def write_worker(run: Path, worker: str, spans: Iterable[tuple[int, float]], *, at_s: float = 0.0) -> None:
    """One process of a worker, to its end; `spans`: states, and how many seconds it was in each."""
    clock, hands = a_clock(run, worker, at_s=at_s)
    for state, length in spans:
        clock.enter(state)
        hands.now += round(length * SECOND)
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
