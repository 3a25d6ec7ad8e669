# SPDX-License-Identifier: Apache-2.0
"""Says what a worker does, at the moment it begins to: the recorder of the timeline.

Entering a state ends the one before, so states exclude each other and their times add up to the time of the
process by construction. Time is that of the monotonic clock, which processes of one machine share; what it
was by the calendar when a process began is noted, for others. An entry is about a microsecond, as
`benchmarks/timeline.py` measures.
"""

from __future__ import annotations

import threading
import time
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from accerl_lerobot.timeline.parts import BITS, Parts
from accerl_lerobot.timeline.states import RECOVERY, STATES

BATCH = 512
"""Entries that are written at once."""
FLUSH_NS = 1_000_000_000
"""An entry is on its way to the disk after so long, if another follows or `Clock.beat` is called."""


class Clock:
    """One worker's recorder; begins in the state `RECOVERY`, which is to get ready for work.

    Example:
        >>> clock = open_clock(folder, "trainer")
        >>> clock.enter(WAIT_IN)         # from one thread
        >>> clock.beat()                 # from any: what is not written yet is, up to now
        >>> clock.totals_ns()["wait_in"]

    Args:
        parts: where entries are kept.
        now: the monotonic clock, in nanoseconds.
    """

    def __init__(self, parts: Parts, now: Callable[[], int] = time.monotonic_ns) -> None:
        self._parts, self._now = parts, now
        self._lock = threading.Lock()
        self._state, self._origin = RECOVERY, parts.clock_ns
        self._since, self._due = self._origin, self._origin + FLUSH_NS
        self._totals = [0] * len(STATES)
        self._entries = array("Q")

    def enter(self, state: int) -> None:
        """Ends the state before, unless it is the same."""
        if state != self._state:
            with self._lock:
                self._note(state)
                if len(self._entries) >= BATCH or self._since >= self._due:
                    self._write()

    @contextmanager
    def during(self, state: int) -> Iterator[None]:
        """Is in a state for a while, and then in the one before again."""
        before = self._state
        self.enter(state)
        try:
            yield
        finally:
            self.enter(before)

    def beat(self) -> None:
        """Notes that the worker is still at it, and writes what has not been written."""
        with self._lock:
            self._note(self._state)
            self._write()

    def totals_ns(self) -> dict[str, int]:
        """Nanoseconds in each state, up to the last entry or beat."""
        with self._lock:
            return dict(zip(STATES, self._totals, strict=True))

    def close(self) -> None:
        """Ends the timeline of this worker; safe to call twice."""
        if not self._parts.closed:
            self.beat()
            self._parts.close()

    def _note(self, state: int) -> None:
        now = self._now()
        self._totals[self._state] += now - self._since
        self._entries.append((now - self._origin) << BITS | state)
        self._state, self._since = state, now

    def _write(self) -> None:
        entries, self._entries = self._entries, array("Q")
        self._parts.write(entries, self._since - self._origin, self._state, self._totals)
        self._due = self._since + FLUSH_NS


class NoClock(Clock):
    """Records nothing: of runs without a timeline."""

    def __init__(self) -> None:
        self._state = RECOVERY

    def enter(self, state: int) -> None:
        pass

    def beat(self) -> None:
        pass

    def totals_ns(self) -> dict[str, int]:
        return {}

    def close(self) -> None:
        pass


def open_clock(folder: Path | None, worker: str) -> Clock:
    """The clock of a worker, beside those that it had before.

    Args:
        folder: of the timeline; made if it is not there. None: nothing is recorded.
        worker: its name; what stands before a number in it is its role.
    """
    return NoClock() if folder is None else Clock(Parts(folder, worker))
