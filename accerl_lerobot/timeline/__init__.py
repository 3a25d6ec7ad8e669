# SPDX-License-Identifier: Apache-2.0
"""The timeline: every worker records its activity over time, and ``accerl timeline`` shows it.

Entering a state ends the one before, so states exclude each other and their times add up to the time of the
process by construction. Time is that of the monotonic clock; the calendar time at which a process began is
noted too.

``RUN/timeline/rollout-0.1.bin`` is the second process (1) of ``rollout 0``: a line of JSON, then 8 bytes per
entry, nanoseconds since the process began << 4 | state, little-endian. A killed process leaves at worst half
an entry, which is not read. A process records its first two million entries.

The result is a Chrome trace, which https://ui.perfetto.dev shows, and the shares of each role's time.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from accerl_lerobot.checkpoint.safety import FileSource, check_folder
from accerl_lerobot.config.ranges import RunsConfig
from accerl_lerobot.errors import InputError, expanded
from accerl_lerobot.fault_points import fault_point

STATES = (
    "compute", "wait_in", "wait_out", "transport", "weights", "checkpoint", "recovery", "training",
    "evaluation",
)  # fmt: skip
"""Names, at the numbers that stand for them on disk: append only. The last two are the driver's."""
COMPUTE, WAIT_IN, WAIT_OUT, TRANSPORT, WEIGHT_SYNC, CHECKPOINT, RECOVERY, TRAINING, EVALUATION = range(9)
ROLES = (
    "driver", "local", "rollout", "inference", "replay", "trainer", "world model", "world-model learning",
)  # fmt: skip
TIMELINE = "timeline"
TRACE = "timeline.json"
SUFFIX = ".bin"
BITS = 4
FLUSH_NS = 1_000_000_000
"""An entry is on its way to the disk after so long, if another follows or `Clock.beat` is called."""
MOST_BYTES = 16_000_000


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
        most_bytes: int = MOST_BYTES,
        now: Callable[[], int] = time.monotonic_ns,
        calendar: Callable[[], int] = time.time_ns,
    ) -> None:
        self._now = now
        self._most_bytes = most_bytes
        self._lock = threading.Lock()
        self._state = RECOVERY
        self._began = now()
        self._flushed = self._began
        self._point = f"{role_of(worker).split()[-1]}.timeline"
        folder.mkdir(parents=True, exist_ok=True)
        name = worker.replace(" ", "-")
        earlier = len(list(folder.glob(f"{name}.*{SUFFIX}")))
        self._file = (folder / f"{name}.{earlier}{SUFFIX}").open("xb")
        head = {"worker": worker, "pid": os.getpid(), "wall_ns": calendar()}
        self._file.write(json.dumps(head).encode() + b"\n")
        self._file.flush()

    def enter(self, state: int) -> None:
        """Ends the state before, unless it is the same."""
        if state != self._state:
            with self._lock:
                self._note(state)

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
            self._note(self._state, flush=True)

    def close(self) -> None:
        if not self._file.closed:
            self.beat()
            self._file.close()

    def _note(self, state: int, *, flush: bool = False) -> None:
        self._state = state
        if self._file.tell() >= self._most_bytes:
            return
        now = self._now()
        self._file.write(((now - self._began) << BITS | state).to_bytes(8, "little"))
        if flush or now - self._flushed >= FLUSH_NS:
            fault_point(self._point)
            self._file.flush()  # from here on the entries survive this process
            self._flushed = now


class NoClock(Clock):
    """Records nothing: of runs without a timeline."""

    def __init__(self) -> None:
        self._state = RECOVERY

    def enter(self, state: int) -> None: ...

    def beat(self) -> None: ...

    def close(self) -> None: ...


def open_clock(folder: Path | None, worker: str) -> Clock:
    """The clock of a worker; one that records nothing where there is no folder of the timeline."""
    if folder is None:
        return NoClock()
    return Clock(folder, worker)


Window = tuple[float, float]  # first and last second, since the timeline began
Shares = dict[str, dict[str, float]]
"""Role → state → share of the time of its workers; states with no time are left out."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One worker, all processes that it has been; between two of them there is a gap."""

    worker: str
    starts: np.ndarray  # int64 (n,), of each interval, nanoseconds since the timeline began
    ends: np.ndarray  # int64 (n,)
    states: np.ndarray  # uint8 (n,)

    @property
    def role(self) -> str:
        return role_of(self.worker)

    def spent(self, window: Window) -> np.ndarray:
        """float64 (states,): nanoseconds in each state within `window`."""
        first, last = window
        overlap = np.minimum(self.ends, 1e9 * last) - np.maximum(self.starts, 1e9 * first)
        return np.bincount(self.states, np.maximum(overlap, 0), len(STATES))


