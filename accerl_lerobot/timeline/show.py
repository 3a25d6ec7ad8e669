# SPDX-License-Identifier: Apache-2.0
"""``accerl timeline``: draws runs, writes their traces, and says how their workers' time divides."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from accerl_lerobot.checkpoint.layout import write_atomically
from accerl_lerobot.errors import InputError, expanded
from accerl_lerobot.timeline.chrome import trace
from accerl_lerobot.timeline.config import TimelineConfig
from accerl_lerobot.timeline.picture import MARK, draw
from accerl_lerobot.timeline.read import Timeline, Window, read_timeline, window_of
from accerl_lerobot.timeline.states import COMPUTE, ROLES, STATES, bubble

PICTURE, TRACE = "timeline.png", "timeline.json"
"""Names in a run's folder."""
TURNS = 16
"""Updates that are drawn."""
LEAST_S, MOST_S = 2.0, 60.0
"""Shortest and longest window that is chosen by default."""


def show_timelines(config: TimelineConfig) -> dict[str, Any]:
    """Reads the runs, writes picture and traces.

    Returns:
        ``picture``, and of each run, in ``runs``, ``run``, ``trace``, ``window_s`` (what is drawn),
        ``training_s`` (when it trained, for each start), ``shares`` and ``bubble`` by role, in the training,
        and ``window_bubble``, in what is drawn.

    Raises:
        InputError: a run has no timeline, the window is not within one, or the picture has no place.
    """
    picture = None if config.output is None else expanded(config.output, "output")
    timelines = [read_timeline(Path(name).expanduser()) for name in config.runs]
    if picture is None:
        picture = timelines[0].run / PICTURE if len(timelines) == 1 else Path(PICTURE)
    _check_place(picture)
    windows = choose_windows(timelines, config.start_s, config.seconds)
    part = picture.with_name(f".{picture.stem}.part.png")
    draw(part, list(zip(timelines, windows, strict=True)))
    os.replace(part, picture)
    found = [
        _written(timeline, window, config.trace_seconds)
        for timeline, window in zip(timelines, windows, strict=True)
    ]
    return {"picture": str(picture), "runs": found}


def choose_windows(
    timelines: Sequence[Timeline], start_s: float | None, seconds: float | None
) -> list[Window]:
    """Which seconds of each run are drawn; all as long, if the runs are.

    Raises:
        InputError: what is asked for is not within a run.
    """
    length = max(map(_turns, timelines)) if seconds is None else seconds
    return [
        window_of(timeline, _middle(timeline, length) if start_s is None else start_s, length)
        for timeline in timelines
    ]


def table(result: dict[str, Any]) -> Table:
    """`result` for people, without the driver, whose time does not divide into work and waiting."""
    runs = result["runs"]
    roles = [role for role in ROLES if role != "driver" and any(role in run["shares"] for run in runs)]
    shown = Table(title="per cent of the training", box=SIMPLE_HEAD)
    for heading in ("", *roles):
        shown.add_column(heading, justify="right" if heading else "left")
    for run in runs:
        spent = {state for role in roles for state in run["shares"].get(role, {})}
        rows = {state: {role: own.get(state) for role, own in run["shares"].items()} for state in STATES}
        shown.add_row(f"[bold]{escape(Path(run['run']).resolve().name)}[/bold]")
        for name, row in rows.items():
            if name in spent:
                shown.add_row(name, *(_per_cent(row.get(role)) for role in roles))
        for name, key in (("bubble", "bubble"), ("… of what is drawn", "window_bubble")):
            shown.add_row(name, *(_per_cent(run[key].get(role)) for role in roles))
    return shown


def _per_cent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f}"


def _written(timeline: Timeline, window: Window, trace_seconds: float) -> dict[str, Any]:
    """Writes a run's trace; what is said of the run."""
    centre = sum(window) / 2
    around = max(0.0, centre - trace_seconds / 2), min(timeline.seconds, centre + trace_seconds / 2)
    path = timeline.run / TRACE
    write_atomically(path, json.dumps(trace(timeline, around)) + "\n")
    training = timeline.training()
    spent, drawn = timeline.shares(training), timeline.shares([window])
    return {
        "run": str(timeline.run),
        "trace": str(path),
        "window_s": window,
        "training_s": training,
        "shares": spent,
        "bubble": {role: bubble(own) for role, own in spent.items()},
        "window_bubble": {role: bubble(own) for role, own in drawn.items()},
    }


def _turns(timeline: Timeline) -> float:
    """Seconds of so many updates."""
    first, last = _longest(timeline)
    length = last - first
    for row in timeline.rows:
        if row.role == "trainer":
            begins = row.times[:-1][row.states == COMPUTE] / 1e9
            within = begins[(begins >= first) & (begins < last)]
            if len(within) > TURNS:
                length = TURNS * (within[-1] - within[0]) / (len(within) - 1)
    return min(MOST_S, max(LEAST_S, float(length)))


def _middle(timeline: Timeline, seconds: float) -> float:
    """Where a window in the middle of the training begins, of that of it which is kept of all workers."""
    first, last = _longest(timeline)
    kept = max(row.kept_from for row in timeline.rows) / 1e9
    first = max(first, min(kept, last - seconds))
    return max(0.0, (first + last - seconds) / 2)


def _longest(timeline: Timeline) -> Window:
    """Longest stretch of the training without a new start."""
    return max(timeline.training(), key=lambda window: window[1] - window[0])


def _check_place(picture: Path) -> None:
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
