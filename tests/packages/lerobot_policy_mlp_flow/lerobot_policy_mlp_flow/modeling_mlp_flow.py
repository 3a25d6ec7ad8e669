# SPDX-License-Identifier: Apache-2.0
"""The policy ``mlp_flow``."""

from collections import deque
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor, nn
from torch.nn import functional

from lerobot_policy_mlp_flow.configuration_mlp_flow import MLPFlowConfig

PIXELS = 8


class MLPFlowPolicy(PreTrainedPolicy):
    config_class = MLPFlowConfig
    name = "mlp_flow"

    def __init__(self, config: MLPFlowConfig, **kwargs: Any) -> None:
        super().__init__(config)
        config.validate_features()
        inputs = config.robot_state_feature.shape[0] + 3 * PIXELS**2 * len(config.image_features)
        self.size = (config.chunk_size, config.action_feature.shape[0])
        entries = self.size[0] * self.size[1]
        self.encoder = nn.Sequential(nn.Linear(inputs, config.width), nn.SiLU())
        self.decoder = nn.Sequential(
            nn.Linear(config.width + entries + 1, config.width), nn.SiLU(), nn.Linear(config.width, entries)
        )
        self.reset()

    def reset(self) -> None:
        self._queue: deque[Tensor] = deque()

    def get_optim_params(self) -> list[nn.Parameter]:
        return list(self.parameters())

    def features(self, batch: dict[str, Tensor]) -> Tensor:
        """(B, width) of a preprocessed batch."""
        small = [
            functional.adaptive_avg_pool2d(batch[key], PIXELS).flatten(1)
            for key in self.config.image_features
        ]
        return self.encoder(torch.cat([batch[OBS_STATE], *small], 1))

    def velocity(self, features: Tensor, x: Tensor, t: Tensor) -> Tensor:
        """Velocity field at chunks (B, K, A) and times (B,), from 1, noise, to 0, actions."""
        return self.decoder(torch.cat([features, x.flatten(1), t[:, None]], 1)).view(x.shape)

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        actions = batch[ACTION]
        noise, t = torch.randn_like(actions), torch.rand(len(actions), device=actions.device)
        x = t[:, None, None] * noise + (1 - t[:, None, None]) * actions
        errors = (self.velocity(self.features(batch), x, t) - (noise - actions)).square()
        loss = (errors * ~batch["action_is_pad"][..., None]).mean()
        return loss, {"loss": loss.item()}

    @torch.no_grad()
    def predict_action_chunk(
        self, batch: dict[str, Tensor], noise: Tensor | None = None, **kwargs: Any
    ) -> Tensor:
        features, steps = self.features(batch), self.config.num_steps
        x = torch.randn(len(features), *self.size, device=features.device) if noise is None else noise
        for step in range(steps):
            x = x - self.velocity(features, x, x.new_full((len(x),), 1 - step / steps)) / steps
        return x

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        if not self._queue:
            chunk = self.predict_action_chunk(batch, **kwargs)
            self._queue.extend(chunk[:, : self.config.n_action_steps].transpose(0, 1))
        return self._queue.popleft()
