# SPDX-License-Identifier: Apache-2.0
"""Our smolvla_bins: bins of all action dimensions in one pass; the critic reads the action queries."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from accerl_lerobot.policies.family import Encoded
from accerl_lerobot.policies.tokens import TokenContext, TokenModel


class SmolVLABins(TokenModel):
    """Drives `bins_plugin`'s policy; queries of rows that are not executed have no token.

    Args:
        policy: a loaded one.
    """

    backbone = "model.vlm."
    parallel = True
    terminator = None

    def __init__(self, policy: Any) -> None:
        self.policy = policy
        self.rows = int(policy.config.n_action_steps)
        self.length = self.rows * policy.config.action_feature.shape[0]
        self.width = policy.model.head.in_features

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        """See the base class; the features are the queries' hidden states, as in AcceRL."""
        hidden = self.policy.hidden(batch)
        logits = self.policy.model.logits(hidden[:, : self.length])
        mask = torch.ones(hidden.shape[:2], dtype=torch.bool, device=hidden.device)
        return Encoded(features=hidden, mask=mask, context=TokenContext(logits=lambda tokens: logits))

    def chunk(self, tokens: Tensor) -> Tensor:
        """See the base class."""
        chunk: Tensor = self.policy.decode_tokens(tokens).view(len(tokens), self.rows, -1)
        return chunk

    def stock(self, batch: dict[str, Tensor]) -> Tensor:
        """See the base class."""
        chunk: Tensor = self.policy.predict_action_chunk(batch)[:, : self.rows]
        return chunk
