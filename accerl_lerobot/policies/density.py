# SPDX-License-Identifier: Apache-2.0
"""Gaussians, and the small parts that families and critic build theirs from."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)


def normal_log_prob(x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """log N(x; mean, std²) of each entry; shapes as they broadcast."""
    z = (x - mean) / std
    return -0.5 * z * z - torch.log(std) - LOG_SQRT_2PI


def normal_entropy(std: Tensor) -> Tensor:
    """Differential entropy of N(·, std²) in nats, of each entry."""
    return torch.log(std) + LOG_SQRT_2PI + 0.5


class BoundedStd:
    """A std between two bounds from a layer's output of any size, by a sigmoid between their logarithms.

    Args:
        low: above 0, what it tends to towards −∞.
        high: what it tends to towards ∞.
    """

    def __init__(self, low: float, high: float) -> None:
        self.low, self.high = math.log(low), math.log(high)

    def __call__(self, raw: Tensor) -> Tensor:
        """The std, of the shape of `raw`, in fp32."""
        return torch.exp(self.low + (self.high - self.low) * torch.sigmoid(raw.float()))

    def start(self, layer: nn.Linear, std: float) -> None:
        """Makes the layer's std equal to `std`, between the bounds, whatever its input."""
        share = (math.log(std) - self.low) / (self.high - self.low)
        nn.init.zeros_(layer.weight)
        nn.init.constant_(layer.bias, math.log(share / (1 - share)))


def pooled(features: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean, fp32 (B, width), of features (B, P, width); weights (B, P) of any sum above 0."""
    weights = weights / weights.sum(-1, keepdim=True)
    return (weights[..., None] * features.float()).sum(1)
