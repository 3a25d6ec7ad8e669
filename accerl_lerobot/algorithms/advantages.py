# SPDX-License-Identifier: Apache-2.0
"""Advantages: generalised advantage estimation (arXiv 1506.02438) per decision, and their normalisation.

    δ_t = r_t + γ V_{t+1} − V_t
    Â_t = δ_t + γλ Â_{t+1}
    R_t = Â_t + V_t

r_t is the reward summed over a whole chunk, so γ and λ are per decision. What follows the last decision of
a segment: nothing if the episode *terminated* (bootstrap 0), by its time limit too; V of the observation
after it if the segment was cut in mid-episode.

Values must come from the critic of now: those stored with a sample are stale by its lag. *Normalisation* is
over the whole batch: per micro-batch it would compare a decision only with its neighbours.

Shape letters: S segments, T decisions of the longest one.
"""

from __future__ import annotations

import torch
from torch import Tensor

STD_EPSILON = 1e-6  # added to the standard deviation: advantages that are all equal become 0, not noise


def decision_mask(lengths: Tensor, t: int) -> Tensor:
    """bool (S, t), True where a segment of one of the `lengths` (S,) still has a decision."""
    return torch.arange(t, device=lengths.device) < lengths[:, None]


def gae(
    rewards: Tensor,
    values: Tensor,
    bootstrap_value: Tensor,
    terminated: Tensor,
    lengths: Tensor,
    *,
    gamma: float,
    lam: float,
) -> tuple[Tensor, Tensor]:
    """Advantages and returns, each (S, T) and 0 at padding, of segments of `lengths` (S,), without gradient.

    `rewards` (S, T) are summed over each chunk, `values` (S, T) are V before each decision; padding may hold
    anything, NaN included. `bootstrap_value` (S,), V after the last one, does not count where `terminated`,
    bool (S,): True if the episode is over, False for segments cut in mid-episode.
    """
    t = rewards.shape[1]
    padding = ~decision_mask(lengths, t)
    rewards = rewards.detach().masked_fill(padding, 0.0)
    values = values.detach().masked_fill(padding, 0.0)
    after = bootstrap_value.detach().masked_fill(terminated, 0.0)
    last = lengths[:, None] - 1
    next_values = values.roll(-1, dims=1).scatter(1, last, after[:, None])
    delta = rewards + gamma * next_values - values

    advantages = delta.masked_fill(padding, 0.0)
    for i in reversed(range(t - 1)):
        advantages[:, i] += gamma * lam * advantages[:, i + 1]
    returns = advantages + values
    return advantages, returns.masked_fill(padding, 0.0)


def moments(x: Tensor, mask: Tensor) -> Tensor:
    """(sum, sum of squares, count) of the entries where `mask` is True, (3,); others may be NaN.

    In float64, because the variance is the difference of two nearly equal numbers when the mean is large.
    """
    wide = x.detach().double().masked_fill(~mask, 0.0)
    count = mask.sum().double()
    return torch.stack([wide.sum(), wide.square().sum(), count])


def normalise(x: Tensor, moments: Tensor, mask: Tensor) -> Tensor:
    """(x − mean) / (std + `STD_EPSILON`), same shape and dtype as `x`; 0 where `mask` is False.

    `moments` (3,) is of everything that is compared with each other.
    """
    total, squares, count = moments.unbind()
    count = count.clamp(min=1.0)
    mean = total / count
    variance = squares / count - mean.square()
    std = variance.clamp(min=0.0).sqrt()
    scaled = (x.detach().double() - mean) / (std + STD_EPSILON)
    return scaled.to(x.dtype).masked_fill(~mask, 0.0)
