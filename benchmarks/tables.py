# SPDX-License-Identifier: Apache-2.0
"""The machine of a measurement, and spreads and tables of measurements."""

from __future__ import annotations

import os
import platform
import statistics
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

from rich.table import Table

from accerl_lerobot import __version__

PACKAGES = ("lerobot", "torch", "ray", "numpy")


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


def as_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    shown = Table(*columns, title=title)
    for row in rows:
        shown.add_row(*row)
    return shown
