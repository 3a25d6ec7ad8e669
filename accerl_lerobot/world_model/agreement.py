# SPDX-License-Identifier: Apache-2.0
"""Agreement of dreams with reality about policies.

Two things are asked. Between policies: does the one that succeeds more often in dreams succeed more often in
reality? Within one: do dreams and reality agree, start by start? The first is what choosing between policies
needs, the second what learning does.

NumPy only. P policies, N starts, the same for all of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from accerl_lerobot.world_model.judge import Estimate, ranks

DRAWS = 1000


def agreement(real: np.ndarray, dreamt: np.ndarray, seed: int = 0) -> dict[str, Any]:
    """Everything, with 95 % percentile bootstraps over policies and starts, both drawn again.

    Args:
        real: bool (P, N), outcomes.
        dreamt: bool (P, N), of the same policies from the same starts.
        seed: of the resampling.

    Returns:
        Estimates as dicts: ``pearson`` and ``spearman`` of the P rates; ``mmrv``, see there; ``bias``, the
        mean of dreamt less real rates; ``slope`` of the real rate over the dreamt one; ``mcc``, the mean over
        policies of `matthews`. A number that cannot be had is NaN.

    Raises:
        ValueError: the arrays are not of the same policies and starts, or there are none.
    """
    if real.shape != dreamt.shape or real.ndim != 2 or not real.size:
        raise ValueError(f"outcomes {real.shape} and {dreamt.shape}: both must be (P, N)")
    rng = np.random.default_rng(seed)
    found = _all(real, dreamt)
    policies, starts = real.shape
    draws = []
    for _ in range(DRAWS):
        rows, columns = rng.integers(policies, size=policies), rng.integers(starts, size=starts)
        draws.append(_all(real[rows][:, columns], dreamt[rows][:, columns]))
    return {name: _estimate(value, [draw[name] for draw in draws])._asdict() for name, value in found.items()}


def even_threshold(real: np.ndarray, said: np.ndarray) -> float:
    """The threshold at which about as many dreams succeed as episodes did, all policies taken together.

    Args:
        real: bool (P, N), outcomes.
        said: float (P, N), the highest P(success) of a dream of each.

    Returns:
        In [0, 1], in the middle between two values of `said`, or between one and an end of that range.
    """
    values = np.concatenate([[0.0], np.unique(said), [1.0]])
    cuts = (values[1:] + values[:-1]) / 2
    above = (said.reshape(-1, 1) > cuts).sum(0)
    return float(cuts[np.argmin(np.abs(above - real.sum()))])


def pearson(x: np.ndarray, y: np.ndarray) -> float:
    """Correlation; NaN where one of them does not vary."""
    x, y = x - x.mean(), y - y.mean()
    size = float(np.sqrt((x * x).sum() * (y * y).sum()))
    return float((x * y).sum() / size) if size > 1e-12 else float("nan")


def spearman(x: np.ndarray, y: np.ndarray) -> float:
    """Correlation of ranks; ties have their mean rank."""
    return pearson(ranks(x), ranks(y))


def mmrv(real: np.ndarray, dreamt: np.ndarray) -> float:
    """Mean maximum rank violation, of rates (P,) (Li et al. 2024, SIMPLER, arXiv 2405.05941); 0 is best.

    For each policy, by how much the most different one that dreams put on the wrong side of it differs in
    reality.
    """
    apart = np.abs(real[:, None] - real[None])
    wrong = (real[:, None] < real[None]) != (dreamt[:, None] < dreamt[None])
    return float((apart * wrong).max(1).mean())


def matthews(real: np.ndarray, dreamt: np.ndarray) -> float:
    """Matthews' correlation of outcomes (N,); NaN where one of them does not vary."""
    return pearson(real.astype(np.float64), dreamt.astype(np.float64))


def _all(real: np.ndarray, dreamt: np.ndarray) -> dict[str, float]:
    happened, promised = real.mean(1), dreamt.mean(1)
    within = [matthews(r, d) for r, d in zip(real, dreamt, strict=True)]
    known = [x for x in within if not np.isnan(x)]
    spread = float(np.square(promised - promised.mean()).sum())
    joint = float(((promised - promised.mean()) * (happened - happened.mean())).sum())
    return {
        "pearson": pearson(promised, happened),
        "spearman": spearman(promised, happened),
        "mmrv": mmrv(happened, promised),
        "bias": float((promised - happened).mean()),
        "slope": joint / spread if spread > 1e-12 else float("nan"),
        "mcc": float(np.mean(known)) if known else float("nan"),
    }


def _estimate(value: float, draws: list[float]) -> Estimate:
    known = np.array([x for x in draws if not np.isnan(x)])
    low, high = np.quantile(known, [0.025, 0.975]) if len(known) else (np.nan, np.nan)
    return Estimate(value, float(low), float(high))
