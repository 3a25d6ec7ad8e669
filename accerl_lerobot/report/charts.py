# SPDX-License-Identifier: Apache-2.0
"""Charts, drawn by matplotlib as SVG; text of a run stands beside them, in HTML that the template escapes."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from accerl_lerobot.console import number, percent

POINTS = 100
COLOURS = ("#1f5fd6", "#d9570b", "#0b8a7d", "#9a3fc2", "#5c8a0a", "#c2255c", "#8a5a12", "#7b8494")
TEXT, GRID = "#586172", "#e9ecf1"
STYLE = {
    "svg.fonttype": "none", "font.size": 9, "text.color": TEXT,
    "axes.edgecolor": GRID, "axes.labelcolor": TEXT, "axes.grid": True, "axes.axisbelow": True,
    "axes.spines.top": False, "axes.spines.right": False, "axes.xmargin": 0.02, "grid.color": GRID,
    "xtick.color": TEXT, "ytick.color": TEXT, "xtick.major.size": 0, "ytick.major.size": 0,
}  # fmt: skip
NO_METADATA = dict.fromkeys(("Creator", "Date", "Format", "Type"))


class Series(NamedTuple):
    """A line, or points with intervals."""

    name: str
    x: np.ndarray
    y: np.ndarray
    colour: int = 0  # index into `COLOURS`; from its length on, lines are dashed
    low: np.ndarray | None = None  # lower ends of the band around a line, or of the intervals of points
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
    bands: bool = True  # False: no bands nor intervals, which hide each other where there are many series
    wide: bool = False

    @property
    def drawable(self) -> bool:
        """True if there is a line of two points, or a point."""
        return any(len(s.x) > (not s.points) for s in self.series)

    @property
    def legend(self) -> list[tuple[str, str, str]]:
        """Style of the key, name, and first and last value of each series."""
        show, legend = percent if self.share else partial(number, digits=3), []
        for s in self.series:
            ends = [show(float(value)) for value in (s.y if len(s.y) < 2 else s.y[[0, -1]])]
            if ends:
                dashes = "dashed" if s.colour >= len(COLOURS) else "solid"
                legend.append((f"{dashes} {COLOURS[s.colour % len(COLOURS)]}", s.name, " → ".join(ends)))
        return legend

    def svg(self) -> str:
        """The picture. It holds no text of a run, and no ids that the page's other pictures have."""
        import matplotlib as mpl
        from matplotlib.figure import Figure

        with mpl.rc_context(STYLE | {"svg.hashsalt": self.title}):
            figure = Figure(figsize=(9.5, 3.2) if self.wide else (4.6, 2.2), layout="constrained")
            self._draw(figure.subplots())
            buffer = io.StringIO()
            figure.savefig(buffer, format="svg", transparent=True, metadata=NO_METADATA)
        svg = buffer.getvalue()
        svg = re.sub(r' id="(?![mp][0-9a-f]{10}")[^"]*"| font-family: [^;"]*;', "", svg[svg.index("<svg") :])
        return re.sub(r'width="[\d.]+pt" height="[\d.]+pt"', 'aria-hidden="true"', svg, count=1)

    def _draw(self, ax: Any) -> None:
        for s in self.series:
            colour, dashes = COLOURS[s.colour % len(COLOURS)], "--" if s.colour >= len(COLOURS) else "-"
            points: dict[str, Any] = {"marker": "o", "markersize": 4, "linewidth": 1} if s.points else {}
            ax.plot(s.x, s.y, **{"linewidth": 1.4, "color": colour, "linestyle": dashes, **points})
            if s.low is not None and self.bands and s.points:
                ax.vlines(s.x, s.low, s.high, color=colour, linewidth=1.4)
            elif s.low is not None and self.bands:
                ax.fill_between(s.x, s.low, s.high, color=colour, alpha=0.17, linewidth=0)
        if self.limit is not None:
            ax.axhline(self.limit, color=COLOURS[-1], linestyle="--", linewidth=1.2)
        ax.locator_params(nbins=5)
        ax.xaxis.set_major_formatter(lambda value, _: number(value))
        ax.yaxis.set_major_formatter(lambda value, _: percent(value) if self.share else number(value))
        ax.set_xlabel(self.x_label)
        ax.set_ylim(self.bottom, self.top)


def line(name: str, x: np.ndarray, y: np.ndarray, colour: int = 0) -> Series:
    """A line of at most `POINTS` points, so that no page grows with its run.

    Each of as many equal spans of x becomes its mean, with a band from its smallest to its largest value.
    Where y is not finite, there is no point.
    """
    finite = np.isfinite(x) & np.isfinite(y)
    x, y = x[finite], y[finite]
    if len(x) <= POINTS:
        return Series(name, x, y, colour)
    span = np.minimum((x - x.min()) / max(np.ptp(x), 1e-9) * POINTS, POINTS - 1).astype(int)
    order = np.argsort(span, kind="stable")
    starts = np.flatnonzero(np.diff(span[order], prepend=-1))
    sizes = np.diff(np.append(starts, len(y)))
    x, mean = (np.add.reduceat(values[order], starts) / sizes for values in (x, y))
    low, high = (extreme.reduceat(y[order], starts) for extreme in (np.minimum, np.maximum))
    return Series(name, x, mean, colour, low, high)


def rates(name: str, seconds: np.ndarray, counter: np.ndarray, *, spans: int = 60) -> Series:
    """Growth of a counter per second over equal spans of time; x in minutes."""
    finite = np.isfinite(seconds) & np.isfinite(counter)
    seconds, counter = seconds[finite], counter[finite]
    if len(seconds) < 2 or seconds[-1] <= seconds[0]:
        return Series(name, np.array([]), np.array([]))
    edges = np.linspace(seconds[0], seconds[-1], min(spans, len(seconds)) + 1)
    growth = np.diff(np.interp(edges, seconds, counter)) / np.diff(edges)
    return Series(name, (edges[1:] + edges[:-1]) / 120, growth)
