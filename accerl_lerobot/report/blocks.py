# SPDX-License-Identifier: Apache-2.0
"""Parts of a page. Text here is plain text; the template escapes all of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from accerl_lerobot.console import rate
from accerl_lerobot.report.charts import Chart, Drawn, draw, drawable


@dataclass(frozen=True, kw_only=True)
class Tile:
    """A number worth a place of its own."""

    name: str
    value: str
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A cell of a table."""

    text: str
    interval: tuple[float, float, float] | None = None
    """Low end, value and high end as shares; drawn as a bar with a dot."""
    good: bool | None = None
    """Coloured, if it is good or bad."""
    colour: int | None = None
    """Colour of the line that stands for this row in the charts."""
    number: bool = False
    """Right-aligned."""


@dataclass(frozen=True, kw_only=True)
class Figures:
    """Charts, beside each other as far as there is room."""

    charts: list[Drawn]
    kind: str = "figures"


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows under headings; the first cell of a row is its heading."""

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    kind: str = "table"


@dataclass(frozen=True, kw_only=True)
class Film:
    """A video."""

    path: Path
    caption: str
    kind: str = "film"


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of a `Bar`."""

    name: str
    share: float
    colour: int
    note: str


@dataclass(frozen=True, kw_only=True)
class Bar:
    """A whole and its parts."""

    name: str
    parts: Sequence[Part]


@dataclass(frozen=True, kw_only=True)
class Bars:
    """Wholes below each other."""

    bars: Sequence[Bar]
    kind: str = "bars"


@dataclass(frozen=True, kw_only=True)
class Commands:
    """Lines for a shell, each with what it does."""

    commands: Sequence[tuple[str, str]]
    kind: str = "commands"


@dataclass(frozen=True, kw_only=True)
class Folded:
    """A long text that opens on demand."""

    title: str
    text: str
    kind: str = "folded"


@dataclass(frozen=True, kw_only=True)
class Changes:
    """Settings that differ from the defaults."""

    caption: str
    rows: Sequence[tuple[str, str, str]]
    """Field, value, and what it usually is."""
    kind: str = "changes"


@dataclass(frozen=True, kw_only=True)
class Words:
    """A paragraph."""

    text: str
    kind: str = "words"


Block = Figures | Table | Film | Bars | Commands | Folded | Changes | Words


@dataclass(frozen=True, kw_only=True)
class Section:
    """A heading and what is under it."""

    anchor: str
    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """A success rate, large."""

    name: str
    success: float
    interval: tuple[float, float]
    n: int


@dataclass(frozen=True, kw_only=True)
class Page:
    """All of it."""

    title: str
    kicker: str
    """Above the headline: what kind of page."""
    state: str
    """One word, or a few; empty for none."""
    state_good: bool
    headline: str
    lead: str
    """Below the headline."""
    outcomes: Sequence[Outcome]
    tiles: Sequence[Tile]
    warnings: Sequence[str]
    sections: Sequence[Section]


def figures(*charts: Chart) -> list[Block]:
    """Charts that show anything; nothing if none does."""
    drawn = [draw(chart) for chart in charts if drawable(chart)]
    return [Figures(charts=drawn)] if drawn else []


def rated(success: float | None, interval: Sequence[float] | None) -> Cell:
    """A success rate as text and as a bar."""
    if success is None or interval is None:
        return Cell(text=rate(None, None))
    return Cell(text=rate(success, interval), interval=(interval[0], success, interval[1]))


def section(anchor: str, title: str, *groups: Sequence[Block]) -> list[Section]:
    """A section of all that is in `groups`; none if that is nothing."""
    blocks = [block for group in groups for block in group]
    return [Section(anchor=anchor, title=title, blocks=blocks)] if blocks else []
