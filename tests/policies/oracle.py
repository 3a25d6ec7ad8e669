# SPDX-License-Identifier: Apache-2.0
"""The flow likelihood once more, slowly: float64 NumPy, one sample, one step, one entry at a time.

Written from the formulas, not from the code: μ = x − δv (euler), or x − δv − (δσ²/2t)(x + (1−t)v) with
σ = a·√(t/(1−t)) and 1−t₁ in the denominator at t = 1 (flow_sde).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from accerl_lerobot.policies.config import FlowSamplerConfig
from accerl_lerobot.policies.flow import FlowShape

SlowVelocity = Callable[[np.ndarray, float, int], np.ndarray]
"""(x (K, D), t, which sample of the batch) → v (K, D)."""


def std(k: int, n: int, config: FlowSamplerConfig) -> float:
    """Std of step k; a learned one is passed to `log_prob` instead."""
    if config.noise == "euler":
        return config.noise_level / (math.sqrt(n) if config.stochastic == "all" else 1.0)
    t, remaining = (n - k) / n, max(k, 1) / n
    return config.noise_level * math.sqrt(t / remaining) * math.sqrt(1 / n)


def mean(x: float, v: float, k: int, n: int, config: FlowSamplerConfig) -> float:
    if config.noise != "flow_sde":
        return x - v / n
    t = (n - k) / n
    return x - v / n - std(k, n, config) ** 2 / (2 * t) * (x + (1 - t) * v)


def density(x: float, centre: float, scale: float) -> float:
    return -0.5 * ((x - centre) / scale) ** 2 - math.log(scale * math.sqrt(2 * math.pi))


def counts(k: int, row: int, dim: int, shape: FlowShape) -> bool:
    """True if entry (row, dim) of step k's outcome belongs to the density."""
    if k == shape.num_steps - 1:
        return row < shape.executed and dim < shape.action_dim
    return True


def drawn(config: FlowSamplerConfig, n: int) -> list[int]:
    """The stochastic steps."""
    return list(range(n)) if config.stochastic == "all" else [n - 1]


def paths(
    velocity: SlowVelocity,
    x0: np.ndarray,
    eps: np.ndarray,
    shape: FlowShape,
    config: FlowSamplerConfig,
) -> np.ndarray:
    """(B, N + 1, K, D), every sample exploring."""
    n = shape.num_steps
    result = np.zeros((len(x0), n + 1, shape.chunk_size, shape.padded_dim))
    for b in range(len(x0)):
        x = x0[b].astype(np.float64)
        result[b, 0] = x
        for k in range(n):
            v = velocity(x, (n - k) / n, b)
            following = np.zeros_like(x)
            for i in range(shape.chunk_size):
                for j in range(shape.padded_dim):
                    following[i, j] = x[i, j] - v[i, j] / n
                    if k in drawn(config, n):
                        noise = std(k, n, config) * eps[b, k, i, j]
                        following[i, j] = mean(x[i, j], v[i, j], k, n, config) + noise
            x = result[b, k + 1] = following
    return result


def log_prob(
    velocity: SlowVelocity,
    path: np.ndarray,
    shape: FlowShape,
    config: FlowSamplerConfig,
) -> np.ndarray:
    """(B,) from whole paths (B, N + 1, K, D), of which under ``last`` only the two ends are read."""
    n = shape.num_steps
    result = np.zeros(len(path))
    for b in range(len(path)):
        for k in drawn(config, n):
            start = path[b, k].astype(np.float64)
            if config.stochastic == "last":
                start = path[b, 0].astype(np.float64)
                for earlier in range(n - 1):
                    start = start - velocity(start, (n - earlier) / n, b) / n
            v = velocity(start, (n - k) / n, b)
            for i in range(shape.chunk_size):
                for j in range(shape.padded_dim):
                    if counts(k, i, j, shape):
                        centre = mean(start[i, j], v[i, j], k, n, config)
                        scale = std(k, n, config)
                        result[b] += density(path[b, k + 1, i, j], centre, scale)
    return result
