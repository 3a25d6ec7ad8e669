# SPDX-License-Identifier: Apache-2.0
"""The timeline: every worker's activity over time, recorded by each, and read afterwards.

Entering a state ends the one before, so states exclude each other and their times add up to the time of the
process by construction. Time is that of the monotonic clock; the calendar time at which a process began is
noted too.

``RUN/timeline/rollout-0.1.3.bin`` is part 3 of the second process (1) of ``rollout 0``: a line of JSON, then
8 bytes per entry, nanoseconds since the process began << 4 | state, little-endian. The newest two parts are
kept. Nothing is overwritten: a killed process leaves at worst half an entry, which is not read.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from accerl_lerobot.fault_points import fault_point

STATES = (
    "compute", "wait_in", "wait_out", "transport", "weights", "checkpoint", "recovery", "training",
    "evaluation",
)  # fmt: skip
"""Names, at the numbers that stand for them on disk: append only. The last two are the driver's."""
(COMPUTE, WAIT_IN, WAIT_OUT, TRANSPORT, WEIGHT_SYNC, CHECKPOINT, RECOVERY, TRAINING, EVALUATION) = range(
    len(STATES)
)
ROLES = (
    "driver",
    "local",
    "rollout",
    "inference",
    "replay",
    "trainer",
    "world model",
    "world-model learning",
)
TIMELINE = "timeline"
FORMAT = 1
BITS = 4
FLUSH_NS = 1_000_000_000
"""An entry is on its way to the disk after so long, if another follows or `Clock.beat` is called."""
PART_BYTES = 4_000_000
SUFFIX = ".bin"


def role_of(worker: str) -> str:
    """``rollout`` of ``rollout 3``."""
    return worker.rstrip("0123456789").rstrip()


class Clock:
    """One worker's recorder; begins in the state `RECOVERY`, which is to get ready for work.

    States are entered from one thread; `beat`, from any, writes entries so far, up to now. The part of
    `worker` before a number is its role.
    """

    def __init__(
        self,
        folder: Path,
        worker: str,
        *,
        part_bytes: int = PART_BYTES,
        now: Callable[[], int] = time.monotonic_ns,
        calendar: Callable[[], int] = time.time_ns,
    ) -> None:
        self._now = now
        self._lock = threading.Lock()
        self._state = RECOVERY
        self._origin = self._since = now()
        self._due = self._origin + FLUSH_NS
        self._head = {"timeline": FORMAT, "worker": worker, "pid": os.getpid(), "wall_ns": calendar()}
        self._point = f"{role_of(worker).split()[-1]}.timeline"
        folder.mkdir(parents=True, exist_ok=True)
        slug = worker.replace(" ", "-")
        earlier = [int(path.name.split(".")[1]) for path in folder.glob(f"{slug}.*.*{SUFFIX}")]
        self._stem = folder / f"{slug}.{max(earlier, default=-1) + 1}"
        self._part = -1
        self._part_bytes = part_bytes
        self._file = self._next_part()

    def enter(self, state: int) -> None:
        """Ends the state before, unless it is the same."""
        if state != self._state:
            with self._lock:
                self._note(state)
                if self._since >= self._due:
                    self._flush()

    @contextmanager
    def during(self, state: int) -> Iterator[None]:
        before = self._state
        self.enter(state)
        try:
            yield
        finally:
            self.enter(before)

    def beat(self) -> None:
        """Notes that the worker is still in its state, and writes all entries."""
        with self._lock:
            self._note(self._state)
            self._flush()

    def close(self) -> None:
        if not self._file.closed:
            self.beat()
            self._file.close()

    def _note(self, state: int) -> None:
        now = self._now()
        self._file.write(((now - self._origin) << BITS | state).to_bytes(8, "little"))
        self._state = state
        self._since = now

    def _flush(self) -> None:
        fault_point(self._point)
        self._file.flush()  # from here on the entries survive this process
        self._due = self._since + FLUSH_NS
        if self._file.tell() >= self._part_bytes:
            self._file.close()
            self._file = self._next_part()

    def _next_part(self) -> BinaryIO:
        self._part += 1
        head = {**self._head, "at_ns": self._since - self._origin, "state": STATES[self._state]}
        file = self._path(self._part).open("xb")
        file.write((json.dumps(head) + "\n").encode())
        file.flush()
        self._path(self._part - 2).unlink(missing_ok=True)  # the newest two are kept
        return file

    def _path(self, part: int) -> Path:
        return self._stem.with_name(f"{self._stem.name}.{part}{SUFFIX}")


class NoClock(Clock):
    """Records nothing: of runs without a timeline."""

    def __init__(self) -> None:
        self._state = RECOVERY

    def enter(self, state: int) -> None: ...

    def beat(self) -> None: ...

    def close(self) -> None: ...


def open_clock(folder: Path | None, worker: str) -> Clock:
    """The clock of a worker; one that records nothing where there is no folder of the timeline."""
    return NoClock() if folder is None else Clock(folder, worker)
