# SPDX-License-Identifier: Apache-2.0
"""``accerl timeline``: runs as pictures, as Chrome traces, and as shares of their workers' time."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from accerl_lerobot.checkpoint.layout import write_atomically
from accerl_lerobot.config.ranges import NonNegative, Positive, Section
from accerl_lerobot.errors import InputError, expanded
from accerl_lerobot.timeline.read import ABSENT, Row, Timeline, Window, read_timeline
from accerl_lerobot.timeline.states import ROLES, STATES, bubble

PICTURE, TRACE = "timeline.png", "timeline.json"
"""Names in a run's folder."""
MARK = "accerl timeline"
"""In a picture's metadata: made by us, and may be replaced."""
TRACE_S = 60.0
"""Seconds of a trace, around the middle of the picture."""
COLOURS = {
    "compute": ("#3a7d44", "thread_state_running"), "wait_in": ("#dfe3e8", "white"),
    "wait_out": ("#f0b429", "thread_state_iowait"), "transport": ("#5b8def", "rail_load"),
    "weights": ("#9b5de5", "rail_animation"), "checkpoint": ("#8d6e63", "olive"),
    "recovery": ("#d64545", "terrible"), "training": ("#a8c8a0", "good"),
    "evaluation": ("#7fb8c9", "generic_work"),
}  # fmt: skip
"""State → its colour in the picture, and the name of one that trace viewers know."""
COLUMNS = 1600
"""Columns of the picture; an interval that is shorter than one colours it in proportion."""


