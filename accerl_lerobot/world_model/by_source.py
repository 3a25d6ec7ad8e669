# SPDX-License-Identifier: Apache-2.0
"""Trials of one world model on several sources, beside each other. Free of torch: a report shows them too."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any


def every_source(found: dict[str, Any]) -> list[dict[str, Any]]:
    """Results of a trial on each source, the first of them first."""
    return [found, *(found.get("sources") or {}).values()]


def compared(found: dict[str, Any]) -> bool:
    """True if there is more to tell by source than of one trial."""
    return bool(found.get("sources"))


def source_rows(every: Sequence[dict[str, Any]]) -> list[tuple[str, list[str]]]:
    """Rows about each source: a name, and a text for each of them."""
    rows = [("episodes", [str((one.get("tried") or {}).get("episodes", "")) for one in every])]
    rows += [("gates that hold", [_holding(one["gates"]) for one in every])]
    ends = [one.get("outcomes") or {} for one in every]
    for name, depth, key in (
        ("skill, changed pixels, first chunk", 0, "skill_changed"),
        ("last chunk", -1, "skill_changed"),
        ("sensitivity, other actions", 0, "sensitivity_shuffled"),
    ):
        rows.append((name, [estimate((one["depths"] or [{}])[depth].get(key)) for one in every]))
    rows.append(("successes, failures dreamt", [_ended(o) for o in ends]))
    rows.append(("AUROC of how they end", [estimate(o.get("auroc")) for o in ends]))
    for name, key in (("false success", "false_success"), ("recall", "recall")):
        rows.append((name, [number(o.get(key), 2) for o in ends]))
    return [(name, cells) for name, cells in rows if any(cells)]


def _holding(gates: dict[str, Any]) -> str:
    """Results of a source's own, which have no source in their name."""
    gates = {name: gate for name, gate in gates.items() if "." not in name}
    return f"{sum(gate['holds'] for gate in gates.values())} of {len(gates)}"


def _ended(outcomes: dict[str, Any]) -> str:
    return f"{outcomes['successes']}, {outcomes['failures']}" if outcomes else ""


def number(value: float | None, digits: int) -> str:
    """Empty where there is none."""
    return "" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def estimate(found: dict[str, float] | None) -> str:
    """With its interval; empty where there is none."""
    if found is None or math.isnan(found["value"]):
        return ""
    return f"{found['value']:.2f} [{found['low']:.2f}, {found['high']:.2f}]"
