# SPDX-License-Identifier: Apache-2.0
"""Charts, drawn by matplotlib as SVG; text of a run stands beside them, in HTML that the template escapes."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from accerl_lerobot.console import number, percent

POINTS = 100
COLOURS = ("#1f5fd6", "#d9570b", "#0b8a7d", "#9a3fc2", "#5c8a0a", "#c2255c", "#8a5a12", "#7b8494")
TEXT, GRID = "#586172", "#e9ecf1"
STYLE = {
    "font.size": 9, "text.color": TEXT,
    "axes.edgecolor": GRID, "axes.labelcolor": TEXT, "axes.grid": True, "axes.axisbelow": True,
    "axes.spines.top": False, "axes.spines.right": False, "axes.xmargin": 0.02, "grid.color": GRID,
    "xtick.color": TEXT, "ytick.color": TEXT, "xtick.major.size": 0, "ytick.major.size": 0,
}  # fmt: skip


class Series(NamedTuple):
    """A line with a band around it, or points with intervals."""

    name: str
    x: np.ndarray
    y: np.ndarray
    low: np.ndarray | None = None
    high: np.ndarray | None = None
    points: bool = False


@dataclass(frozen=True)
class Chart:
    """Series over a common x."""

    title: str
    note: str
    x_label: str
    series: Sequence[Series]
    unit: str = ""
    limit: float | None = None
    bottom: float | None = None
    top: float | None = None
    share: bool = False

    @property
    def drawable(self) -> bool:
        """True if there is a line of two points, or a point."""
        return any(len(s.x) >= (1 if s.points else 2) for s in self.series)

    def shown(self, value: float) -> str:
        """A value of y as text."""
        return percent(value) if self.share else number(value, digits=3)

    @property
    def legend(self) -> list[tuple[str, str, str]]:
        """Colour, name, and first and last value of each series."""
        legend = []
        for i, s in enumerate(self.series):
            if len(s.y):
                ends = s.y if len(s.y) == 1 else s.y[[0, -1]]
                values = " → ".join(self.shown(float(value)) for value in ends)
                legend.append((COLOURS[i % len(COLOURS)], s.name, values))
        return legend

    def svg(self) -> str:
        """The picture as base64. It holds no text of a run."""
        import matplotlib as mpl
        from matplotlib.figure import Figure

        buffer = io.BytesIO()
        with mpl.rc_context(STYLE):
            figure = Figure(figsize=(4.6, 2.2), layout="constrained")
            self._draw(figure.subplots())
            figure.savefig(buffer, format="svg", transparent=True)
        return base64.b64encode(buffer.getvalue()).decode()

    def _draw(self, axes: Any) -> None:
        for i, s in enumerate(self.series):
            colour = COLOURS[i % len(COLOURS)]
            axes.plot(s.x, s.y, color=colour, linewidth=1.4, marker="o" if s.points else "", markersize=4)
            if s.low is not None and s.points:
                axes.vlines(s.x, s.low, s.high, color=colour, linewidth=1.4)
            elif s.low is not None:
                axes.fill_between(s.x, s.low, s.high, color=colour, alpha=0.17, linewidth=0)
        if self.limit is not None:
            axes.axhline(self.limit, color=COLOURS[-1], linestyle="--", linewidth=1.2)
        axes.locator_params(nbins=5)
        axes.xaxis.set_major_formatter(lambda value, _: number(value))
        axes.yaxis.set_major_formatter(lambda value, _: self.shown(value))
        axes.set_xlabel(self.x_label)
        axes.set_ylim(self.bottom, self.top)


def line(name: str, x: np.ndarray, y: np.ndarray) -> Series:
    """A line of at most `POINTS` points, so that no page grows with its run.

    Each of as many equal parts of a longer one becomes its mean, with a band from its smallest to its largest
    value. Where y is not finite, there is no point.
    """
    finite = np.isfinite(x) & np.isfinite(y)
    x, y = x[finite], y[finite]
    if len(x) <= POINTS:
        return Series(name, x, y)
    parts = np.array_split(y, POINTS)
    return Series(
        name,
        np.array([part.mean() for part in np.array_split(x, POINTS)]),
        np.array([part.mean() for part in parts]),
        np.array([part.min() for part in parts]),
        np.array([part.max() for part in parts]),
    )
