# SPDX-License-Identifier: Apache-2.0
"""Inputs of the reward model, and its answer."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.configs.rewards import RewardModelConfig


@RewardModelConfig.register_subclass("tiny_brightness")
@dataclass
class TinyBrightnessConfig(RewardModelConfig):
    """A film of `frames`, a chunk apart; with `scale` above 1 the answer is no probability."""

    frames: int = 1
    chunk: int = 2
    scale: float = 1.0

    @property
    def observation_delta_indices(self) -> list[int] | None:
        return None if self.frames == 1 else [self.chunk * i for i in range(self.frames)]
