# SPDX-License-Identifier: Apache-2.0
"""Shared by the benchmarks: the machine, spreads and intervals of measurements, tables and files."""

from __future__ import annotations

import json
import math
import os
import platform
import statistics
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from accerl_lerobot import __version__
from accerl_lerobot.errors import InputError, expanded
from accerl_lerobot.evaluation import Interval

PACKAGES = ("lerobot", "torch", "ray", "numpy")
LOG_LINES = 12  # lines of a failed run's log that its error shows


def host() -> dict[str, Any]:
    """Cores, versions and load, of now."""
    return {
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "python": platform.python_version(),
        "versions": {"accerl-lerobot": __version__} | {name: version(name) for name in PACKAGES},
        "load_1min": os.getloadavg()[0],
    }


def spread(values: list[float]) -> dict[str, Any]:
    """Median, range and all of them."""
    return {"median": statistics.median(values), "min": min(values), "max": max(values), "blocks": values}


def ranged(values: dict[str, Any], form: str) -> str:
    """Formats the outcome of `spread`: median and range in this form."""
    return f"{values['median']:{form}} ({values['min']:{form}} to {values['max']:{form}})"


def mean_interval(values: Sequence[float], confidence: float = 0.95) -> Interval:
    """Interval of the mean over runs, by Student's t (1908).

        m ± t · s / √k,  s² = Σ (x − m)² / (k − 1),  t of k − 1 degrees of freedom

    Policies of several seeds differ by more than their episodes do, so treating all their episodes as those
    of one policy would claim too much.
    """
    from scipy.special import stdtrit

    mean = float(np.mean(values))
    error = float(np.std(values, ddof=1)) / math.sqrt(len(values))
    half = float(stdtrit(len(values) - 1, (1 + confidence) / 2)) * error
    return Interval(mean - half, mean + half)


def named(config: Any, *names: str) -> None:
    """Refuses a list of a config that is empty, or that holds something twice."""
    for name in names:
        values = getattr(config, name)
        if not values or len(set(values)) < len(values):
            raise InputError(name, values, "name at least one, none of them twice")


def output_folder(path: str) -> Path:
    """The folder ``output_dir`` names, created if it is not there; results of before are kept in it."""
    folder = expanded(path, "output_dir")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def as_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    shown = Table(*columns, title=title)
    for row in rows:
        shown.add_row(*row)
    return shown


def as_markdown(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Rows for the docs."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def write(
    root: Path,
    name: str,
    result: dict[str, Any],
    markdown: str,
    draw: Callable[[Path, dict[str, Any]], object] | None = None,
) -> None:
    """Into a folder that is there: the numbers, the table and the picture, if any, under one name."""
    (root / f"{name}.json").write_text(json.dumps(result, indent=2) + "\n")
    (root / f"{name}.md").write_text(markdown)
    if draw is not None:
        draw(root / f"{name}.png", result)


def last_words(log: Path) -> str:
    """The end of a run's log."""
    return "\n".join(log.read_text(errors="replace").splitlines()[-LOG_LINES:])


@contextmanager
def drawing(path: Path) -> Iterator[Any]:
    """Axes to draw on, with a grid, which are a PNG when the context is left."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), dpi=120, layout="tight")
    axes = figure.subplots()
    axes.grid(alpha=0.3)
    yield axes
    figure.savefig(path)
