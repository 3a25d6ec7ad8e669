# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of LeRobot's small policies, written offline with random weights."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors
from transformers import BertTokenizer, CLIPTextConfig, CLIPTextModel, CLIPVisionConfig, CLIPVisionModel

from accerl_lerobot.demos.backbone import BackboneConfig, write_backbone


def write_policy(
    directory: Path,
    kind: str,
    *,
    image: int = 16,
    camera: str = "observation.images.front",
    state_dim: int = 4,
    action_dim: int = 2,
    stats: dict[str, Any] | None = None,
    seed: int = 0,
    prepare: Callable[[Any], None] = lambda policy: None,
    **fields: Any,
) -> Path:
    """Saves a new policy and its processors as a LeRobot ``pretrained_model`` folder.

    By the default `stats`, states and actions have a std of 0.5 around 0, or lie within ±2. `prepare` changes
    the weights before they are saved; `fields` are of LeRobot's policy config.
    """
    sizes = {"observation.state": state_dim, "action": action_dim}
    options: dict[str, Any] = {
        "input_features": {
            camera: PolicyFeature(FeatureType.VISUAL, (3, image, image)),
            "observation.state": PolicyFeature(FeatureType.STATE, (state_dim,)),
        },
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (action_dim,))},
        "device": "cpu",
        "push_to_hub": False,
    }
    known = {field.name for field in dataclasses.fields(PreTrainedConfig.get_choice_class(kind))}
    if "action_dim" in known:
        options["action_dim"] = action_dim
    config = make_policy_config(kind, **options | fields)
    torch.manual_seed(seed)
    policy = get_policy_class(kind)(config)
    values = {"mean": 0.0, "std": 0.5, "min": -2.0, "max": 2.0, "q01": -0.5, "q99": 0.5}
    statistics = {
        key: {name: torch.full((size,), value) for name, value in values.items()}
        for key, size in sizes.items()
    }
    statistics[camera] = {"mean": torch.zeros(3, 1, 1), "std": torch.ones(3, 1, 1)}
    processors = make_pre_post_processors(config, dataset_stats=statistics | (stats or {}))
    prepare(policy)
    for part in (policy, *processors):
        part.save_pretrained(directory)
    return directory


def with_backbone(directory: Path, image: int) -> dict[str, Any]:
    """Fields of a policy on a tiny SmolVLM, which is written beside the policy's folder."""
    vision = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    backbone = write_backbone(
        directory.parent / f"{directory.name}-backbone",
        ["Match the target"],
        BackboneConfig(hidden=32, patch=8),
        text={"num_attention_heads": 2, "num_key_value_heads": 1},
        vision=vision | {"image_size": image},
    )
    return {
        "image": image,
        "vlm_model_name": str(backbone),
        "load_vlm_weights": False,
        "num_vlm_layers": 2,
        "resize_imgs_with_padding": (image, image),
        "freeze_vision_encoder": False,
    }


def write_smolvla(
    directory: Path, *, image: int = 32, state_dim: int = 4, padded_dim: int = 2, chunk: int = 4,
    executed: int = 4, num_steps: int = 3, **options: Any,
) -> Path:  # fmt: skip
    """Saves a random SmolVLA with identity-like normalisation as a LeRobot ``pretrained_model`` folder."""
    small = {
        "chunk_size": chunk, "n_action_steps": executed, "num_steps": num_steps, "tokenizer_max_length": 48,
        "state_dim": state_dim, "max_state_dim": state_dim, "max_action_dim": padded_dim,
        "num_expert_layers": 2, "expert_width_multiplier": 1.0, "train_expert_only": False,
    }  # fmt: skip
    return write_policy(directory, "smolvla", **(with_backbone(directory, image) | small | options))


def write_multi_task_dit(directory: Path, **options: Any) -> Path:
    """A multi-task DiT for images of 64 pixels; its tiny CLIP models are written beside it."""
    vision, text = (str(directory.parent / name) for name in ("clip-vision", "clip-text"))
    small = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    CLIPVisionModel(CLIPVisionConfig(**small, image_size=64, patch_size=16)).save_pretrained(vision)
    words = write_words(text, pad_token="[PAD]", cls_token="[CLS]", sep_token="[SEP]")
    ends = {"pad_token_id": 0, "bos_token_id": 1, "eos_token_id": 2}
    language = CLIPTextConfig(**small, vocab_size=words, max_position_embeddings=16, **ends)
    CLIPTextModel(language).save_pretrained(text)
    fields = {
        "n_obs_steps": 2, "horizon": 6, "n_action_steps": 3, "hidden_dim": 16, "num_layers": 1,
        "num_heads": 2, "timestep_embed_dim": 16, "num_train_timesteps": 10, "image_crop_shape": None,
        "tokenizer_max_length": 16, "vision_encoder_name": vision, "text_encoder_name": text,
    }  # fmt: skip
    return write_policy(directory, "multi_task_dit", **(fields | options))


