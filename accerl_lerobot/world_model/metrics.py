# SPDX-License-Identifier: Apache-2.0
"""Metrics of a world model that one which ignores its actions cannot score on.

    skill          1 − MSE(model) / MSE(copy of the last frame), on all pixels or on those that changed
    sensitivity    MSE(with the actions of other windows) / MSE(with the true ones); 1 if actions are ignored
    AUROC          of a score that separates successes from failures

Better pixels than a copy prove nothing: a model may learn to blur what moves and ignore the actions.
Intervals are percentile bootstraps over episodes, as windows of one episode are alike.

Shapes: M windows, V cameras, H×W pixels.

Results of a validation as text, for the terminal and for reports. Free of torch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

CHANGED = 16
"""A pixel counts as changed if one of its colours differs by more, of 255."""


class Estimate(NamedTuple):
    """A number with its 95 % bootstrap interval."""

    value: float
    low: float
    high: float


def bootstrap(
    groups: np.ndarray, statistic: Callable[[np.ndarray], float], *, draws: int = 1000, seed: int = 0
) -> Estimate:
    """Bootstraps a statistic of row indices by resampling groups, such as episodes.

    Args:
        groups: (M,) group of each row.
        statistic: draws for which it is NaN are left out.
        draws: resamples.
        seed: of the resampling.
    """
    rng, count = np.random.default_rng(seed), len(groups)
    order = np.argsort(groups, kind="stable")
    rows = np.split(order, np.flatnonzero(np.diff(np.asarray(groups)[order])) + 1)
    values = np.array(
        [
            statistic(np.concatenate([rows[i] for i in rng.integers(len(rows), size=len(rows))]))
            for _ in range(draws)
        ]
    )
    values = values[~np.isnan(values)]
    # The nearest draw, since between two infinite ones there is nothing to interpolate.
    low, high = np.quantile(values, [0.025, 0.975], method="nearest") if len(values) else (np.nan, np.nan)
    return Estimate(statistic(np.arange(count)), float(low), float(high))


def changed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """bool (M, V, H, W): pixels that differ by more than `CHANGED` between uint8 frames (M, V, H, W, 3)."""
    return np.asarray(np.abs(before.astype(np.int16) - after).max(-1) > CHANGED)


def squared_errors(frames: np.ndarray, target: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """(M, 2) sums of squared errors and of pixels, of uint8 frames (M, V, H, W, 3), where `mask` holds."""
    errors = np.square(frames.astype(np.float64) - target).mean(-1)
    counted = np.ones(errors.shape) if mask is None else mask.astype(np.float64)
    sums: np.ndarray = np.stack([(errors * counted).sum((1, 2, 3)), counted.sum((1, 2, 3))], 1)
    return sums


def mean_error(sums: np.ndarray) -> float:
    """Mean squared error of `squared_errors` rows; NaN without a pixel."""
    total, count = sums.sum(0)
    return float(total / count) if count else float("nan")


def skill(model: np.ndarray, copy: np.ndarray, groups: np.ndarray) -> Estimate:
    """1 − MSE(model)/MSE(copy), from `squared_errors` of both (M, 2)."""

    def of(rows: np.ndarray) -> float:
        copied = mean_error(copy[rows])
        return 1 - mean_error(model[rows]) / copied if copied > 0 else float("nan")

    return bootstrap(groups, of)


def sensitivity(true: np.ndarray, other: np.ndarray, groups: np.ndarray) -> Estimate:
    """MSE(other actions)/MSE(true actions), from `squared_errors` of both (M, 2); of two exact ones 1."""

    def of(rows: np.ndarray) -> float:
        right, wrong = mean_error(true[rows]), mean_error(other[rows])
        if right > 0:
            return wrong / right
        return float("inf") if wrong > 0 else 1.0

    return bootstrap(groups, of)


def ranks(x: np.ndarray) -> np.ndarray:
    """Ranks from 1 to M; ties have their mean rank."""
    _, places, counts = np.unique(x, return_inverse=True, return_counts=True)
    mean_ranks: np.ndarray = (np.cumsum(counts) - (counts - 1) / 2)[places]
    return mean_ranks


def auroc(scores: np.ndarray, labels: np.ndarray) -> float:
    """Chance that a success scores above a failure, ties counting half; NaN without both."""
    scores, labels = np.asarray(scores, np.float64), np.asarray(labels, bool)
    good, bad = int(labels.sum()), int((~labels).sum())
    if not good or not bad:
        return float("nan")
    return float((ranks(scores)[labels].sum() - good * (good + 1) / 2) / (good * bad))


def auroc_estimate(scores: np.ndarray, labels: np.ndarray, groups: np.ndarray) -> Estimate:
    """`auroc` with its interval; NaN without both kinds."""
    if len(np.unique(labels)) < 2:
        return Estimate(float("nan"), float("nan"), float("nan"))
    return bootstrap(groups, lambda rows: auroc(scores[rows], labels[rows]))


def threshold_at(failures: np.ndarray, false_positives: float) -> float:
    """The lowest threshold that at most this share, in [0, 1), of the failures' scores (M,) reaches.

    Raises:
        ValueError: there is no failure.
    """
    if not len(failures):
        raise ValueError("no failures to choose a threshold on")
    falling = np.sort(np.asarray(failures, np.float64))[::-1]
    return float(np.nextafter(falling[int(np.floor(false_positives * len(falling)))], np.inf))


def shuffle_across_groups(count: int, groups: Sequence[object], rng: np.random.Generator) -> np.ndarray:
    """For each window the index of another one, from another group (its episode) where there is one."""
    windows = np.arange(count)
    chosen = np.empty(count, np.int64)
    of = np.array([hash(g) for g in groups])
    for i in range(count):
        others = windows[of != of[i]]
        chosen[i] = rng.choice(others if len(others) else np.flatnonzero(windows != i))
    return chosen


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
