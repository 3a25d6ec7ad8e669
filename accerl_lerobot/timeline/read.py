# SPDX-License-Identifier: Apache-2.0
"""A run's timeline as rows of intervals, and how its workers' time divides among the states.

``accerl timeline``: runs as a picture, and as shares of their workers' time.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from accerl_lerobot.checkpoint.safety import FileSource, brief, check_folder
from accerl_lerobot.config.ranges import NonNegative, Positive, Section
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
    Moment,
    bubble,
    role_of,
)

ABSENT = len(STATES)  # state of a worker of which there is no process, or whose older entries are not kept
Window = tuple[float, float]  # first and last second, since the timeline began
Shares = dict[str, dict[str, float]]
"""Role → state → share of the time of its workers; states with no time are left out."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One worker, all processes that it has been."""

    worker: str
    times: np.ndarray  # int64 (n + 1,), nanoseconds since the timeline began; n intervals lie between them
    states: np.ndarray  # uint8 (n,), of each interval

    @property
    def role(self) -> str:
        return role_of(self.worker)

    def until(self, at: np.ndarray) -> np.ndarray:
        """float64 (m, states): time in each state up to nanoseconds `at` (m,) since the timeline began."""
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

    def shares(self, windows: Sequence[Window] = ()) -> Shares:
        """How the time of each role divides in `windows`, as far as it is kept; empty: in all of it."""
        ends = 1e9 * np.ravel(windows or [(0.0, self.seconds)])
        spent: dict[str, np.ndarray] = {}
        for row in self.rows:
            own = np.diff(row.until(ends), axis=0)[::2].sum(axis=0)
            spent[row.role] = spent.get(row.role, 0) + own
        return {
            role: {STATES[i]: float(own[i] / own.sum()) for i in np.flatnonzero(own)}
            for role, own in spent.items()
            if own.sum() > 0
        }


class Part(NamedTuple):
    """One file of a process; the intervals between `times` are spent in `states`."""

    worker: str
    number: tuple[int, int]  # numbers of the process and of the part
    begins: Moment  # when the process did
    times: np.ndarray  # int64 (n + 1,), nanoseconds since the process began
    states: np.ndarray  # uint8 (n,)


def read_timeline(run_directory: Path) -> Timeline:
    """Reads what the workers of a run have left, on a common axis.

    Clocks of one machine agree to the nanosecond, so all its processes are placed on the calendar together,
    by the moment that the first of them noted.

    Raises:
        InputError: there is none, or a file of it is damaged.
    """
    check_folder(run_directory, FileSource("runs", str(run_directory)))
    parts = read_parts(run_directory / TIMELINE)
    if not parts:
        hint = "no timeline in it: it is no run of accerl train, or no worker has begun"
        raise InputError("runs", str(run_directory), hint)
    with reading("runs", str(run_directory), f"a file of {TIMELINE}/"):
        return Timeline(run=run_directory, rows=_rows(parts))


def _rows(parts: list[Part]) -> tuple[Row, ...]:
    """All workers on a common axis."""
    offsets: dict[str, int] = {}
    for begins in sorted((part.begins for part in parts), key=lambda moment: moment.wall_ns):
        offsets.setdefault(begins.node, begins.wall_ns - begins.clock_ns)
    first = min(part.begins.clock_ns + offsets[part.begins.node] for part in parts)
    workers: dict[str, list[Part]] = {}
    for part in parts:
        moved = part.times + part.begins.clock_ns + offsets[part.begins.node] - first
        workers.setdefault(part.worker, []).append(part._replace(times=moved))
    rows = [_row(worker, own) for worker, own in workers.items()]
    return tuple(sorted(rows, key=_place))


def read_parts(folder: Path) -> list[Part]:
    parts = []
    for path in folder.glob(f"*{SUFFIX}"):
        with contextlib.suppress(FileNotFoundError):  # its worker has begun another part meanwhile
            head, newline, data = path.read_bytes().partition(b"\n")
            if newline:
                parts.append(_part(path, head, data))
    return sorted(parts, key=lambda part: part.number)


