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
"""Slow NumPy versions of the objectives, written as the papers' formulas, one scalar at a time."""

from __future__ import annotations

import math

import numpy as np

from accerl_lerobot.algorithms import AlgorithmConfig


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


def log_ratios(new: np.ndarray, old: np.ndarray, level: str) -> np.ndarray:
    """(N, L) or (N, 1)."""
    if level == "action":
        return new - old
    return np.array([[sum(new[i, j] - old[i, j] for j in range(new.shape[1]))] for i in range(len(new))])


def gipo(logs: np.ndarray, advantage: np.ndarray, sigma: float, sigma_negative: float) -> float:
    """−E[ω ρ Â]."""
    terms = []
    for i in range(logs.shape[0]):
        width = sigma if advantage[i] > 0 else sigma_negative
        for j in range(logs.shape[1]):
            weight = math.exp(-0.5 * (logs[i, j] / width) ** 2)
            terms.append(weight * math.exp(logs[i, j]) * advantage[i])
    return -sum(terms) / len(terms)


def ppo(logs: np.ndarray, advantage: np.ndarray, low: float, high: float) -> float:
    """−E[min(ρ Â, clip(ρ, 1 − low, 1 + high) Â)]."""
    terms = []
    for i in range(logs.shape[0]):
        for j in range(logs.shape[1]):
            rho = math.exp(logs[i, j])
            clipped = min(max(rho, 1 - low), 1 + high)
            terms.append(min(rho * advantage[i], clipped * advantage[i]))
    return -sum(terms) / len(terms)


def shared(
    value: np.ndarray, returns: np.ndarray, logs: np.ndarray, entropy: np.ndarray, config: AlgorithmConfig
) -> float:
    """value_coef · MSE + kl_coef · KL − entropy_coef · H."""
    mse = sum((v - r) ** 2 for v, r in zip(value, returns, strict=True)) / len(value)
    kl = float(np.mean([math.exp(x) - 1 - x for x in logs.flatten()]))
    return float(config.value_coef * mse + config.kl_coef * kl - config.entropy_coef * entropy.mean())
