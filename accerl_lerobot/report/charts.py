# SPDX-License-Identifier: Apache-2.0
"""Charts as plain geometry, in SVG that stretches to any width while its text, which is HTML, does not.

A picture of W × H units is stretched over whatever the page gives it; strokes keep their width, labels stand
beside it at percentages. So one drawing serves a telephone and a wide screen.

Long lines are thinned by `line`: each of `SPANS` equal spans of x becomes one point, the mean of its values,
with a shade from the smallest to the largest. No extreme is lost, and no page grows with the run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from accerl_lerobot.console import number, percent

W, H = 1000, 400
SPANS = 100
"""Points of a line at most."""
COLOURS = 8
"""Colours in the style sheet, ``c0`` to ``c7``; a ninth line is dashed."""
WHOLE = (-0.03, 1.04)
"""Ends of a share from 0 to 100 %, such that a dot at either is whole."""
ROOM = 0.06
"""Share of the height that is free above and below the data where the limits are not given."""


@dataclass(frozen=True, kw_only=True)
class Series:
    """One line, or points with intervals, or a limit that goes across."""

    name: str
    x: np.ndarray
    y: np.ndarray
    low: np.ndarray | None = None
    """Lower ends of the shade of a line, or of the intervals of points."""
    high: np.ndarray | None = None
    kind: Literal["line", "points", "limit"] = "line"
    colour: int = 0
    reach: tuple[float, float] | None = None
    """Ends of x before a line was thinned; None: those of `x`."""


@dataclass(frozen=True, kw_only=True)
class Chart:
    """A chart to be drawn."""

    title: str
    x_label: str
    series: tuple[Series, ...]
    unit: str = ""
    """Unit of y."""
    note: str = ""
    """Meaning of the chart, one sentence."""
    limits: tuple[float | None, float | None] = (None, None)
    """Ends of y; None: of the data."""
    share: bool = False
    """True if y is a share, shown in per cent."""
    wide: bool = False


@dataclass(frozen=True, kw_only=True)
class Tick:
    """A label beside the picture."""

    at: float
    """Per cent from the left, or from the top."""
    text: str


@dataclass(frozen=True, kw_only=True)
class Shape:
    """An SVG path."""

    style: str
    """Its classes."""
    path: str


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """A chart, ready for the page."""

    chart: Chart
    x_ticks: list[Tick]
    y_ticks: list[Tick]
    grid: str
    shapes: list[Shape]
    legend: list[tuple[str, str]]
    """Classes and name of each series."""
    label: str
    """The chart in words, for those who do not see it."""
    hover: dict[str, Any] = field(repr=False)
    """Numbers that the page's script shows under the pointer."""


def line(
    name: str, x: np.ndarray, y: np.ndarray, *, colour: int = 0, how: Literal["mean", "max"] = "mean"
) -> Series:
    """A line of at most `SPANS` points, see above.

    Args:
        name: for the legend.
        x, y: of equal length; where y is not finite, there is no point.
        colour: its place in the palette.
        how: what a span becomes: its mean, with a shade, or its largest value.
    """
    there = np.isfinite(x) & np.isfinite(y)
    x, y = x[there], y[there]
    if len(x) <= SPANS:
        return Series(name=name, x=x, y=y, colour=colour)
    reach = (float(x.min()), float(x.max()))
    edges = np.linspace(*reach, SPANS + 1)
    span = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, SPANS - 1)
    order = np.argsort(span, kind="stable")
    starts = np.flatnonzero(np.diff(span[order], prepend=-1))
    size = np.diff(np.append(starts, len(x)))
    low, high = (f.reduceat(y[order], starts) for f in (np.minimum, np.maximum))
    middle = np.add.reduceat(x[order], starts) / size
    if how == "max":
        return Series(name=name, x=middle, y=high, colour=colour, reach=reach)
    mean = np.add.reduceat(y[order], starts) / size
    return Series(name=name, x=middle, y=mean, low=low, high=high, colour=colour, reach=reach)


def limit(name: str, value: float, *, colour: int = 7) -> Series:
    """A value that goes across the whole chart."""
    return Series(name=name, x=np.array([]), y=np.array([value]), kind="limit", colour=colour)


def rates(name: str, seconds: np.ndarray, counter: np.ndarray, *, colour: int = 0, spans: int = 60) -> Series:
    """Growth of a counter per second over equal spans of time; x in minutes."""
    there = np.isfinite(seconds) & np.isfinite(counter)
    seconds, counter = seconds[there], counter[there]
    if len(seconds) < 2 or seconds[-1] <= seconds[0]:
        return Series(name=name, x=np.array([]), y=np.array([]), colour=colour)
    edges = np.linspace(seconds[0], seconds[-1], min(spans, len(seconds)) + 1)
    grown = np.diff(np.interp(edges, seconds, counter)) / np.diff(edges)
    return Series(name=name, x=(edges[1:] + edges[:-1]) / 120, y=grown, colour=colour)


def drawable(chart: Chart) -> bool:
    """True if there is anything to see: a line of two points, or an interval."""
    return any(len(s.x) > (s.kind == "line") for s in chart.series)