@dataclass(frozen=True, kw_only=True)
class Timeline:
    """Activity of a run's workers over time."""

    run: Path
    rows: tuple[Row, ...]

    @property
    def seconds(self) -> float:
        """From the beginning of the first worker to the end of the last."""
        return max(int(row.ends[-1]) for row in self.rows) / 1e9

    def training(self) -> list[Window]:
        """When the driver trained, checkpoints on the way included; all of the time if it never did."""
        windows: list[Window] = []
        for row in self.rows:
            if row.role != "driver":
                continue
            follows = False  # an interval of training, or a checkpoint after it
            for start, end, state in zip(row.starts / 1e9, row.ends / 1e9, row.states, strict=True):
                if state == TRAINING:
                    first = float(start)
                    if follows:
                        first, _ = windows.pop()
                    windows.append((first, float(end)))
                follows = state == TRAINING or (follows and state == CHECKPOINT)
        return windows or [(0.0, self.seconds)]

    def shares(self, windows: Sequence[Window] = ()) -> Shares:
        """How the time of each role divides in `windows`, as far as it is kept; empty: in all of it."""
        times: dict[str, np.ndarray] = {}
        for row in self.rows:
            for window in windows or [(0.0, self.seconds)]:
                times[row.role] = times.get(row.role, np.zeros(len(STATES))) + row.spent(window)
        shares: Shares = {}
        for role, spent in times.items():
            if spent.any():
                share = spent / spent.sum()
                shares[role] = {STATES[state]: float(share[state]) for state in np.flatnonzero(spent)}
        return shares


def read_timeline(run_directory: Path) -> Timeline:
    """Reads what the workers of a run have left, on the axis of the calendar.

    Raises:
        InputError: there is none.
    """
    check_folder(run_directory, FileSource("runs", str(run_directory)))
    processes: dict[str, list[Row]] = {}
    for path in sorted((run_directory / TIMELINE).glob(f"*{SUFFIX}")):
        row = _read_process(path)
        if len(row.states):
            processes.setdefault(row.worker, []).append(row)
    if not processes:
        hint = "no timeline in it: it is no run of accerl train, or no worker has begun"
        raise InputError("runs", str(run_directory), hint)
    rows = sorted(map(_whole_row, processes.values()), key=_place)
    began = min(int(row.starts[0]) for row in rows)
    since_began = [replace(row, starts=row.starts - began, ends=row.ends - began) for row in rows]
    return Timeline(run=run_directory, rows=tuple(since_began))


def _read_process(path: Path) -> Row:
    """The intervals of one process, by the nanoseconds of the calendar."""
    head, _, data = path.read_bytes().partition(b"\n")
    content = json.loads(head)
    began = content["wall_ns"]
    count = len(data) // 8  # a killed process leaves half an entry
    entries = np.frombuffer(data, "<u8", count)
    ends = (entries >> BITS).astype(np.int64) + began
    starts = np.append(began, ends[:-1])[:count]
    states = np.append(RECOVERY, entries % 2**BITS)[:count].astype(np.uint8)
    return Row(worker=content["worker"], starts=starts, ends=ends, states=states)


def _whole_row(processes: list[Row]) -> Row:
    """All intervals of a worker; one that was being ended when the next process began is cut there."""
    starts = np.concatenate([row.starts for row in processes])
    order = np.argsort(starts, kind="stable")
    starts = starts[order]
    ends = np.concatenate([row.ends for row in processes])[order]
    states = np.concatenate([row.states for row in processes])[order]
    next_starts = np.append(starts[1:], ends.max())
    ends = np.minimum(ends, next_starts)
    return Row(worker=processes[0].worker, starts=starts, ends=ends, states=states)


def _place(row: Row) -> tuple[int, str, int]:
    """Where the row stands: by role, then by number."""
    number = row.worker.removeprefix(row.role).strip()
    place = len(ROLES)
    if row.role in ROLES:
        place = ROLES.index(row.role)
    return place, row.role, int(number or 0)


@dataclass(frozen=True, kw_only=True)
class TimelineConfig(RunsConfig):
    """Fields of ``accerl timeline``."""


def write_trace(config: TimelineConfig) -> dict[str, Any]:
    """Writes the ``trace``; of the ``runs``, when each trained and its roles' shares of that time."""
    trace = config.file(TRACE)
    timelines = [read_timeline(expanded(name, "runs")) for name in config.runs]
    runs = []
    events: list[dict[str, Any]] = []
    for number, timeline in enumerate(timelines):
        events += _events(number, timeline)
        training = timeline.training()
        runs.append({"run": str(timeline.run), "training_s": training, "shares": timeline.shares(training)})
    trace.write_text(json.dumps(events))
    return {"trace": str(trace), "runs": runs}


def _events(number: int, timeline: Timeline) -> Iterator[dict[str, Any]]:
    """A run as a process of a Chrome trace, a worker as its thread."""
    process = {"pid": number, "ph": "M"}
    yield process | {"name": "process_name", "args": {"name": timeline.run.resolve().name}}
    for place, row in enumerate(timeline.rows):
        thread = {"pid": number, "tid": place}
        yield thread | {"ph": "M", "name": "thread_name", "args": {"name": row.worker}}
        yield thread | {"ph": "M", "name": "thread_sort_index", "args": {"sort_index": place}}
        for start, end, state in zip(row.starts, row.ends, row.states, strict=True):
            span = {"ts": start / 1000, "dur": (end - start) / 1000}  # microseconds
            yield thread | {"ph": "X", "name": STATES[state]} | span
