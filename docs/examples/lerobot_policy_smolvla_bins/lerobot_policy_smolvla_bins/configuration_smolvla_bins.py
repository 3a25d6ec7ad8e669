# SPDX-License-Identifier: Apache-2.0
"""Config of ``smolvla_bins``; fields it shares with LeRobot's smolvla have smolvla's names and meaning."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig


@PreTrainedConfig.register_subclass("smolvla_bins")
@dataclass
class SmolVLABinsConfig(PreTrainedConfig):
    """A vision-language model, a query token per action dimension of a chunk, and a head onto bins."""

    chunk_size: int = 8  # actions of a chunk
    n_action_steps: int = 8  # executed actions among these
    num_bins: int = 256
    """Bins per action dimension, of equal width over [-1, 1] in normalised units; an action beyond is taken
    as the outermost bin."""

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MIN_MAX,
        }
    )
    """Actions must come to [-1, 1]: MIN_MAX, or QUANTILES, which spends no bins on outliers and cannot
    reproduce them. MIN_MAX, because LeRobot takes a dataset's quantile to be the mean of its episodes'
    quantiles: a movement that few episodes need would be cut off in all of them."""

    vlm_model_name: str = "HuggingFaceTB/SmolVLM2-500M-Video-Instruct"  # Hub id or folder of a SmolVLM
    load_vlm_weights: bool = True
    """Start a new policy from that model's weights instead of random ones; unlike in smolvla, where
    random ones are the default. False in every checkpoint, whose own file holds the weights."""
    num_vlm_layers: int = 16  # how many of its language-model layers are kept, the first ones; 0 keeps all
    freeze_vision_encoder: bool = True
    freeze_language_model: bool = False
    """True trains only queries, state projection, head and the images' connector."""
    resize_imgs_with_padding: tuple[int, int] | None = (512, 512)  # width and height
    tokenizer_max_length: int = 48
    pad_language_to: str = "longest"

    optimizer_lr: float = 1e-4
    optimizer_betas: tuple[float, float] = (0.9, 0.95)
    optimizer_eps: float = 1e-8
    optimizer_weight_decay: float = 1e-10
    optimizer_grad_clip_norm: float = 10
    scheduler_warmup_steps: int = 1_000
    scheduler_decay_steps: int = 30_000
    scheduler_decay_lr: float = 2.5e-6

    discover_packages_path: str = "lerobot_policy_smolvla_bins"
    """Where this type comes from. A field, because LeRobot 0.6.1 takes the flag
    ``--policy.discover_packages_path`` for an override of the config when ``--policy.path`` is given too."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.n_action_steps <= self.chunk_size:
            raise ValueError(f"n_action_steps={self.n_action_steps}: use 1 to chunk_size={self.chunk_size}")
        if self.num_bins < 2:
            raise ValueError(f"num_bins={self.num_bins}: use at least 2")
        bounded = (NormalizationMode.MIN_MAX, NormalizationMode.QUANTILES)
        if (mode := self.normalization_mapping.get("ACTION")) not in bounded:
            raise ValueError(f"normalization_mapping.ACTION={mode}: bins need MIN_MAX or QUANTILES")

    def validate_features(self) -> None:
        if not self.image_features:
            raise ValueError("smolvla_bins needs at least one image among its input features")
        if self.action_feature is None:
            raise ValueError("smolvla_bins needs an action among its output features")

    get_optimizer_preset = SmolVLAConfig.get_optimizer_preset
    get_scheduler_preset = SmolVLAConfig.get_scheduler_preset
    action_delta_indices = SmolVLAConfig.action_delta_indices
    observation_delta_indices = reward_delta_indices = None
