# SPDX-License-Identifier: Apache-2.0
"""A run's timeline as rows of intervals, and how its workers' time divides among the states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from accerl_lerobot.checkpoint.layout import CONFIG
from accerl_lerobot.checkpoint.safety import Origin, check_folder
from accerl_lerobot.errors import InputError
from accerl_lerobot.timeline.parts import Section, read_sections
from accerl_lerobot.timeline.states import CHECKPOINT, ROLES, STATES, TIMELINE, TRAINING, role_of

ABSENT = len(STATES)
"""State of a worker of which there is no process, or whose older entries are not kept."""
Window = tuple[float, float]
"""First and last second, since the timeline began."""
Shares = dict[str, dict[str, float]]
"""Role → state → share of the time of its workers; states that they have not been in are left out."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One worker, all processes that it has been."""

    worker: str
    times: np.ndarray
    """int64 (n + 1,), nanoseconds since the timeline began; n intervals lie between them."""
    states: np.ndarray
    """uint8 (n,), of each interval."""
    older_ns: np.ndarray
    """int64 (states,), time in each state before what is kept."""
    kept_from: int
    """Nothing after this is missing."""

    @property
    def role(self) -> str:
        """Part of its name before the number."""
        return role_of(self.worker)

    def until(self, at: np.ndarray) -> np.ndarray:
        """Time in each state up to so many nanoseconds since the timeline began, of what is kept.

        Args:
            at: (m,).

        Returns:
            float64 (m, states).
        """
        spent = np.diff(self.times)
        found = np.empty((len(at), len(STATES)))
        for state in range(len(STATES)):
            so_far = np.concatenate([[0], np.cumsum(np.where(self.states == state, spent, 0))])
            found[:, state] = np.interp(at, self.times, so_far)
        return found


@dataclass(frozen=True, kw_only=True)
class Timeline:
    """Activity of a run's workers over time."""

    run: Path
    rows: tuple[Row, ...]
    """By role, then by number."""

    @property
    def seconds(self) -> float:
        """From the beginning of the first worker to the end of the last."""
        return max(int(row.times[-1]) for row in self.rows) / 1e9

    def training(self) -> list[Window]:
        """When the driver trained, checkpoints on the way included, for each start; all if it never did."""
        found: list[Window] = []
        for row in self.rows:
            if row.role == "driver":
                learns = np.isin(row.states, (TRAINING, CHECKPOINT))
                ends = np.flatnonzero(np.diff(learns, prepend=False, append=False)).reshape(-1, 2)
                found += [
                    (float(row.times[first]) / 1e9, float(row.times[last]) / 1e9)
                    for first, last in ends
                    if (row.states[first:last] == TRAINING).any()
                ]
        return found or [(0.0, self.seconds)]

    def shares(self, windows: Sequence[Window] | None = None) -> Shares:
        """How the time of each role divides.

        Args:
            windows: of which parts, of what is kept of them; None: all, exactly.
        """
        spent: dict[str, np.ndarray] = {}
        for row in self.rows:
            if windows is None:
                own = row.older_ns + row.until(row.times[-1:])[0]
            else:
                own = np.diff(row.until(1e9 * np.ravel(windows)), axis=0)[::2].sum(axis=0)
            spent[row.role] = spent.get(row.role, 0) + own
        return {role: divided(own) for role, own in spent.items() if own.sum() > 0}


def divided(spent: np.ndarray) -> dict[str, float]:
    """Shares by state, of time in each."""
    return {STATES[i]: float(spent[i] / spent.sum()) for i in np.flatnonzero(spent)}


def shares(
    run_directory: Path, start_s: float | None = None, seconds: float | None = None, *, training: bool = False
) -> Shares:
    """How the time of each role of a run divides among the states; `states.bubble` adds up the waiting.

    Args:
        run_directory: the run's folder.
        start_s: where to begin, in seconds since the timeline began; None: at its beginning.
        seconds: how long; None: to the end.
        training: only what lies within the training, if the driver has recorded any. What is too old to be
            kept is missing, as in any window.

    Raises:
        InputError: there is no timeline, it is damaged, or the window is not within it.
    """
    timeline = read_timeline(run_directory)
    if start_s is None and seconds is None and not training:
        return timeline.shares()
    start, end = window_of(timeline, start_s, seconds)
    windows = timeline.training() if training else [(start, end)]
    within = [(max(start, first), min(end, last)) for first, last in windows if start < last and first < end]
    if not within:
        when = " and ".join(f"{first:.1f} to {last:.1f}" for first, last in windows)
        raise InputError("start_s", start_s, f"the training of {run_directory} is from {when}")
    return timeline.shares(within)


