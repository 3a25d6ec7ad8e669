# SPDX-License-Identifier: Apache-2.0
"""Shared by studies: intervals over runs, and the files that results are kept in."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from accerl_lerobot.errors import expanded, make_folder
from accerl_lerobot.evaluation import Interval


def mean_interval(values: Sequence[float], confidence: float = 0.95) -> Interval:
    """Interval of the mean over runs, by Student's t (1908).

        m ± t · s / √k,  s² = Σ (x − m)² / (k − 1),  t of k − 1 degrees of freedom

    Policies of several seeds differ by more than their episodes do, so treating all their episodes as those
    of one policy would claim too much.
    """
    from scipy.special import stdtrit

    mean, error = float(np.mean(values)), float(np.std(values, ddof=1)) / math.sqrt(len(values))
    half = float(stdtrit(len(values) - 1, (1 + confidence) / 2)) * error
    return Interval(mean - half, mean + half)


def output_folder(path: str) -> Path:
    """The folder ``output_dir`` names, created if it is not there; results of before are kept in it."""
    folder = expanded(path, "output_dir")
    make_folder(folder, "output_dir", again=True)
    return folder


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
