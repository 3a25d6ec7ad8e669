# SPDX-License-Identifier: Apache-2.0
"""Fixtures shared by all tests: offline, and one tiny checkpoint of LeRobot's own SmolVLA class."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from accerl_lerobot.engine import ray_session  # noqa: E402

ray_session.prepare()


def write_smolvla(
    directory: Path,
    *,
    camera: str = "observation.images.front",
    image: int = 32,
    state_dim: int = 4,
    action_dim: int = 2,
    padded_dim: int = 2,
    chunk: int = 4,
    executed: int = 4,
    num_steps: int = 3,
    seed: int = 0,
) -> Path:
    """Saves a random SmolVLA with identity-like normalisation as a LeRobot ``pretrained_model`` folder."""
    import torch
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors

    from accerl_lerobot.demos.backbone import BackboneConfig, write_backbone

    sizes = BackboneConfig(
        hidden=32,
        heads=2,
        kv_heads=1,
        vision_hidden=16,
        vision_layers=1,
        vision_heads=2,
        patch=8,
        image=image,
    )
    backbone = write_backbone(directory.parent / f"{directory.name}-backbone", sizes, ["Match the target"])
    config = make_policy_config(
        "smolvla",
        input_features={
            camera: PolicyFeature(type=FeatureType.VISUAL, shape=(3, image, image)),
            "observation.state": PolicyFeature(type=FeatureType.STATE, shape=(state_dim,)),
        },
        output_features={"action": PolicyFeature(type=FeatureType.ACTION, shape=(action_dim,))},
        device="cpu",
        push_to_hub=False,
        vlm_model_name=str(backbone),
        load_vlm_weights=False,
        num_vlm_layers=2,
        num_expert_layers=2,
        chunk_size=chunk,
        n_action_steps=executed,
        max_state_dim=state_dim,
        max_action_dim=padded_dim,
        resize_imgs_with_padding=(image, image),
        num_steps=num_steps,
        tokenizer_max_length=48,
        expert_width_multiplier=1.0,
        train_expert_only=False,
        freeze_vision_encoder=False,
    )
    torch.manual_seed(seed)
    policy = get_policy_class("smolvla")(config)
    stats = {
        "observation.state": {"mean": torch.zeros(state_dim), "std": torch.full((state_dim,), 0.5)},
        "action": {"mean": torch.zeros(action_dim), "std": torch.full((action_dim,), 0.5)},
    }
    for part in (policy, *make_pre_post_processors(config, dataset_stats=stats)):
        part.save_pretrained(directory)
    return directory


@pytest.fixture(scope="session")
def tiny_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A random SmolVLA that fits ``SimulatedConfig()``; about 0.1 M parameters."""
    return write_smolvla(tmp_path_factory.mktemp("tiny") / "pretrained_model")
