# SPDX-License-Identifier: Apache-2.0
"""Tables of measurements, for people and for the docs, and the files they are kept in."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table


def as_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Rows for people."""
    shown = Table(title=title)
    for column in columns:
        shown.add_column(column)
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
