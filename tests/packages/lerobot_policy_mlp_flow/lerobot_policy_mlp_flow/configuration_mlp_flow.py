# SPDX-License-Identifier: Apache-2.0
"""Config of ``mlp_flow``."""

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig


@PreTrainedConfig.register_subclass("mlp_flow")
@dataclass
class MLPFlowConfig(PreTrainedConfig):
    """Flow matching with a small MLP that sees images at 8 × 8 pixels."""

    chunk_size: int = 4
    n_action_steps: int = 4
    num_steps: int = 4
    """Denoising steps."""
    width: int = 64
    lr: float = 1e-3
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
        }
    )

    def validate_features(self) -> None:
        if self.robot_state_feature is None or self.action_feature is None:
            raise ValueError("mlp_flow needs a state and an action")

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=self.lr)

    def get_scheduler_preset(self) -> None:
        return None

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(self.chunk_size))

    @property
    def reward_delta_indices(self) -> None:
        return None
