# SPDX-License-Identifier: Apache-2.0
"""The timeline: every worker records its activity over time, and ``accerl timeline`` shows it.

Entering a state ends the one before, so states exclude each other and their times add up to the time of the
process by construction.

``RUN/timeline/rollout 0.1.states`` is the second process (1) of ``rollout 0``. Each `ENTRY` has a time and
the state that begins then. A killed process leaves at worst half an entry, which is not read. A process
records its first 1.8 million entries.

The result is a Chrome trace, which https://ui.perfetto.dev shows, and the shares of each role's time.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
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
SUFFIX = ".states"
ENTRY = np.dtype([("ns", "<i8"), ("state", "u1")])
"""Nanoseconds of the calendar, and a number in `STATES`."""
FLUSH_NS = 1_000_000_000
"""An entry is on its way to the disk after so long, if another follows or `Clock.beat` is called."""
MOST_BYTES = 16_000_000


_MONOTONIC_BEGAN = time.time_ns() - time.monotonic_ns()


def calendar_ns() -> int:
    """Nanoseconds of the calendar, which never go back in this process."""
    return _MONOTONIC_BEGAN + time.monotonic_ns()


def role_of(worker: str) -> str:
    """``rollout`` of ``rollout 3``."""
    return worker.rstrip("0123456789").rstrip()


class Clock:
    """One worker's recorder; begins in the state `RECOVERY`, which is to get ready for work.

    States are entered from one thread; `beat`, from any, writes entries so far, up to now. The part of
    `worker` before a number is its role.
    """

    def __init__(self, folder: Path, worker: str, now: Callable[[], int] = calendar_ns) -> None:
        self._now = now
        self._lock = threading.Lock()
        self._flushed = now()
        self._point = f"{role_of(worker).split()[-1]}.timeline"
        folder.mkdir(parents=True, exist_ok=True)
        earlier = len(list(folder.glob(f"{worker}.*{SUFFIX}")))
        self._file = (folder / f"{worker}.{earlier}{SUFFIX}").open("xb")
        self._note(RECOVERY, flush=True)

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
        if self._file.tell() >= MOST_BYTES:
            return
        now = self._now()
        self._file.write(np.array((now, state), ENTRY).tobytes())
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

    def training(self) -> Window:
        """From the begin of the driver's first training to the end of its last; all if it never trained."""
        for row in self.rows:
            times = np.flatnonzero(row.states == TRAINING)
            if len(times):
                return float(row.starts[times[0]]) / 1e9, float(row.ends[times[-1]]) / 1e9
        return 0.0, self.seconds

    def shares(self, window: Window | None = None) -> Shares:
        """How the time of each role divides in `window`, as far as it is kept; None: in all of it."""
        times: dict[str, np.ndarray] = {}
        for row in self.rows:
            spent = row.spent(window or (0.0, self.seconds))
            times[row.role] = times.get(row.role, 0.0) + spent
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
    processes: dict[str, list[np.ndarray]] = {}
    for path in (run_directory / TIMELINE).glob(f"*{SUFFIX}"):
        entries = np.fromfile(path, ENTRY)
        if len(entries) > 1:
            worker, _, _ = path.name.partition(".")
            processes.setdefault(worker, []).append(entries)
    if not processes:
        hint = "no timeline in it: it is no run of accerl train, or no worker has begun"
        raise InputError("runs", str(run_directory), hint)
    began = min(int(entries["ns"][0]) for all_entries in processes.values() for entries in all_entries)
    rows = [_row(worker, all_entries, began) for worker, all_entries in processes.items()]
    return Timeline(run=run_directory, rows=tuple(sorted(rows, key=_place)))


def _row(worker: str, processes: list[np.ndarray], began: int) -> Row:
    """All intervals of a worker; one that was being ended when the next process began is cut there."""
    starts = np.concatenate([entries["ns"][:-1] for entries in processes]) - began
    ends = np.concatenate([entries["ns"][1:] for entries in processes]) - began
    states = np.concatenate([entries["state"][:-1] for entries in processes])
    order = np.argsort(starts, kind="stable")
    starts = starts[order]
    next_starts = np.append(starts[1:], ends.max())
    return Row(worker=worker, starts=starts, ends=np.minimum(ends[order], next_starts), states=states[order])


def _place(row: Row) -> tuple[int, int]:
    """Where the row stands: by role, then by number."""
    number = row.worker.removeprefix(row.role).strip()
    return ROLES.index(row.role), int(number or 0)


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
