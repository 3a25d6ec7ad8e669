# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
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

    Raises:
        ValueError: no episodes.
    """
    if not results:
        raise ValueError("nothing to summarise: no episodes")
    rate = total(outcomes(results))
    interval = rate.interval()
    tasks = {
        task: {"success": r.value, "n": r.n, "ci95": [r.interval().low, r.interval().high]}
        for task, r in sorted(per_task(outcomes(results)).items())
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
