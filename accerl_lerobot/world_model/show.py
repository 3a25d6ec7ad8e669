# SPDX-License-Identifier: Apache-2.0
"""Trials as text."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from accerl_lerobot.world_model.by_source import estimate, every_source, number, source_rows
from accerl_lerobot.world_model.trial import NEVER


def table(found: dict[str, Any]) -> Table:
    """A trial for people."""
    outcome = "passed" if found["passed"] else "FAILED"
    shown = Table(title=f"{found['trials']} trials: {outcome}")
    columns = (
        "depth", "trials", "skill, changed pixels", "sensitivity",
        "PSNR", "AUROC", "false success: true", "none",
    )  # fmt: skip
    for column in columns:
        shown.add_column(column, justify="right")
    for row in found["depths"]:
        shown.add_row(
            str(row["depth"]),
            str(row["trials"]),
            estimate(row.get("skill_changed")),
            estimate(row.get("sensitivity_shuffled")),
            number(row.get("psnr"), 1),
            estimate(row.get("auroc_dreamt")),
            *(number(row.get(f"false_success_{arm}"), 2) for arm in NEVER),
        )
    return shown


def sources_table(found: dict[str, Any]) -> Table:
    """Trials on several sources beside each other, a column each."""
    shown = Table(title="By source")
    shown.add_column("")
    every = every_source(found)
    for one in every:
        shown.add_column(str(one["name"]), justify="right")
    for name, cells in source_rows(every):
        shown.add_row(name, *cells)
    return shown


def gates(found: dict[str, Any]) -> list[str]:
    """Each gate of a trial in a line."""
    return [
        f"{'holds' if gate['holds'] else 'FAILS'}  {name} = {number(gate['value'], 2) or 'unknown'}, "
        f"{gate['wanted']} wanted"
        for name, gate in found["gates"].items()
    ]
