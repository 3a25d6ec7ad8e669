# SPDX-License-Identifier: Apache-2.0
"""Results of a validation as text, for the terminal and for reports. Free of torch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from rich.table import Table


def per_dataset(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Results on each dataset, the first of them first."""
    return [result, *(result.get("datasets") or {}).values()]


def has_several(result: dict[str, Any]) -> bool:
    """True if there are results on more than one dataset."""
    return bool(result.get("datasets"))


def dataset_rows(results: Sequence[dict[str, Any]]) -> list[tuple[str, list[str]]]:
    """Rows of a table with a column per dataset: a name, and a text for each of them."""
    rows = [("episodes", [str((one.get("tried") or {}).get("episodes", "")) for one in results])]
    rows += [("checks that hold", [_holding(one["checks"]) for one in results])]
    ends = [one.get("outcomes") or {} for one in results]
    for name, depth, key in (
        ("skill, changed pixels, first chunk", 0, "skill_changed"),
        ("last chunk", -1, "skill_changed"),
        ("sensitivity, other actions", 0, "sensitivity_shuffled"),
    ):
        rows.append((name, [estimate((one["depths"] or [{}])[depth].get(key)) for one in results]))
    rows.append(("successes, failures", [_counts(o) for o in ends]))
    rows.append(("AUROC of imagined outcomes", [estimate(o.get("auroc")) for o in ends]))
    for name, key in (("false success", "false_success"), ("recall", "recall")):
        rows.append((name, [number(o.get(key), 2) for o in ends]))
    return [(name, cells) for name, cells in rows if any(cells)]


def _holding(checks: dict[str, Any]) -> str:
    """Counts the checks of one dataset, which have no dataset in their name."""
    checks = {name: check for name, check in checks.items() if "." not in name}
    return f"{sum(check['holds'] for check in checks.values())} of {len(checks)}"


def _counts(outcomes: dict[str, Any]) -> str:
    return f"{outcomes['successes']}, {outcomes['failures']}" if outcomes else ""


def number(value: float | None, digits: int) -> str:
    """Formats a number; empty for None and NaN."""
    return "" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def estimate(value: dict[str, float] | None) -> str:
    """Formats a number with its interval; empty for None and NaN."""
    if value is None or math.isnan(value["value"]):
        return ""
    return f"{value['value']:.2f} [{value['low']:.2f}, {value['high']:.2f}]"


def depth_table(result: dict[str, Any]) -> Table:
    """A row per depth."""
    shown = Table(title=f"{result['windows']} windows: {'passed' if result['passed'] else 'FAILED'}")
    for column in ("depth", "windows", "skill, changed pixels", "sensitivity", "PSNR"):
        shown.add_column(column, justify="right")
    for row in result["depths"]:
        shown.add_row(
            str(row["depth"]),
            str(row["windows"]),
            estimate(row.get("skill_changed")),
            estimate(row.get("sensitivity_shuffled")),
            number(row.get("psnr"), 1),
        )
    return shown


def datasets_table(result: dict[str, Any]) -> Table:
    """A column per dataset."""
    shown = Table(title="By dataset")
    shown.add_column("")
    results = per_dataset(result)
    for one in results:
        shown.add_column(str(one["name"]), justify="right")
    for name, cells in dataset_rows(results):
        shown.add_row(name, *cells)
    return shown


def check_lines(result: dict[str, Any]) -> list[str]:
    """Each check in a line."""
    return [
        f"{'holds' if check['holds'] else 'FAILS'}  {name} = {number(check['value'], 2) or 'unknown'}, "
        f"{check['wanted']} wanted"
        for name, check in result["checks"].items()
    ]
