# SPDX-License-Identifier: Apache-2.0
"""Configuration of the success model."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.configs.rewards import RewardModelConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig, OptimizerConfig

from accerl_lerobot.errors import InputError


@RewardModelConfig.register_subclass("success_pairs")
@dataclass
class SuccessPairsConfig(RewardModelConfig):
    """Inputs and sizes of the success model."""

    chunk: int = 10
    """Env steps between the two frames."""
    channels: tuple[int, ...] = (32, 64, 96)
    """Channels of the convolutions, each of which halves the image; the first one does so twice."""
    threshold: float = 0.5
    """P above which a frame counts as a success, in [0, 1]."""
    learning_rate: float = 1e-3
    weight_decay: float = 1e-2
    grad_clip_norm: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.chunk < 1:
            raise InputError("reward_model.chunk", self.chunk, "use at least 1")
        if not 0 <= self.threshold <= 1:
            raise InputError("reward_model.threshold", self.threshold, "use a value in [0, 1]")
        if not self.channels or min(self.channels) < 1:
            raise InputError("reward_model.channels", self.channels, "name at least one width")

    @property
    def observation_delta_indices(self) -> list[int]:
        """The frames before and after a chunk."""
        return [0, self.chunk]

    @property
    def reward_delta_indices(self) -> list[int]:
        """Every reward of the chunk."""
        return list(range(self.chunk))

    def get_optimizer_preset(self) -> OptimizerConfig:
        """See LeRobot."""
        return AdamWConfig(
            lr=self.learning_rate, weight_decay=self.weight_decay, grad_clip_norm=self.grad_clip_norm
        )

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        """See LeRobot."""
        return None
