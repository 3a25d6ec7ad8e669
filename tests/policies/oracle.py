# SPDX-License-Identifier: Apache-2.0
"""The flow likelihood once more, slowly: float64 NumPy, one sample, one step, one entry at a time.

Written from the formulas, not from the code: x ← x − v/N, and after the last step noise of a constant std.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from accerl_lerobot.policies.flow import FlowShape

SlowVelocity = Callable[[np.ndarray, float, int], np.ndarray]
"""(x (K, D), t, which sample of the batch) → v (K, D)."""


def integrate(velocity: SlowVelocity, x0: np.ndarray, shape: FlowShape) -> np.ndarray:
    """(B, K, D) from initial noise (B, K, D)."""
    n = shape.num_steps
    result = np.zeros(x0.shape)
    for b in range(len(x0)):
        x = x0[b].astype(np.float64)
        for k in range(n):
            x = x - velocity(x, (n - k) / n, b) / n
        result[b] = x
    return result


def log_prob(
    velocity: SlowVelocity, x0: np.ndarray, x: np.ndarray, shape: FlowShape, std: float
) -> np.ndarray:
    """(B,) log-density of x (B, K, D) given the initial noise x0 (B, K, D)."""
    means = integrate(velocity, x0, shape)
    result = np.zeros(len(x0))
    for b in range(len(x0)):
        for row in range(shape.executed):
            for dim in range(shape.action_dim):
                z = (float(x[b, row, dim]) - means[b, row, dim]) / std
                result[b] += -0.5 * z**2 - math.log(std * math.sqrt(2 * math.pi))
    return result
