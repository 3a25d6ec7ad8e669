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
"""Timelines that tests choose, and a clock that they turn."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from accerl_lerobot.timeline.clock import Clock
from accerl_lerobot.timeline.parts import Moment, Parts
from accerl_lerobot.timeline.states import TIMELINE

SECOND = 10**9
UP = 10**15
"""What the monotonic clock shows when a test begins; the calendar shows twice that."""


class Hands:
    """A clock's: they stand still unless a test turns them."""

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
    return Clock(Parts(run / TIMELINE, worker, begins, part_bytes), hands), hands


def write_worker(
    run: Path, worker: str, spans: Iterable[tuple[int, float]], *, at_s: float = 0.0, part_bytes: int = 10**6
) -> None:
    """One process of a worker, to its end.

    Args:
        run: folder.
        worker: its name.
        spans: states, and how many seconds it was in each.
        at_s: when it began.
        part_bytes: see `Parts`.
    """
    at = round(at_s * SECOND)
    begins = Moment("here", UP + at, 2 * UP + at)
    clock, hands = a_clock(run, worker, begins=begins, part_bytes=part_bytes)
    for state, length in spans:
        clock.enter(state)
        hands.now += round(length * SECOND)
    clock.close()
