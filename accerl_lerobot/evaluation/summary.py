# SPDX-License-Identifier: Apache-2.0
"""From finished episodes to numbers, a table and a file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table

from accerl_lerobot.evaluation.stats import Outcomes, format_rate, per_task, total
from accerl_lerobot.rollout.runner import EpisodeResult


def outcomes(results: Sequence[EpisodeResult]) -> Outcomes:
    """(task, seed) → success."""
    return {(r.plan.task, r.plan.seed): r.success for r in results}


def summarise(results: Sequence[EpisodeResult]) -> dict[str, Any]:
    """Success with its 95 % Wilson interval, in all and per task, as plain JSON types.

    Each task has the first and the last of its ``seeds``, and the ``failed_seeds`` among them.

    Raises:
        ValueError: no episodes.
    """
    if not results:
        raise ValueError("nothing to summarise: no episodes")
    rate = total(outcomes(results))
    interval = rate.interval()
    tasks: dict[str, dict[str, Any]] = {}
    for task, r in sorted(per_task(outcomes(results)).items()):
        seeds = {e.plan.seed: e.success for e in results if e.plan.task == task}
        tasks[task] = {
            "success": r.value,
            "n": r.n,
            "ci95": [r.interval().low, r.interval().high],
            "seeds": [min(seeds), max(seeds)],
            "failed_seeds": sorted(seed for seed, success in seeds.items() if not success),
        }
    return {
        "success": rate.value,
        "n": rate.n,
        "ci95": [interval.low, interval.high],
        "return_mean": float(np.mean([r.episode_return for r in results])),
        "steps_mean": float(np.mean([r.steps for r in results])),
        "version_min": min(r.versions[0] for r in results),
        "version_max": max(r.versions[1] for r in results),
        "tasks": tasks,
    }


def table(summary: dict[str, Any], title: str) -> Table:
    """`summarise`'s numbers for the terminal."""
    out = Table(title=title)
    for column in ("task", "success [95 % Wilson]"):
        out.add_column(column)
    rows = list(summary["tasks"].items())
    if len(rows) > 1:
        rows.append(("all", summary))
    for name, entry in rows:
        out.add_row(name, format_rate(round(entry["success"] * entry["n"]), entry["n"]))
    return out
