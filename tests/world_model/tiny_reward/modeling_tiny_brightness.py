# SPDX-License-Identifier: Apache-2.0
"""The network."""

from __future__ import annotations

from typing import Any

import torch
from lerobot.rewards.pretrained import PreTrainedRewardModel
from torch import Tensor, nn

from tests.world_model.tiny_reward.configuration_tiny_brightness import TinyBrightnessConfig


class TinyBrightnessRewardModel(PreTrainedRewardModel):
    """P = weight · (mean of the last frame), less that of the first one if there are two."""

    config_class = TinyBrightnessConfig
    name = "tiny_brightness"

    def __init__(self, config: TinyBrightnessConfig, **unused: Any) -> None:
        super().__init__(config)
        self.weight = nn.Parameter(torch.ones(()))

    def compute_reward(self, batch: dict[str, Tensor]) -> Tensor:
        [image] = [batch[name] for name in self.config.input_features]
        if self.config.frames == 1:
            return self.config.scale * self.weight * image.mean((1, 2, 3))
        first, *_, last = image.unbind(1)
        return self.config.scale * self.weight * (0.5 + last.mean((1, 2, 3)) - first.mean((1, 2, 3)))
