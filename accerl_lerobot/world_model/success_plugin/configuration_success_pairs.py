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
    hidden: int = 128
    """Width of the layer behind them."""
    success_reward: float = 0.5
    """A ``next.reward`` above it is a success; datasets of ``accerl demos`` give 1."""
    threshold: float = 0.5
    """P above which a frame counts as a success, in [0, 1]."""
    alone: float = 0.25
    """Share of pairs, in [0, 1], whose first frame is replaced by the second in training, so that the second
    frame is judged and not their distance."""
    noise: float = 0.03
    """Largest standard deviation of the noise on frames in training, where 1 is white; ≥ 0."""
    shift: int = 3
    """Largest shift of the frames in training, in pixels; ≥ 0. Both frames of a pair are shifted alike."""
    learning_rate: float = 1e-3
    weight_decay: float = 1e-2
    grad_clip_norm: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, least in (("chunk", 1), ("hidden", 1), ("shift", 0), ("noise", 0)):
            if getattr(self, name) < least:
                raise InputError(f"reward_model.{name}", getattr(self, name), f"use at least {least}")
        for name in ("threshold", "alone"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"reward_model.{name}", getattr(self, name), "use a value in [0, 1]")
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
