# SPDX-License-Identifier: Apache-2.0
"""A run's timeline as rows of intervals, and how its workers' time divides among the states.

``accerl timeline`` writes it as a Chrome trace, which https://ui.perfetto.dev shows.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from accerl_lerobot.checkpoint.safety import FileSource, brief, check_folder
from accerl_lerobot.config.ranges import Section
from accerl_lerobot.errors import InputError, check_output, expanded, reading
from accerl_lerobot.timeline import (
    BITS,
    CHECKPOINT,
    FORMAT,
    ROLES,
    STATES,
    SUFFIX,
    TIMELINE,
    TRAINING,
    role_of,
)

TRACE = "timeline.json"
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
        first, last = 1e9 * np.array(window)
        overlap = np.minimum(self.ends, last) - np.maximum(self.starts, first)
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
        """When the driver trained, checkpoints on the way included, for each start; all if it never did."""
        windows: list[Window] = []
        for row in self.rows:
            if row.role == "driver":
                windows += _training_windows(row)
        return windows or [(0.0, self.seconds)]

    def shares(self, windows: Sequence[Window] = ()) -> Shares:
        """How the time of each role divides in `windows`, as far as it is kept; empty: in all of it."""
        spent: dict[str, np.ndarray] = {}
        for row in self.rows:
            for window in windows or [(0.0, self.seconds)]:
                spent[row.role] = spent.get(row.role, 0) + row.spent(window)
        shares: Shares = {}
        for role, times in spent.items():
            whole = times.sum()
            if whole > 0:
                shares[role] = {STATES[i]: float(times[i] / whole) for i in np.flatnonzero(times)}
        return shares


def _training_windows(driver: Row) -> list[Window]:
    windows: list[Window] = []
    trains = False
    for start, end, state in zip(driver.starts / 1e9, driver.ends / 1e9, driver.states, strict=True):
        if state == TRAINING:
            first = windows.pop()[0] if trains else float(start)
            windows.append((first, float(end)))
            trains = True
        elif state != CHECKPOINT:
            trains = False
    return windows


def read_timeline(run_directory: Path) -> Timeline:
    """Reads what the workers of a run have left, on the axis of the calendar.

    Raises:
        InputError: there is none, or a file of it is damaged.
    """
    check_folder(run_directory, FileSource("runs", str(run_directory)))
    parts = read_parts(run_directory / TIMELINE)
    if not parts:
        hint = "no timeline in it: it is no run of accerl train, or no worker has begun"
        raise InputError("runs", str(run_directory), hint)
    with reading("runs", str(run_directory), f"a file of {TIMELINE}/"):
        began = min(int(part.starts[0]) for part in parts)
        workers: dict[str, list[Row]] = {}
        for part in parts:
            workers.setdefault(part.worker, []).append(part)
        rows = [_whole_row(own, began) for own in workers.values()]
        return Timeline(run=run_directory, rows=tuple(sorted(rows, key=_place)))


def read_parts(folder: Path) -> list[Row]:
    """Every file of a timeline with an interval in it, by the nanoseconds of the calendar."""
    parts = []
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        with contextlib.suppress(FileNotFoundError):  # its worker has begun another part meanwhile
            head, newline, data = path.read_bytes().partition(b"\n")
            if newline and len(data) >= 8:
                parts.append(_part(path, head, data))
    return parts


def _part(path: Path, head: bytes, data: bytes) -> Row:
    try:
        content = json.loads(head)
        if content["timeline"] != FORMAT:
            raise ValueError(f"format {content['timeline']}, not {FORMAT}")
        entries = np.frombuffer(data[: len(data) // 8 * 8], "<u8")  # a killed process leaves half an entry
        noted = (entries >> np.uint64(BITS)).astype(np.int64)
        times = np.concatenate([np.array([content["at_ns"]], np.int64), noted]) + np.int64(content["wall_ns"])
        states = np.append(STATES.index(content["state"]), entries[:-1] % 2**BITS).astype(np.uint8)
        changes = np.flatnonzero(np.diff(states, prepend=-1))  # beats are none
        ends = np.append(times[changes[1:]], times[-1])
        return Row(worker=str(content["worker"]), starts=times[changes], ends=ends, states=states[changes])
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        why = f"damaged ({brief(error)}); restore it, or remove it"
        raise InputError("runs", str(path), why) from error


def _whole_row(parts: list[Row], began: int) -> Row:
    """All intervals of a worker; one that was being ended when the next process began is cut there."""
    starts = np.concatenate([part.starts for part in parts]) - began
    ends = np.concatenate([part.ends for part in parts]) - began
    states = np.concatenate([part.states for part in parts])
    order = np.argsort(starts, kind="stable")
    cut = np.minimum(ends[order], np.append(starts[order][1:], ends.max()))
    return Row(worker=parts[0].worker, starts=starts[order], ends=cut, states=states[order])


def _place(row: Row) -> tuple[int, int, str]:
    number = row.worker[len(row.role) :].strip()
    return ROLES.index(row.role) if row.role in ROLES else len(ROLES), int(number or 0), row.role


@dataclass(frozen=True, kw_only=True)
class TimelineConfig(Section):
    """Fields of ``accerl timeline``."""

    BARE: ClassVar[str] = "runs"

    runs: tuple[str, ...] = ()
    """Folders of runs of ``accerl train``; several stand below each other in one trace. Bare arguments are
    runs."""
    output: str | None = None
    """The trace. None: ``timeline.json`` in the run's folder, or here if there are several."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.runs:
            raise InputError("runs", "", "name the folder of a run: accerl timeline RUN")


def write_trace(config: TimelineConfig) -> dict[str, Any]:
    """Writes the ``trace``; of the ``runs``, when each trained and its roles' shares of that time."""
    trace = None if config.output is None else expanded(config.output, "output")
    timelines = [read_timeline(expanded(name, "runs")) for name in config.runs]
    if trace is None:
        trace = timelines[0].run / TRACE if len(timelines) == 1 else Path(TRACE)
    check_output(trace)
    runs = []
    with trace.open("w") as file:
        separator = "["
        for number, timeline in enumerate(timelines):
            for event in _events(number, timeline):
                file.write(f"{separator}{json.dumps(event)}")
                separator = ",\n"
            training = timeline.training()
            shares = timeline.shares(training)
            runs.append({"run": str(timeline.run), "training_s": training, "shares": shares})
        file.write("]\n")
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
