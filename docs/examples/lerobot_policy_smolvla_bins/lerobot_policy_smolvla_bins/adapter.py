# SPDX-License-Identifier: Apache-2.0
"""The likelihood of ``smolvla_bins``: that of the token family, with all logits from one pass."""

from typing import Any

import torch
from torch import Tensor

from accerl_lerobot.policies.family import Encoded
from accerl_lerobot.policies.tokens import TokenContext, TokenModel


class SmolVLABins(TokenModel):
    """Drives `SmolVLABinsPolicy`; queries of rows that are not executed have no token."""

    backbone = "model.vlm."
    blocks = r"model\.vlm\.(vision_model\.encoder|text_model)\.layers\.\d+"
    terminator = None

    def __init__(self, policy: Any) -> None:
        super().__init__(policy)
        self.rows = int(policy.config.n_action_steps)
        self.length = self.rows * policy.config.action_feature.shape[0]
        self.width = policy.model.head.in_features

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        """The features are the queries' hidden states, as in AcceRL."""
        hidden = self.policy.hidden(batch)
        logits = self.policy.model.logits(hidden[:, : self.length])
        mask = torch.ones(hidden.shape[:2], dtype=torch.bool, device=hidden.device)
        return Encoded(features=hidden, mask=mask, context=TokenContext(logits=lambda tokens: logits))

    def chunk(self, tokens: Tensor) -> Tensor:
        return self.policy.decode_tokens(tokens).view(len(tokens), self.rows, -1)

    def stock(self, batch: dict[str, Tensor], **noise: Tensor) -> Tensor:
        return super().stock(batch, **noise)[:, : self.rows]