def _part(path: Path, head: bytes, data: bytes) -> Part:
    try:
        _, process, number = path.name.removesuffix(SUFFIX).rsplit(".", 2)
        content = json.loads(head)
        if content["timeline"] != FORMAT:
            raise ValueError(f"format {content['timeline']}, not {FORMAT}")
        begins = Moment(str(content["node"]), int(content["clock_ns"]), int(content["wall_ns"]))
        start, state = int(content["at_ns"]), STATES.index(content["state"])
        worker, place = str(content["worker"]), (int(process), int(number))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        why = f"damaged ({brief(error)}); restore it, or remove it"
        raise InputError("runs", str(path), why) from error
    entries = np.frombuffer(data[: len(data) // 8 * 8], "<u8")  # a killed process leaves half an entry
    times = np.append(start, (entries >> np.uint64(BITS)).astype(np.int64))
    states = np.append(state, (entries % 2**BITS).astype(np.int64))
    return Part(worker, place, begins, times, states[:-1].astype(np.uint8))


def _row(worker: str, parts: list[Part]) -> Row:
    times: np.ndarray = np.empty(0, np.int64)
    states: np.ndarray = np.empty(0, np.uint8)
    for part in parts:
        if len(times):  # the last entries of a process that was being ended are cut where the next one begins
            times = times[: max(1, int(np.searchsorted(times, part.times[0], "right")))]
            states = np.append(states[: len(times) - 1], np.uint8(ABSENT))
        times, states = np.concatenate([times, part.times]), np.concatenate([states, part.states])
    passed = (np.diff(times) > 0) | (states != ABSENT)  # the next part of a process follows at once
    times, states = np.append(times[:-1][passed], times[-1]), states[passed]
    change = np.flatnonzero(np.diff(states, prepend=-1) != 0)  # beats are no changes of state
    times = np.append(times[:-1][change], times[-1])
    return Row(worker=worker, times=times, states=states[change])


def _place(row: Row) -> tuple[int, int, str]:
    number = row.worker[len(row.role) :].strip()
    return ROLES.index(row.role) if row.role in ROLES else len(ROLES), int(number or 0), row.role


PICTURE = "timeline.png"
COLOURS = {
    "compute": "#3a7d44", "wait_in": "#dfe3e8", "wait_out": "#f0b429", "transport": "#5b8def",
    "weights": "#9b5de5", "checkpoint": "#8d6e63", "recovery": "#d64545", "training": "#a8c8a0",
    "evaluation": "#7fb8c9",
}  # fmt: skip
COLUMNS = 1600  # columns of the picture; an interval that is shorter than one colours it in proportion


@dataclass(frozen=True, kw_only=True)
class TimelineConfig(Section):
    """Fields of ``accerl timeline``."""

    BARE: ClassVar[str] = "runs"

    runs: tuple[str, ...] = ()
    """Folders of runs of ``accerl train``; the pictures of several stand above each other, the first on top.
    Bare arguments are runs."""
    start_s: NonNegative | None = None
    """First second that is drawn, since the first worker began. None: such that the window is in the middle
    of the training."""
    seconds: Positive = 10.0
    """How much is drawn."""
    output: str | None = None
    """The picture. None: ``timeline.png`` in the run's folder, or here if there are several."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.runs:
            raise InputError("runs", "", "name the folder of a run: accerl timeline RUN")


def show_timelines(config: TimelineConfig) -> dict[str, Any]:
    """Writes the ``picture``; of the ``runs``, what is drawn, when each trained and its roles' shares."""
    picture = None if config.output is None else expanded(config.output, "output")
    timelines = [read_timeline(expanded(name, "runs")) for name in config.runs]
    if picture is None:
        picture = timelines[0].run / PICTURE if len(timelines) == 1 else Path(PICTURE)
    if picture.suffix != ".png":
        raise InputError("output", str(picture), "the picture is a PNG; use a name that ends with .png")
    check_output(picture)
    windows = [choose_window(timeline, config.start_s, config.seconds) for timeline in timelines]
    draw(picture, list(zip(timelines, windows, strict=True)))
    runs = []
    for timeline, window in zip(timelines, windows, strict=True):
        training = timeline.training()
        spent = timeline.shares(training)
        bubbles = {role: bubble(own) for role, own in spent.items()}
        found = {"window_s": window, "training_s": training, "shares": spent, "bubble": bubbles}
        runs.append({"run": str(timeline.run), **found})
    return {"picture": str(picture), "runs": runs}


def choose_window(timeline: Timeline, start_s: float | None, seconds: float) -> Window:
    """The part of a timeline that is drawn: from `start_s` on, or in the middle of the longest training."""
    whole = timeline.seconds
    if start_s is not None and not start_s < whole:
        hint = f"use 0 or more, below {whole:.1f}, the seconds of {timeline.run}"
        raise InputError("start_s", start_s, hint)
    if start_s is None:
        first, last = max(timeline.training(), key=lambda window: window[1] - window[0])
        start_s = max(0.0, (first + last - seconds) / 2)
    return start_s, min(whole, start_s + seconds)


def timeline_table(result: dict[str, Any]) -> Table:
    """`result` for people, without the driver, whose time does not divide into work and waiting."""
    runs = result["runs"]
    roles = [role for role in ROLES if role != "driver" and any(role in run["shares"] for run in runs)]
    table = Table(title="per cent of the training", box=SIMPLE_HEAD)
    for heading in ("", *roles):
        table.add_column(heading, justify="right" if heading else "left")
    for run in runs:
        table.add_row(f"[bold]{escape(Path(run['run']).resolve().name)}[/bold]")
        rows = {state: [run["shares"].get(role, {}).get(state) for role in roles] for state in STATES}
        rows["bubble"] = [run["bubble"].get(role) for role in roles]
        for name, shares in rows.items():
            if any(shares):
                table.add_row(name, *("" if share is None else f"{100 * share:.1f}" for share in shares))
    return table


def draw(path: Path, parts: Sequence[tuple[Timeline, Window]]) -> None:
    """Writes a PNG: runs above each other on one scale of time, a row for each worker."""
    from matplotlib.colors import to_rgb
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    colours = np.array([to_rgb(COLOURS[state]) for state in STATES])
    heights = [len(timeline.rows) for timeline, _ in parts]
    longest = max(end - start for _, (start, end) in parts)
    size = (12, 0.9 + sum(0.75 + 0.28 * height for height in heights))
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    axes = figure.subplots(len(parts), squeeze=False, sharex=True, height_ratios=heights)[:, 0]
    seen = np.zeros(len(STATES))
    for ax, (timeline, (start, end)) in zip(axes, parts, strict=True):
        edges = np.linspace(1e9 * start, 1e9 * end, COLUMNS + 1)
        # (rows, columns, states), of each column's time; 0 where the worker is absent
        shares = np.stack([np.diff(row.until(edges), axis=0) for row in timeline.rows]) / np.diff(edges)[0]
        seen += shares.sum(axis=(0, 1))
        image = np.clip(shares @ colours + 1 - shares.sum(axis=2, keepdims=True), 0, 1)
        extent = (0, end - start, len(shares), 0)
        ax.imshow(image, extent=extent, aspect="auto", interpolation="none")
        ax.hlines(range(1, len(shares)), 0, end - start, color="white", lw=2)
        ax.set(xlim=(0, longest), yticks=np.arange(len(shares)) + 0.5)
        ax.set_yticklabels([row.worker for row in timeline.rows])
        name, whole = timeline.run.resolve().name, timeline.seconds
        title = f"{name}: {end - start:.3g} s from second {start:.1f} of {whole:.0f}"
        ax.set_title(title, loc="left", parse_math=False)
        ax.tick_params(length=0)
        ax.spines[:].set_visible(False)
    axes[-1].set_xlabel("seconds")
    handles = [Patch(color=COLOURS[STATES[i]], label=STATES[i]) for i in np.flatnonzero(seen)]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles) or 1, frameon=False)
    figure.savefig(path)
