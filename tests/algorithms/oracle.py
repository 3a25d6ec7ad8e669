# SPDX-License-Identifier: Apache-2.0
"""Slow NumPy versions of the objectives, written as the papers' formulas, one scalar at a time."""

from __future__ import annotations

import math

import numpy as np

from accerl_lerobot.algorithms import RatioConfig


def gae(
    rewards: np.ndarray,
    values: np.ndarray,
    bootstrap: np.ndarray,
    terminated: np.ndarray,
    lengths: np.ndarray,
    gamma: float,
    lam: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Â_t = Σ_k (γλ)^k δ_{t+k}, summed forwards for every t (the fast version recurses backwards)."""
    advantages, returns = np.zeros_like(rewards), np.zeros_like(rewards)
    for s in range(len(lengths)):
        n = int(lengths[s])
        v = [float(values[s, t]) for t in range(n)]
        v.append(0.0 if terminated[s] else float(bootstrap[s]))
        delta = [float(rewards[s, t]) + gamma * v[t + 1] - v[t] for t in range(n)]
        for t in range(n):
            advantages[s, t] = sum((gamma * lam) ** k * delta[t + k] for k in range(n - t))
            returns[s, t] = advantages[s, t] + v[t]
    return advantages, returns


Ragged = list[list[float]]
"""One list per decision, with an entry for each of its ratios."""


def grouped(x: np.ndarray, level: str, factors: np.ndarray | None = None) -> Ragged:
    """Sums of (N, L) log-probs over what one ratio covers, without factors that do not exist."""
    found: Ragged = []
    for i in range(len(x)):
        row = [float(x[i, j]) for j in range(x.shape[1]) if factors is None or factors[i, j]]
        found.append([sum(row)] if level == "chunk" else row)
    return found


def mean(terms: list[float]) -> float:
    return sum(terms) / len(terms)


def gipo(logs: Ragged, advantage: np.ndarray, sigma: float) -> float:
    """−E[ω ρ Â]."""
    terms = []
    for row, a in zip(logs, advantage, strict=True):
        for x in row:
            weight = math.exp(-0.5 * (x / sigma) ** 2)
            terms.append(weight * math.exp(x) * a)
    return -mean(terms)


def ppo(logs: Ragged, advantage: np.ndarray, low: float, high: float) -> float:
    """−E[min(ρ Â, clip(ρ, 1 − low, 1 + high) Â)]."""
    terms = []
    for row, a in zip(logs, advantage, strict=True):
        for x in row:
            rho = math.exp(x)
            clipped = min(max(rho, 1 - low), 1 + high)
            terms.append(min(rho * a, clipped * a))
    return -mean(terms)


def shared(error: np.ndarray, logs: Ragged, entropy: np.ndarray, config: RatioConfig) -> float:
    """½ · error + kl_coef · KL(μ‖π) − entropy_coef · H, where `logs` are log π/μ."""
    kl = mean([math.exp(x) - 1 - x for row in logs for x in row])
    total = 0.5 * mean(list(error)) + config.kl_coef * kl
    return float(total - config.entropy_coef * mean(list(entropy)))
