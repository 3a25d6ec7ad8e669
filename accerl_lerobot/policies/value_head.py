# SPDX-License-Identifier: Apache-2.0
"""The critic: V(observation) from the policy's own features."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from accerl_lerobot.policies.config import ValueHeadConfig
from accerl_lerobot.policies.family import pooled


class ValueHead(nn.Module):
    """Attention of one learned query over the features, LayerNorm, Linear, ReLU, Linear; starts at V = 0.

    Initial weights depend on the last `torch.manual_seed` alone, not on what was drawn since: how a policy is
    loaded must not change its critic.
    """

    def __init__(self, width: int, config: ValueHeadConfig) -> None:
        super().__init__()
        self.config = config
        self.query = nn.Parameter(torch.zeros(width))
        self.norm = nn.LayerNorm(width)
        self.hidden = nn.Linear(width, config.hidden)
        bound, generator = width**-0.5, torch.Generator().manual_seed(torch.initial_seed() % 2**63)
        for parameter in self.hidden.parameters():  # as nn.Linear begins
            nn.init.uniform_(parameter, -bound, bound, generator=generator)
        self.out = nn.Linear(config.hidden, 1)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, features: Tensor, mask: Tensor) -> Tensor:
        """V (B,) from features (B, P, width) and mask (B, P) bool, True where a token is real."""
        features = (features.detach() if self.config.detach else features).float()
        scores = (features @ self.query) / features.shape[-1] ** 0.5
        weights = torch.softmax(scores.masked_fill(~mask, float("-inf")), -1)
        return self.out(torch.relu(self.hidden(self.norm(pooled(features, weights))))).float()[:, 0]
