# SPDX-License-Identifier: Apache-2.0
"""V(observation) from the policy's own features: one number, or a distribution over returns."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from accerl_lerobot.policies.config import ValueHeadConfig
from accerl_lerobot.policies.density import pooled


@dataclass(frozen=True, kw_only=True)
class Value:
    """The critic's output for a batch."""

    mean: Tensor
    """(B,), V."""
    logits: Tensor | None = None
    """(B, bins), over `support`; None where V is one number."""
    support: Tensor | None = None
    """(bins,), evenly spaced returns."""

    def error(self, returns: Tensor) -> Tensor:
        """Regression loss per observation: squared error, or cross-entropy with two-hot targets.

        Two-hot: a return between two of the support's is split between them such that the mean is kept
        (Farebrother et al., arXiv 2403.03950).

        Args:
            returns: (B,).
        """
        if self.logits is None or self.support is None:
            return (self.mean - returns).square()
        return -(two_hot(returns, self.support) * torch.log_softmax(self.logits, -1)).sum(-1)


def two_hot(x: Tensor, support: Tensor) -> Tensor:
    """(B,) to weights (B, bins) on the two nearest entries of `support`, whose mean is x, clamped to it."""
    place = (x.to(support) - support[0]) / (support[1] - support[0])
    place = place.clamp(0, len(support) - 1)
    low = place.floor().clamp(max=len(support) - 2)
    weights = place.new_zeros(*x.shape, len(support))
    weights.scatter_(-1, low.long()[..., None], (1 - (place - low))[..., None])
    return weights.scatter_add_(-1, low.long()[..., None] + 1, (place - low)[..., None])


class ValueHead(nn.Module):
    """Pooling, LayerNorm, Linear, ReLU, Linear; starts at V = 0, or at a uniform distribution.

    Initial weights depend on the last `torch.manual_seed` alone, not on what was drawn since: how a policy is
    loaded must not change its critic.
    """

    def __init__(self, width: int, config: ValueHeadConfig) -> None:
        super().__init__()
        self.config = config
        self.query = nn.Parameter(torch.zeros(width)) if config.pooling == "attention" else None
        self.norm = nn.LayerNorm(width)
        self.hidden = nn.Linear(width, config.hidden)
        bound, generator = width**-0.5, torch.Generator().manual_seed(torch.initial_seed() % 2**63)
        for parameter in self.hidden.parameters():  # as nn.Linear begins
            nn.init.uniform_(parameter, -bound, bound, generator=generator)
        self.out = nn.Linear(config.hidden, max(1, config.bins))
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)
        support = torch.linspace(*config.value_range, config.bins) if config.bins else None
        self.register_buffer("support", support, persistent=False)

    def forward(self, features: Tensor, mask: Tensor) -> Value:
        """Args: features (B, P, width) and mask (B, P) bool, True where a token is real."""
        features = features.detach() if self.config.detach else features
        features = features.float()
        if self.query is None:
            weights = mask
        else:
            scores = (features @ self.query) / features.shape[-1] ** 0.5
            weights = torch.softmax(scores.masked_fill(~mask, float("-inf")), -1)
        out = self.out(torch.relu(self.hidden(self.norm(pooled(features, weights))))).float()
        if self.support is None:
            return Value(mean=out[:, 0])
        return Value(mean=torch.softmax(out, -1) @ self.support, logits=out, support=self.support)