@dataclass(frozen=True, kw_only=True)
class TimelineConfig(Section):
    """Fields of ``accerl timeline``.

    Example:
        >>> TimelineConfig(runs=("outputs/synchronous", "outputs/asynchronous"), seconds=5.0)
    """

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
    """The picture. None: ``timeline.png`` in the run's folder, or here if there are several. An older picture
    of accerl is replaced; any other file is left alone."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.runs:
            raise InputError("runs", "", "name the folder of a run: accerl timeline RUN")


def show_timelines(config: TimelineConfig) -> dict[str, Any]:
    """Reads the runs, writes picture and traces.

    Returns:
        ``picture``, and for each run, in ``runs``, ``run``, ``trace``, ``window_s`` (what is drawn),
        ``training_s`` (when it trained, for each start), ``shares`` and ``bubble`` of the training by role.

    Raises:
        InputError: a run has no timeline, the window is not within one, or the picture has no place.
    """
    picture = None if config.output is None else expanded(config.output, "output")
    timelines = [read_timeline(Path(name).expanduser()) for name in config.runs]
    if picture is None:
        picture = timelines[0].run / PICTURE if len(timelines) == 1 else Path(PICTURE)
    _check_output(picture)
    windows = [choose_window(timeline, config.start_s, config.seconds) for timeline in timelines]
    part = picture.with_name(f".{picture.stem}.part.png")
    draw(part, list(zip(timelines, windows, strict=True)))
    os.replace(part, picture)
    runs = []
    for timeline, window in zip(timelines, windows, strict=True):
        middle, path = sum(window) / 2, timeline.run / TRACE
        around = max(0.0, middle - TRACE_S / 2), min(timeline.seconds, middle + TRACE_S / 2)
        write_atomically(path, json.dumps(trace(timeline, around)) + "\n")
        training = timeline.training()
        spent = timeline.shares(training)
        run = {"run": str(timeline.run), "trace": str(path), "window_s": window, "training_s": training}
        runs.append(run | {"shares": spent, "bubble": {role: bubble(own) for role, own in spent.items()}})
    return {"picture": str(picture), "runs": runs}


def choose_window(timeline: Timeline, start_s: float | None, seconds: float) -> Window:
    """The part of a timeline that is drawn: from `start_s` on, or in the middle of the longest training.

    Raises:
        InputError: `start_s` is not within the run.
    """
    whole = timeline.seconds
    if start_s is not None and not start_s < whole:
        remedy = f"use 0 or more, below {whole:.1f}, the seconds of {timeline.run}"
        raise InputError("start_s", start_s, remedy)
    if start_s is None:
        first, last = max(timeline.training(), key=lambda window: window[1] - window[0])
        kept = max(row.kept_from for row in timeline.rows) / 1e9  # from here on nothing is missing
        first = max(first, min(kept, last - seconds))
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


def trace(timeline: Timeline, window: Window) -> dict[str, Any]:
    """A window of a timeline in Google's "Trace Event Format", which Perfetto (ui.perfetto.dev) shows.

    A process for each role, a thread for each worker, and a complete event for each interval; microseconds.
    """
    events: list[dict[str, Any]] = []
    roles = list(dict.fromkeys(row.role for row in timeline.rows))
    for pid, role in enumerate(roles, start=1):
        meta = {"ph": "M", "pid": pid, "tid": 0}
        events.append({**meta, "name": "process_name", "args": {"name": role}})
        events.append({**meta, "name": "process_sort_index", "args": {"sort_index": pid}})
    first, last = (round(1e9 * end) for end in window)
    for tid, row in enumerate(timeline.rows, start=1):
        place = {"pid": roles.index(row.role) + 1, "tid": tid}
        events.append({"ph": "M", "name": "thread_name", **place, "args": {"name": row.worker}})
        begins, ends = np.maximum(row.times[:-1], first), np.minimum(row.times[1:], last)
        for i in np.flatnonzero((ends > begins) & (row.states != ABSENT)):
            state, begin = STATES[row.states[i]], int(begins[i])
            event = {"ph": "X", "name": state, "cat": row.role, "cname": COLOURS[state][1], **place}
            events.append({**event, "ts": begin / 1e3, "dur": (int(ends[i]) - begin) / 1e3})
    return {"traceEvents": events, "displayTimeUnit": "ms"}


def draw(path: Path, parts: Sequence[tuple[Timeline, Window]]) -> None:
    """Writes a PNG: runs above each other on one scale of time, a row for each worker."""
    from matplotlib.colors import to_rgb
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    colours = np.array([to_rgb(COLOURS[state][0]) for state in STATES])
    heights = [len(timeline.rows) for timeline, _ in parts]
    longest = max(end - start for _, (start, end) in parts)
    size = (12, 0.9 + sum(0.75 + 0.28 * height for height in heights))
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    axes = figure.subplots(len(parts), squeeze=False, sharex=True, height_ratios=heights)[:, 0]
    seen = np.zeros(len(STATES))
    for ax, (timeline, (start, end)) in zip(axes, parts, strict=True):
        shares = np.stack([columns(row, start, end) for row in timeline.rows])
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
    handles = [Patch(color=COLOURS[STATES[i]][0], label=STATES[i]) for i in np.flatnonzero(seen)]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles) or 1, frameon=False)
    figure.savefig(path, metadata={"Software": MARK})


def columns(row: Row, start: float, end: float) -> np.ndarray:
    """Share of each state in each column of the picture, (columns, states); 0 where the worker is absent."""
    edges = np.linspace(1e9 * start, 1e9 * end, COLUMNS + 1)
    shares: np.ndarray = np.diff(row.until(edges), axis=0) / np.diff(edges)[:, None]
    return shares


def _check_output(picture: Path) -> None:
    """Refuses to write over anything but an older picture of ours."""
    from PIL import Image, UnidentifiedImageError

    if picture.suffix != ".png":
        raise InputError("output", str(picture), "the picture is a PNG; use a name that ends with .png")
    if not picture.parent.is_dir():
        raise InputError("output", str(picture), f"there is no folder {picture.parent}; make it first")
    if picture.exists():
        try:
            with Image.open(picture) as image:
                ours = image.info.get("Software") == MARK
        except (UnidentifiedImageError, OSError):
            ours = False
        if not ours:
            raise InputError("output", str(picture), "there is another file of this name; choose another")
