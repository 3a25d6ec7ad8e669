# SPDX-License-Identifier: Apache-2.0
"""Generalised advantage estimation (Schulman et al., arXiv 1506.02438), one step per decision.

    δ_t = r_t + γ V_{t+1} − V_t
    Â_t = δ_t + γλ Â_{t+1}
    R_t = Â_t + V_t

r_t is the reward summed over a whole chunk, so γ and λ are per decision. What follows the last decision of
a segment: nothing if the episode *terminated* (bootstrap 0); V of the observation after it if time ran out
(*truncated*) or the segment was cut in mid-episode. Treating a truncation as a termination would teach the
critic that time limits are deaths.

`values` and `bootstrap_value` must come from the critic of now: those stored with a sample are stale by its
lag.

Shape letters: S segments, T decisions of the longest one.
"""

from __future__ import annotations

import torch
from torch import Tensor


def decision_mask(lengths: Tensor, t: int) -> Tensor:
    """bool (S, t), True where a segment still has a decision.

    Args:
        lengths: int (S,), decisions of each segment.
        t: width of the padded batch.
    """
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
    """Advantages and returns of a padded batch of segments, without gradient.

    Args:
        rewards: (S, T), summed over each chunk. Padding may hold anything, NaN included; so may `values`.
        values: (S, T), V of the observation before each decision.
        bootstrap_value: (S,), V of the observation after the last decision; ignored where `terminated`.
        terminated: bool (S,), the episode is over. False for truncated and for cut segments.
        lengths: int (S,), 1 to T.
        gamma: discount per decision.
        lam: λ per decision.

    Returns:
        Advantages (S, T), not normalised, and returns (S, T), the targets of the critic; both 0 at padding.

    Raises:
        ValueError: shapes disagree or a length is outside 1..T.
    """
    s, t = rewards.shape
    shapes = {"values": (values, (s, t)), "bootstrap_value": (bootstrap_value, (s,))}
    shapes |= {"terminated": (terminated, (s,)), "lengths": (lengths, (s,))}
    for name, (tensor, shape) in shapes.items():
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, not {shape}")
    if s and not bool(((lengths >= 1) & (lengths <= t)).all()):
        raise ValueError(f"lengths {lengths.tolist()}: all must be from 1 to {t}")

    padding = ~decision_mask(lengths, t)
    rewards = rewards.detach().masked_fill(padding, 0.0)
    values = values.detach().masked_fill(padding, 0.0)
    after = bootstrap_value.detach().masked_fill(terminated, 0.0)
    next_values = values.roll(-1, dims=1).scatter(1, lengths[:, None] - 1, after[:, None])
    delta = (rewards + gamma * next_values - values).masked_fill(padding, 0.0)

    advantages = delta.clone()
    for i in reversed(range(t - 1)):
        advantages[:, i] += gamma * lam * advantages[:, i + 1]
    return advantages, (advantages + values).masked_fill(padding, 0.0)