def window_of(timeline: Timeline, start_s: float | None, seconds: float | None) -> Window:
    """The part of a timeline that is asked for.

    Raises:
        InputError: it is not within the run.
    """
    whole = timeline.seconds
    start = 0.0 if start_s is None else start_s
    if not 0 <= start < whole:
        remedy = f"use 0 or more, below {whole:.1f}, the seconds of {timeline.run}"
        raise InputError("start_s", start_s, remedy)
    if seconds is not None and not 0 < seconds < float("inf"):
        raise InputError("seconds", seconds, "use a positive number of seconds")
    return start, whole if seconds is None else min(whole, start + seconds)


def read_timeline(run_directory: Path) -> Timeline:
    """Reads what the workers of a run have left.

    Raises:
        InputError: it is no run, has no timeline, or this is damaged.
    """
    folder = run_directory / TIMELINE
    if not run_directory.is_dir():
        remedy = "a file; name the folder of a run" if run_directory.exists() else "no such folder"
        raise InputError("runs", str(run_directory), remedy)
    check_folder(run_directory, Origin("runs", str(run_directory)))
    sections = read_sections(folder)
    if not sections and not (run_directory / CONFIG).is_file() and not folder.is_dir():
        remedy = f"no run in it: there is no {CONFIG}, which every run writes first"
        raise InputError("runs", str(run_directory), remedy)
    if not sections:
        remedy = "a run without a timeline: it was made with launch.timeline=false, or no worker has begun"
        raise InputError("runs", str(run_directory), remedy)
    return Timeline(run=run_directory, rows=_rows(sections))


def _rows(sections: list[Section]) -> tuple[Row, ...]:
    """One for each worker, on a common axis.

    Clocks of one machine agree to the nanosecond, so that its sections are set to the calendar together, by
    what the first of them noted.
    """
    sections = sorted(sections, key=lambda section: section.head.begins.wall_ns)
    moments = [section.head.begins for section in sections]
    offsets: dict[str, int] = {}
    for moment in moments:
        offsets.setdefault(moment.node, moment.wall_ns - moment.clock_ns)
    begins = [moment.clock_ns + offsets[moment.node] for moment in moments]
    workers: dict[str, list[tuple[Section, int]]] = {}
    for section, begun in zip(sections, begins, strict=True):
        workers.setdefault(section.head.worker, []).append((section, begun - min(begins)))
    rows = (_row(worker, own) for worker, own in workers.items())
    return tuple(sorted(rows, key=lambda row: _place(row.worker)))


def _row(worker: str, sections: list[tuple[Section, int]]) -> Row:
    times: np.ndarray = np.empty(0, np.int64)
    states: np.ndarray = np.empty(0, np.uint8)
    older, kept_from = np.zeros(len(STATES), np.int64), 0
    for section, begun in sections:
        own = section.times + begun
        if len(times):
            # What its process before still noted while it was being ended is cut off.
            left = max(1, int(np.searchsorted(times, own[0])))
            times, states = times[:left], np.append(states[: left - 1], np.uint8(ABSENT))
        times, states = np.concatenate([times, own]), np.concatenate([states, section.states])
        older += section.head.totals_ns
        if section.head.at_ns:
            kept_from = int(own[0])
    # Beats are no changes of state.
    change = np.flatnonzero(np.diff(states, prepend=-1) != 0)
    return Row(
        worker=worker,
        times=np.append(times[:-1][change], times[-1]),
        states=states[change],
        older_ns=older,
        kept_from=kept_from,
    )


def _place(worker: str) -> tuple[int, int, str]:
    role = role_of(worker)
    number = worker[len(role) :].strip()
    return ROLES.index(role) if role in ROLES else len(ROLES), int(number or 0), role