def draw(chart: Chart) -> Drawn:
    """Geometry, ticks and words of a chart that is `drawable`."""
    x0, x1 = _x_range(chart.series)
    y0, y1 = _y_range(chart)
    x_at, x_step = ticks(x0, x1, 5)
    y_at, y_step = ticks(y0, y1, 6)
    shapes = [shape for series in chart.series for shape in _shapes(series, (x0, x1), (y0, y1))]
    lines = [f"M0 {_round(_down(v, y0, y1))}H{W}" for v in y_at]
    return Drawn(
        chart=chart,
        x_ticks=[Tick(at=round(100 * (v - x0) / (x1 - x0), 2), text=_tick(v, x_step)) for v in x_at],
        y_ticks=[
            Tick(at=round(100 * _down(v, y0, y1) / H, 2), text=_tick(v, y_step, chart.share)) for v in y_at
        ],
        grid="".join(lines),
        shapes=shapes,
        legend=[(f"{_style(s)} {s.kind}", s.name) for s in chart.series],
        label=in_words(chart),
        hover={
            "x": [x0, x1],
            "y": [y0, y1],
            "label": chart.x_label,
            "share": chart.share,
            "series": [_hover(s) for s in chart.series],
        },
    )


def ticks(low: float, high: float, about: int) -> tuple[list[float], float]:
    """Round numbers in [low, high], and the step between them: 1, 2 or 5 times a power of ten."""
    rough = (high - low) / about
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [i * step for i in range(first, last + 1)], step


def in_words(chart: Chart) -> str:
    """Title, axes, and the course of each series."""
    show = percent if chart.share else number
    said = [f"{chart.title} over {chart.x_label}."]
    for s in chart.series:
        if s.kind == "limit":
            said.append(f"{s.name}: {show(float(s.y[0]))}.")
        elif len(s.y):
            first, last = show(float(s.y[0])), show(float(s.y[-1]))
            low, high = (show(float(v)) for v in _extremes([s]))
            said.append(f"{s.name}: from {first} to {last}, between {low} and {high}.")
    return " ".join(said)


def _x_range(series: Sequence[Series]) -> tuple[float, float]:
    """Range of all x; points stand half a dot within it."""
    x = np.concatenate([s.x if s.reach is None else np.array(s.reach) for s in series])
    low, high = float(x.min()), float(x.max())
    if low == high:
        return low - 1.0, high + 1.0
    room = 0.02 * (high - low) if any(s.kind == "points" for s in series) else 0.0
    return low - room, high + room


def _y_range(chart: Chart) -> tuple[float, float]:
    low, high = _extremes(chart.series)
    room = ROOM * (high - low) or abs(high) * 0.1 or 1.0
    bottom, top = chart.limits
    # Nothing that is counted from 0 up goes below it.
    least = 0.0 if low >= 0 and low - room < 0 else low - room
    return (least if bottom is None else bottom), (high + room if top is None else top)


def _extremes(series: Sequence[Series]) -> tuple[float, float]:
    values = [v for s in series for v in (s.y, s.low, s.high) if v is not None and len(v)]
    every = np.concatenate(values)
    return float(np.nanmin(every)), float(np.nanmax(every))


def _shapes(s: Series, xs: tuple[float, float], ys: tuple[float, float]) -> list[Shape]:
    style = _style(s)
    y = [_round(_down(v, *ys)) for v in s.y]
    if s.kind == "limit":
        return [Shape(style=f"{style} limit", path=f"M0 {y[0]}H{W}")]
    x = [_round(W * (v - xs[0]) / (xs[1] - xs[0])) for v in s.x]
    if not x:
        return []
    shapes = []
    if s.low is not None and s.high is not None:
        low, high = ([_round(_down(v, *ys)) for v in ends] for ends in (s.low, s.high))
        if s.kind == "points":
            ends = "".join(f"M{a} {b}V{c}" for a, b, c in zip(x, low, high, strict=True))
            shapes.append(Shape(style=f"{style} interval", path=ends))
        else:
            there = [f"{a} {b}" for a, b in zip(x, high, strict=True)]
            back = [f"{a} {b}" for a, b in zip(x, low, strict=True)]
            shapes.append(Shape(style=f"{style} shade", path=f"M{'L'.join(there + back[::-1])}Z"))
    along = "L".join(f"{a} {b}" for a, b in zip(x, y, strict=True))
    shapes.append(Shape(style=f"{style} {s.kind}", path=f"M{along}"))
    if s.kind == "points":  # a line of no length with round ends is a dot that no stretching distorts
        dots = "".join(f"M{a} {b}h0" for a, b in zip(x, y, strict=True))
        shapes.append(Shape(style=f"{style} dot", path=dots))
    return shapes


def _hover(s: Series) -> dict[str, Any]:
    kept: dict[str, Any] = {"name": s.name, "style": f"{_style(s)} {s.kind}"}
    for key, values in (("x", s.x), ("y", s.y), ("low", s.low), ("high", s.high)):
        if values is not None:
            kept[key] = [float(f"{v:.5g}") for v in values]
    return kept


def _style(s: Series) -> str:
    return f"c{s.colour % COLOURS}{' dashed' if s.colour >= COLOURS else ''}"


def _down(value: float, low: float, high: float) -> float:
    """SVG counts from the top; what is far outside stays near, as renderers do not like huge numbers."""
    return H * min(max(1 - (value - low) / (high - low), -1.0), 2.0)


def _round(value: float) -> str:
    return f"{value:.1f}".removesuffix(".0")


def _tick(value: float, step: float, share: bool = False) -> str:
    if share:
        return f"{100 * value:.{max(0, -math.floor(math.log10(100 * step) + 1e-9))}f} %"
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if step >= size / 10 and abs(value) >= size:
            return f"{value / size:.{1 if step < size else 0}f} {letter}"
    if value == 0:
        return "0"
    if step < 1e-4 or step >= 1e6:
        return f"{value:.1e}".replace(".0e", "e").replace("e-0", "e-").replace("e+0", "e")
    return f"{value:.{max(0, -math.floor(math.log10(step) + 1e-9))}f}"
