# SPDX-License-Identifier: Apache-2.0
"""Metrics of a world model that one which ignores its actions cannot score on.

    skill          1 − MSE(model) / MSE(copy of the last frame), on all pixels or on those that changed
    sensitivity    MSE(with the actions of other windows) / MSE(with the true ones); 1 if actions are ignored
    AUROC          of a score that separates successes from failures

Better pixels than a copy prove nothing: a model may learn to blur what moves and ignore the actions.
Intervals are percentile bootstraps over episodes, as windows of one episode are alike.

Shapes: M windows, V cameras, H×W pixels.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

CHANGED = 16
"""A pixel counts as changed if one of its colours differs by more, of 255."""

DRAWS = 1000
"""Resamples of an interval."""


def bootstrap(groups: np.ndarray, statistic: Callable[[np.ndarray], float]) -> dict[str, float]:
    """``value`` of a statistic of row indices, and its 95 % interval ``low`` to ``high`` by a bootstrap.

    Groups (M,) of rows, such as episodes, are resampled. Draws for which the statistic is NaN are left out.
    """
    rng = np.random.default_rng(0)
    order = np.argsort(groups, kind="stable")
    rows = np.split(order, np.flatnonzero(np.diff(groups[order])) + 1)
    draws = (rng.integers(len(rows), size=len(rows)) for _ in range(DRAWS))
    values = np.array([statistic(np.concatenate([rows[i] for i in drawn])) for drawn in draws])
    values = values[~np.isnan(values)]
    # The nearest draw, since between two infinite ones there is nothing to interpolate.
    low, high = np.quantile(values, [0.025, 0.975], method="nearest") if len(values) else (np.nan, np.nan)
    return {"value": statistic(np.arange(len(groups))), "low": float(low), "high": float(high)}


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


def skill(model: np.ndarray, copy: np.ndarray, groups: np.ndarray) -> dict[str, float]:
    """1 − MSE(model)/MSE(copy), from `squared_errors` of both (M, 2)."""

    def of(rows: np.ndarray) -> float:
        copied = mean_error(copy[rows])
        return 1 - mean_error(model[rows]) / copied if copied > 0 else float("nan")

    return bootstrap(groups, of)


def sensitivity(true: np.ndarray, other: np.ndarray, groups: np.ndarray) -> dict[str, float]:
    """MSE(other actions)/MSE(true actions), from `squared_errors` of both (M, 2); of two exact ones 1."""

    def of(rows: np.ndarray) -> float:
        right, wrong = mean_error(true[rows]), mean_error(other[rows])
        if right > 0:
            return wrong / right
        return float("inf") if wrong > 0 else 1.0

    return bootstrap(groups, of)


def auroc(scores: np.ndarray, labels: np.ndarray) -> float:
    """Chance that a success scores above a failure, ties counting half; NaN without both."""
    difference = scores[labels][:, None] - scores[~labels]
    if not difference.size:
        return float("nan")
    return float(((difference > 0) + 0.5 * (difference == 0)).mean())


def threshold_at(failures: np.ndarray, false_positives: float) -> float:
    """The lowest threshold that at most this share, in [0, 1), of the failures' scores (M ≥ 1,) reaches."""
    falling = np.sort(failures.astype(np.float64))[::-1]
    return float(np.nextafter(falling[int(np.floor(false_positives * len(falling)))], np.inf))


def shuffle_across_groups(groups: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """For each row the index of another one, from another group (its episode) where there is one."""
    rows = np.arange(len(groups))
    chosen = np.empty_like(rows)
    for i in rows:
        others = rows[groups != groups[i]]
        chosen[i] = rng.choice(others if len(others) else rows[rows != i])
    return chosen
