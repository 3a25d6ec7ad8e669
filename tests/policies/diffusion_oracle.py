# SPDX-License-Identifier: Apache-2.0
"""The denoising chain once more, slowly: float64 NumPy, one sample, one step, one entry at a time.

Written from the formulas of arXiv 2006.11239 (the posterior q(x_{t−1} | x_t, x_0)), arXiv 2010.02502 (eq. 12)
and the cosine schedule of arXiv 2102.09672, not from the code.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

SlowNetwork = Callable[[np.ndarray, int], np.ndarray]
"""(x (H, A), timestep) → prediction (H, A)."""


def cumulative_alphas(train_steps: int) -> list[float]:
    """ᾱ of every training timestep: cosine schedule, each β at most 0.999."""

    def bar(share: float) -> float:
        return math.cos((share + 0.008) / 1.008 * math.pi / 2) ** 2

    product, found = 1.0, []
    for i in range(train_steps):
        beta = min(1 - bar((i + 1) / train_steps) / bar(i / train_steps), 0.999)
        product *= 1 - beta
        found.append(product)
    return found


def moments(
    x: float, output: float, t: int, following: int, train_steps: int, rule: dict
) -> tuple[float, float]:
    """Mean and std of one entry's step from timestep t to `following`, −1 for none.

    Args:
        rule: scheduler, prediction, clip.
    """
    alphas = cumulative_alphas(train_steps)
    a, b = alphas[t], alphas[following] if following >= 0 else 1.0
    if rule["prediction"] == "epsilon":
        noise, clean = output, (x - math.sqrt(1 - a) * output) / math.sqrt(a)
    else:
        noise, clean = (x - math.sqrt(a) * output) / math.sqrt(1 - a), output
    if rule["clip"] is not None:
        clean = min(max(clean, -rule["clip"]), rule["clip"])
    # The noising from `following` to t scales by √(a/b) and adds variance 1 − a/b.
    variance = (1 - a / b) * (1 - b) / (1 - a)
    if rule["scheduler"] == "DDIM":
        return math.sqrt(b) * clean + math.sqrt(max(0.0, 1 - b - variance)) * noise, math.sqrt(variance)
    # Product of two Gaussians in x_following: N(√b·x̂, 1 − b) and the likelihood of x given it.
    if b == 1.0:
        return clean, 0.0
    precision = 1 / (1 - b) + (a / b) / (1 - a / b)
    return (math.sqrt(b) * clean / (1 - b) + math.sqrt(a / b) * x / (1 - a / b)) / precision, math.sqrt(
        1 / precision
    )


def log_prob(
    network: SlowNetwork,
    path: np.ndarray,
    timesteps: list[int],
    train_steps: int,
    executed: slice,
    std_min: float,
    rule: dict,
) -> np.ndarray:
    """(H,) of one stored chain (C + 1, H, A), whose steps are the last C of `timesteps`."""
    horizon, dims = path.shape[1:]
    result = np.zeros(horizon)
    counted = timesteps[len(timesteps) - (len(path) - 1) :]
    for i, t in enumerate(counted):
        following = counted[i + 1] if i + 1 < len(counted) else -1
        output = network(path[i], t)
        for row in range(horizon):
            if following < 0 and not executed.start <= row < executed.stop:
                continue
            for dim in range(dims):
                mean, std = moments(
                    float(path[i, row, dim]), float(output[row, dim]), t, following, train_steps, rule
                )
                std = max(std, std_min)
                z = (path[i + 1, row, dim] - mean) / std
                result[row] += -0.5 * z * z - math.log(std * math.sqrt(2 * math.pi))
    return result
