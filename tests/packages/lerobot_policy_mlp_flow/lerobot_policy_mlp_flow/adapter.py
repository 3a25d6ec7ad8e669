# SPDX-License-Identifier: Apache-2.0
"""The likelihood of ``mlp_flow``: that of the flow family, of which this is the velocity field."""

from typing import Any

import torch
from torch import Tensor

from accerl_lerobot.policies.family import Encoded
from accerl_lerobot.policies.flow import FlowModel, FlowShape


class MLPFlow(FlowModel):
    def __init__(self, policy: Any) -> None:
        self.policy, config = policy, policy.config
        self.width = config.width
        self.shape = FlowShape(
            num_steps=config.num_steps,
            chunk_size=config.chunk_size,
            executed=config.n_action_steps,
            padded_dim=config.action_feature.shape[0],
            action_dim=config.action_feature.shape[0],
        )

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        features = self.policy.features(batch)

        def velocity(x: Tensor, t: Tensor) -> Tensor:
            return self.policy.velocity(features, x, t).float()

        return Encoded(
            features=features[:, None],  # one token, for the critic
            mask=torch.ones(len(features), 1, dtype=torch.bool, device=features.device),
            context=velocity,
        )