def write_xvla(directory: Path, *, image: int = 64, **options: Any) -> Path:
    """An X-VLA of 0.03 M parameters on a tiny Florence-2; its tokeniser is written beside it."""
    tokenizer = str(directory.parent / "xvla-words")
    words = write_words(tokenizer, pad_token="<pad>", cls_token="<s>", sep_token="</s>")
    stages = {"embed_dim": [8, 8, 8, 16], "num_heads": [1, 1, 1, 2], "num_groups": [1, 1, 1, 2]}
    patches = {"patch_size": [7, 3, 3, 3], "patch_stride": [4, 2, 2, 2], "patch_padding": [3, 1, 1, 1]}
    ends = {"max_position_embeddings": 10, "max_temporal_embeddings": 4}
    vision = stages | patches | ends | {"depths": [1] * 4, "window_size": 4, "projection_dim": 16}
    layers = {"layers": 1, "attention_heads": 2, "ffn_dim": 16}
    text = {f"{part}_{name}": size for part in ("encoder", "decoder") for name, size in layers.items()}
    text |= {"model_type": "bart", "d_model": 16, "vocab_size": words, "max_position_embeddings": 64}
    text |= {"pad_token_id": 0, "bos_token_id": 1, "eos_token_id": 2}
    fields = {
        "florence_config": {"vision_config": vision, "text_config": text, "image_token_id": 5},
        "tokenizer_name": tokenizer, "tokenizer_max_length": 16, "chunk_size": 4, "n_action_steps": 4,
        "hidden_size": 16, "depth": 1, "num_heads": 2, "num_domains": 2, "len_soft_prompts": 2, "dim_time": 8,
        "max_len_seq": 128, "action_mode": "auto", "max_state_dim": 4, "max_action_dim": 4,
        "num_denoising_steps": 2, "resize_imgs_with_padding": (image, image), "num_image_views": 1,
    }  # fmt: skip
    return write_policy(directory, "xvla", image=image, **(fields | options))


def write_words(folder: str, **marks: str) -> int:
    """Saves a tokeniser of `marks` and of the words of ``SimulatedConfig()``'s task; returns their number."""
    words = [*marks.values(), "[UNK]", "[MASK]", "<image>", "match", "the", "target"]
    BertTokenizer(vocab={word: i for i, word in enumerate(words)}, **marks).save_pretrained(folder)
    return len(words)


def write_act(directory: Path, *, chunk: int = 5, executed: int = 3, **options: Any) -> Path:
    """An ACT of 11 M parameters, nearly all of them in the smallest ResNet that LeRobot allows."""
    small = {
        "chunk_size": chunk, "n_action_steps": executed, "pretrained_backbone_weights": None,
        "dim_model": 32, "n_heads": 2, "dim_feedforward": 64, "latent_dim": 4,
        "n_encoder_layers": 2, "n_vae_encoder_layers": 1,
    }  # fmt: skip
    return write_policy(directory, "act", **(small | options))


def write_diffusion(directory: Path, *, horizon: int = 8, executed: int = 3, **options: Any) -> Path:
    """A diffusion policy with a U-Net of 0.07 M parameters beside the smallest ResNet that LeRobot allows."""
    small = {
        "n_obs_steps": 1, "horizon": horizon, "n_action_steps": executed, "pretrained_backbone_weights": None,
        "down_dims": (16, 32), "n_groups": 4, "diffusion_step_embed_dim": 16, "num_train_timesteps": 20,
        "num_inference_steps": 4, "spatial_softmax_num_keypoints": 4,
        "use_group_norm": True,  # batch norm wants images above 32 pixels when LeRobot builds it
    }  # fmt: skip
    return write_policy(directory, "diffusion", **(small | options))


def write_bins(
    directory: Path,
    *,
    chunk: int = 4,
    executed: int = 4,
    action_range: tuple[float, float] = (-1.0, 1.0),
    **options: Any,
) -> Path:
    """A smolvla_bins of some 30 k parameters that fits ``SimulatedConfig()``, its backbone beside it."""
    import lerobot_policy_smolvla_bins  # noqa: F401

    low, high = (torch.full((2,), bound) for bound in action_range)
    small = {"chunk_size": chunk, "n_action_steps": executed, "num_bins": 32}
    small["stats"] = {"action": {"min": low, "max": high}}
    return write_policy(directory, "smolvla_bins", **(with_backbone(directory, 32) | small | options))


def edit_config(path: Path, **changes: Any) -> None:
    """Puts other values into a checkpoint's ``config.json``."""
    config = json.loads((path / "config.json").read_text())
    (path / "config.json").write_text(json.dumps(config | changes))
