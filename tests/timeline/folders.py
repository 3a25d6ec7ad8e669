# SPDX-License-Identifier: Apache-2.0
"""Timelines that tests choose, and a clock that they turn."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from accerl_lerobot.timeline import TIMELINE, Clock, Moment

SECOND = 10**9
UP = 10**15  # the monotonic clock's time when a test begins; the calendar shows twice that


class Hands:
    """Hands of a clock, which stand still unless a test turns them."""

    def __init__(self, now: int = UP) -> None:
        self.now = now

    def __call__(self) -> int:
        return self.now


def a_clock(
    run: Path, worker: str = "trainer", *, begins: Moment | None = None, part_bytes: int = 10**6
) -> tuple[Clock, Hands]:
    """A worker's clock, and its hands."""
    begins = begins or Moment("here", UP, 2 * UP)
    hands = Hands(begins.clock_ns)
    return Clock(run / TIMELINE, worker, begins=begins, part_bytes=part_bytes, now=hands), hands


def write_worker(run: Path, worker: str, spans: Iterable[tuple[int, float]], *, at_s: float = 0.0) -> None:
    """One process of a worker, to its end; `spans`: states, and how many seconds it was in each."""
    at = round(at_s * SECOND)
    begins = Moment("here", UP + at, 2 * UP + at)
    clock, hands = a_clock(run, worker, begins=begins)
    for state, length in spans:
        clock.enter(state)
        hands.now += round(length * SECOND)
    clock.close()
