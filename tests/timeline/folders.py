# SPDX-License-Identifier: Apache-2.0
"""Timelines that tests choose, and a clock that they turn."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from accerl_lerobot.timeline import TIMELINE, Clock

SECOND = 10**9
UP = 10**15  # the monotonic clock's time when a test begins; the calendar shows twice that


class Hands:
    """Hands of a clock, which stand still unless a test turns them."""

    def __init__(self) -> None:
        self.now = UP

    def __call__(self) -> int:
        return self.now


def a_clock(
    run: Path, worker: str = "trainer", *, at_s: float = 0.0, most_bytes: int = 10**6
) -> tuple[Clock, Hands]:
    """A worker's clock, whose process begins at a second of the calendar, and its hands."""
    hands = Hands()
    wall = 2 * UP + round(at_s * SECOND)
    clock = Clock(run / TIMELINE, worker, most_bytes=most_bytes, now=hands, calendar=lambda: wall)
    return clock, hands


def write_worker(run: Path, worker: str, spans: Iterable[tuple[int, float]], *, at_s: float = 0.0) -> None:
    """One process of a worker, to its end; `spans`: states, and how many seconds it was in each."""
    clock, hands = a_clock(run, worker, at_s=at_s)
    for state, length in spans:
        clock.enter(state)
        hands.now += round(length * SECOND)
    clock.close()
