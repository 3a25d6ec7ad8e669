# SPDX-License-Identifier: Apache-2.0
"""Timelines as a picture: a row for each worker, coloured by what it does."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from accerl_lerobot.console import percent
from accerl_lerobot.timeline.read import Row, Timeline, Window
from accerl_lerobot.timeline.states import STATES, bubble

PALETTE = (
    "#3a7d44", "#dfe3e8", "#f0b429", "#5b8def", "#9b5de5", "#8d6e63", "#d64545", "#a8c8a0", "#7fb8c9",
)  # fmt: skip
"""Colours of the states: work is green, waiting pale, waiting at a full door yellow."""
COLUMNS = 1600
"""Across; an interval that is shorter than a column colours it in proportion."""
MARK = "accerl timeline"
"""In a picture's metadata: made by us, and may be replaced."""


def draw(path: Path, parts: Sequence[tuple[Timeline, Window]]) -> None:
    """Draws runs above each other, on one scale of time.

    Args:
        path: PNG to write.
        parts: timelines, and which seconds of them.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    colours = np.array([to_rgb(colour) for colour in PALETTE])
    heights = [len(timeline.rows) for timeline, _ in parts]
    size = (12, 0.9 + sum(0.75 + 0.28 * height for height in heights))
    longest = max(end - start for _, (start, end) in parts)
    figure, axes = plt.subplots(
        len(parts), 1, figsize=size, dpi=150, squeeze=False, sharex=True, height_ratios=heights,
        layout="constrained",
    )  # fmt: skip
    seen: set[int] = set()
    for ax, (timeline, (start, end)) in zip(axes[:, 0], parts, strict=True):
        shares = [columns(row, start, end) for row in timeline.rows]
        seen |= {int(state) for own in shares for state in np.flatnonzero(own.sum(axis=0))}
        image = np.stack([own @ colours + 1 - own.sum(axis=1, keepdims=True) for own in shares])
        ax.imshow(
            np.clip(image, 0, 1),
            extent=(0, end - start, len(shares), 0),
            aspect="auto",
            interpolation="none",
        )
        ax.hlines(range(1, len(shares)), 0, end - start, color="white", lw=2)
        ax.set(xlim=(0, longest), yticks=np.arange(len(shares)) + 0.5)
        ax.set_yticklabels([row.worker for row in timeline.rows])
        ax.set_title(
            f"{timeline.run.resolve().name}: {end - start:.3g} s from second {start:.1f} of "
            f"{timeline.seconds:.0f}",
            loc="left",
        )
        _bubbles(ax, timeline, longest)
        ax.tick_params(length=0)
        ax.spines[:].set_visible(False)
    axes[-1, 0].set_xlabel("seconds")
    figure.legend(
        handles=[Patch(color=PALETTE[state], label=STATES[state]) for state in sorted(seen)],
        loc="outside lower center",
        ncols=len(seen) or 1,
        frameon=False,
    )
    figure.savefig(path, metadata={"Software": MARK})
    plt.close(figure)


def columns(row: Row, start: float, end: float) -> np.ndarray:
    """Share of each state in each column of the picture, (columns, states); of a worker that is absent, 0."""
    edges = np.linspace(1e9 * start, 1e9 * end, COLUMNS + 1)
    shares: np.ndarray = np.diff(row.until(edges), axis=0) / np.diff(edges)[:, None]
    return shares


def _bubbles(ax: Any, timeline: Timeline, right: float) -> None:
    """Beside the rows of each role, how much of the training it waited."""
    shares = timeline.shares(timeline.training())
    places: dict[str, list[int]] = {}
    for number, row in enumerate(timeline.rows):
        places.setdefault(row.role, []).append(number)
    for role, numbers in places.items():
        if role != "driver" and role in shares:
            y = sum(numbers) / len(numbers) + 0.5
            text = f" bubble {percent(bubble(shares[role]))}"
            ax.text(right, y, text, va="center", fontsize="small")
