# SPDX-License-Identifier: Apache-2.0
"""A random ``smolvla_bins`` of some 30 k parameters that fits ``SimulatedConfig()``."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def write_bins(
    directory: Path,
    *,
    chunk: int = 4,
    executed: int = 4,
    num_bins: int = 32,
    action_range: tuple[float, float] = (-1.0, 1.0),
    seed: int = 0,
    **fields: Any,
) -> Path:
    """Saves it as a LeRobot ``pretrained_model`` folder; its backbone lies beside it."""
    import torch
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors

    from accerl_lerobot.policies.backbone import BackboneConfig, write_backbone
    from accerl_lerobot.policies.plugins import register_policies

    register_policies()
    sizes = BackboneConfig(
        hidden=32, heads=2, kv_heads=1, vision_hidden=16, vision_layers=1, vision_heads=2, patch=8, image=32
    )
    backbone = write_backbone(directory.parent / f"{directory.name}-backbone", sizes, ["Match the target"])
    options: dict[str, Any] = {
        "input_features": {
            "observation.images.front": PolicyFeature(type=FeatureType.VISUAL, shape=(3, 32, 32)),
            "observation.state": PolicyFeature(type=FeatureType.STATE, shape=(4,)),
        },
        "output_features": {"action": PolicyFeature(type=FeatureType.ACTION, shape=(2,))},
        "device": "cpu",
        "push_to_hub": False,
        "vlm_model_name": str(backbone),
        "load_vlm_weights": False,
        "num_vlm_layers": 2,
        "chunk_size": chunk,
        "n_action_steps": executed,
        "num_bins": num_bins,
        "resize_imgs_with_padding": (32, 32),
        "freeze_vision_encoder": False,
    }
    config = make_policy_config("smolvla_bins", **options | fields)
    torch.manual_seed(seed)
    policy = get_policy_class("smolvla_bins")(config)
    low, high = (torch.full((2,), bound) for bound in action_range)
    stats = {
        "observation.state": {"mean": torch.zeros(4), "std": torch.full((4,), 0.5)},
        "action": {"min": low, "max": high},
    }
    for part in (policy, *make_pre_post_processors(config, dataset_stats=stats)):
        part.save_pretrained(directory)
    return directory
