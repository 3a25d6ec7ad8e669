# SPDX-License-Identifier: Apache-2.0
"""Tiny checkpoints of LeRobot's large vision-language-action policies, each with its backbone beside it."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import transformers
from diffusers import AutoencoderKLWan
from huggingface_hub import constants
from safetensors.torch import save_file
from tokenizers import pre_tokenizers

from tests.hub_cache import cached_repo
from tests.policies.checkpoints import write_policy
from tests.policies.tiny_pi import COMMIT, write_fast

TEMPLATE = (
    "{% for message in messages %}<|im_start|>{{ message['role'] }}\n"
    "{% for part in message['content'] %}{% if part['type'] == 'image' %}"
    "<|vision_start|><|image_pad|><|vision_end|>{% else %}{{ part['text'] }}{% endif %}{% endfor %}"
    "<|im_end|>\n{% endfor %}"
)
"""Qwen-VL's chat template, without videos and tools."""
ROOM = 64  # tokens that a policy may add to a tokeniser
WIDTH = 16
SIZES = {"hidden_size": WIDTH, "intermediate_size": WIDTH}
WAN_CHANNELS = 48  # of Wan 2.2's video latents


def write_letters(folder: Path, *marks: str, **options: Any) -> Any:
    """Saves a tokeniser of bytes and of `marks`, in the files of Qwen's."""
    letters = sorted(pre_tokenizers.ByteLevel.alphabet())
    vocabulary = {token: i for i, token in enumerate([*letters, "<|endoftext|>"])}
    tokenizer = transformers.Qwen2Tokenizer(vocab=vocabulary, merges=[], **options)
    tokenizer.add_special_tokens({"additional_special_tokens": list(marks)})
    tokenizer.save_pretrained(folder)
    return tokenizer


def qwen_vl(folder: Path, text: dict[str, Any], vision: dict[str, Any]) -> tuple[dict[str, Any], Any]:
    """The config of a Qwen-VL of one layer, and its tokeniser, which is saved."""
    named = {name: f"<|{name}|>" for name in ("vision_start", "vision_end")}
    named |= {name: f"<|{name}_pad|>" for name in ("image", "video")}
    marks = ("<|im_start|>", "<|im_end|>", *named.values())
    tokenizer = write_letters(folder, *marks, chat_template=TEMPLATE)
    config = {f"{name}_token_id": tokenizer.convert_tokens_to_ids(mark) for name, mark in named.items()}
    config["text_config"] = SIZES | text | {
        "num_hidden_layers": 1, "num_attention_heads": 2, "num_key_value_heads": 1,
        "vocab_size": len(tokenizer) + ROOM,
        "rope_parameters": {"rope_type": "default", "rope_theta": 10000.0, "mrope_section": [2, 1, 1]},
    }  # fmt: skip
    config["vision_config"] = SIZES | vision | {"depth": 1, "num_heads": 2, "out_hidden_size": WIDTH}
    return config | {"dtype": "float32"}, tokenizer


def write_qwen25_vl(folder: Path) -> tuple[dict[str, Any], Any]:
    """The processor of a tiny Qwen2.5-VL; returns its config and the tokeniser."""
    vision = {"window_size": 56, "fullatt_block_indexes": [0]}
    config, tokenizer = qwen_vl(folder, {"max_position_embeddings": 4096}, vision)
    images = transformers.Qwen2VLImageProcessor(min_pixels=28 * 28, max_pixels=56 * 56)
    videos = transformers.Qwen2VLVideoProcessor()
    transformers.Qwen2_5_VLProcessor(images, tokenizer, videos, TEMPLATE).save_pretrained(folder)
    return config, tokenizer


def write_eo1(directory: Path, *, image: int = 64, **options: Any) -> Path:
    """An EO1 on a tiny Qwen2.5-VL."""
    backbone = directory.parent / f"{directory.name}-qwen"
    config, _ = write_qwen25_vl(backbone)
    torch.manual_seed(0)
    model = transformers.Qwen2_5_VLForConditionalGeneration(transformers.Qwen2_5_VLConfig(**config))
    model.save_pretrained(backbone)
    fields = {
        "vlm_base": str(backbone), "image_min_pixels": 28 * 28, "image_max_pixels": 56 * 56,
        "chunk_size": 4, "n_action_steps": 4, "max_state_dim": 4, "max_action_dim": 4,
        "num_denoise_steps": 2, "num_action_layers": 2,
    }  # fmt: skip
    return write_policy(directory, "eo1", image=image, **(fields | options))


def write_evo1(directory: Path, *, image: int = 64, **options: Any) -> Path:
    """An EVO1 on a tiny InternVL, whose actions are wider than those that it executes."""
    backbone = directory.parent / f"{directory.name}-internvl"
    tokenizer = write_letters(backbone, "<img>", "</img>", "<IMG_CONTEXT>")
    layers = SIZES | {"num_hidden_layers": 1, "num_attention_heads": 2}
    text = layers | {"model_type": "qwen2", "num_key_value_heads": 1, "vocab_size": len(tokenizer)}
    vision = layers | {"image_size": (28, 28), "patch_size": (14, 14)}
    torch.manual_seed(0)
    config = transformers.InternVLConfig(
        text_config=text, vision_config=vision, image_seq_length=1, downsample_ratio=0.5, dtype="float32",
        image_token_id=tokenizer.convert_tokens_to_ids("<IMG_CONTEXT>"),
    )  # fmt: skip
    transformers.InternVLModel(config).save_pretrained(backbone)
    fields = {
        "vlm_model_name": str(backbone), "vlm_num_layers": 1, "image_resolution": (28, 28), "max_views": 1,
        "chunk_size": 4, "n_action_steps": 4, "max_state_dim": 6, "max_action_dim": 3, "embed_dim": WIDTH,
        "hidden_dim": WIDTH, "state_hidden_dim": WIDTH, "num_heads": 2, "num_layers": 1,
        "num_inference_timesteps": 2,
    }  # fmt: skip
    return write_policy(directory, "evo1", image=image, **(fields | options))


def write_molmoact2(directory: Path, *, image: int = 64, **options: Any) -> Path:
    """A MolmoAct2 with flow and tokens of actions, on a backbone of one layer; an image is one token."""
    from lerobot.policies.molmoact2.molmoact2_hf_model.configuration_molmoact2 import MolmoAct2Config
    from lerobot.policies.molmoact2.molmoact2_hf_model.modeling_molmoact2 import (
        MolmoAct2ForConditionalGeneration,
    )

    folder, fast = (directory.parent / f"{directory.name}-{part}" for part in ("molmo", "fast"))
    write_fast(fast)
    count = len(transformers.PreTrainedTokenizerFast.from_pretrained(fast))
    marks = {
        "image_patch_id": "<im_patch>", "image_low_res_id": "<im_low>", "image_start_token_id": "<im_start>",
        "low_res_image_start_token_id": "<low_res_im_start>", "frame_start_token_id": "<frame_start>",
        "image_end_token_id": "<im_end>", "frame_end_token_id": "<frame_end>", "image_col_id": "<im_col>",
        "action_output_token_id": "<action_output>", "action_start_token_id": "<action_start>",
        "action_end_token_id": "<action_end>", "state_start_token_id": "<state_start>",
        "state_end_token_id": "<state_end>",
    }  # fmt: skip
    states = [f"<state_{i}>" for i in range(4)]
    actions = [f"<action_{i}>" for i in range(count)]
    tokenizer = write_letters(
        folder, "<|im_start|>", "<|im_end|>", *marks.values(), *states, *actions, padding_side="left"
    )
    ids = {name: tokenizer.convert_tokens_to_ids(mark) for name, mark in marks.items()}
    sizes = SIZES | {"num_attention_heads": 2, "num_key_value_heads": 2, "head_dim": WIDTH // 2}
    torch.manual_seed(0)
    config = MolmoAct2Config(
        vit_config=sizes | {
            "num_hidden_layers": 1, "image_default_input_size": (28, 28), "image_num_pos": 4,
        },
        adapter_config=sizes | {"vit_layers": (-1,), "text_hidden_size": WIDTH},
        text_config=sizes | {
            "num_hidden_layers": 1, "vocab_size": len(tokenizer), "additional_vocab_size": 8,
        },
        action_expert_config={
            "hidden_size": WIDTH, "num_layers": 1, "num_heads": 2, "ffn_multiple_of": 8,
            "timestep_embed_dim": 8,
        },
        action_token_start_id=tokenizer.convert_tokens_to_ids(actions[0]), num_action_tokens=count,
        state_token_start_id=tokenizer.convert_tokens_to_ids(states[0]), num_state_tokens=4,
        eos_token_id=tokenizer.eos_token_id, **ids,
    )  # fmt: skip
    MolmoAct2ForConditionalGeneration(config).save_pretrained(folder)
    images = {"size": {"height": 28, "width": 28}, "crop_mode": "resize"}
    (folder / "processor_config.json").write_text(json.dumps({"image_processor": images}))
    fields = {
        "checkpoint_path": str(folder), "discrete_action_tokenizer": str(fast), "num_state_tokens": 4,
        "chunk_size": 4, "n_action_steps": 4, "inference_action_mode": "continuous",
        "max_sequence_length": 1024, "num_flow_timesteps": 2, "num_inference_steps": 2,
    }  # fmt: skip
    return write_policy(directory, "molmoact2", image=image, **(fields | options))


def write_wall_x(directory: Path, *, image: int = 64, **options: Any) -> Path:
    """A Wall-X on a tiny Qwen2.5-VL with two experts."""
    from lerobot.policies.wall_x.modeling_wall_x import Qwen2_5_VLMoEForAction
    from lerobot.policies.wall_x.qwen_model.configuration_qwen2_5_vl import Qwen2_5_VLConfig

    backbone = directory.parent / f"{directory.name}-qwen"
    config, tokenizer = write_qwen25_vl(backbone)
    tokenizer.add_special_tokens({"additional_special_tokens": ["<|action|>", "<|propri|>"]})
    tokenizer.save_pretrained(backbone)
    expert = SIZES | {"hidden_act": "silu"}
    config["text_config"] |= {
        "mlp_moe": True, "num_experts": 2, "experts": [expert, expert], "dim_inputs": [WIDTH, WIDTH],
        "dof_config": {"joints": 4}, "vocab_size": len(tokenizer),
    }  # fmt: skip
    torch.manual_seed(0)
    qwen = Qwen2_5_VLConfig(agent_pos_config={"joints": 4}, **config)
    qwen.save_pretrained(backbone)
    model = Qwen2_5_VLMoEForAction(qwen, processor=SimpleNamespace(tokenizer=tokenizer))
    save_file(model.state_dict(), backbone / "model.safetensors")
    fields = {
        "pretrained_name_or_path": str(backbone), "chunk_size": 4, "n_action_steps": 4, "max_state_dim": 4,
        "max_action_dim": 4,
    }  # fmt: skip
    return write_policy(directory, "wall_x", image=image, **(fields | options))


def write_qwen3_vl(folder: Path) -> dict[str, Any]:
    """The processor of a tiny Qwen3-VL; returns its config."""
    vision = {"num_position_embeddings": 16, "deepstack_visual_indexes": [0]}
    config, tokenizer = qwen_vl(folder, {"head_dim": 8}, vision)
    images = transformers.Qwen2VLImageProcessor(min_pixels=32 * 32, max_pixels=64 * 64, patch_size=16)
    videos = transformers.Qwen3VLVideoProcessor()
    transformers.Qwen3VLProcessor(images, tokenizer, videos, TEMPLATE).save_pretrained(folder)
    return config


def write_groot(directory: Path, *, image: int = 64, **options: Any) -> Path:
    """A GR00T N1.7 on a tiny Qwen3-VL."""
    from lerobot.policies.groot.groot_n1_7 import GR00TN17, GR00TN17Config

    qwen, base = (directory.parent / f"{directory.name}-{part}" for part in ("qwen", "groot"))
    transformers.Qwen3VLConfig(**write_qwen3_vl(qwen)).save_pretrained(qwen)
    attention = {"num_attention_heads": 2, "attention_head_dim": 8, "dropout": 0.0, "final_dropout": False}
    torch.manual_seed(0)
    config = GR00TN17Config(
        model_name=str(qwen), select_layer=1, backbone_embedding_dim=WIDTH, hidden_size=WIDTH,
        input_embedding_dim=WIDTH, max_state_dim=8, max_action_dim=4, action_horizon=4, max_seq_len=16,
        diffusion_model_cfg=attention | {
            "num_layers": 2, "output_dim": WIDTH, "norm_type": "ada_norm", "interleave_self_attention": True,
            "positional_embeddings": None,
        },
        vl_self_attention_cfg=attention | {"num_layers": 1, "positional_embeddings": None},
        num_inference_timesteps=2,
    )  # fmt: skip
    GR00TN17(config, load_backbone_weights=False).save_pretrained(base)
    fields = {
        "base_model_path": str(base), "chunk_size": 4, "n_action_steps": 4, "max_state_dim": 8,
        "max_action_dim": 4,
    }  # fmt: skip
    path = write_policy(directory, "groot", image=image, **(fields | options))
    processor = path / "policy_preprocessor.json"
    processor.write_text(processor.read_text().replace("nvidia/Cosmos-Reason2-2B", str(qwen)))
    return path


def write_vla_jepa(directory: Path, *, image: int = 64, **options: Any) -> Path:
    """A VLA-JEPA on a tiny Qwen3-VL, with a tiny V-JEPA 2 for its world model."""
    qwen, jepa = (directory.parent / f"{directory.name}-{part}" for part in ("qwen", "jepa"))
    sizes = write_qwen3_vl(qwen)
    torch.manual_seed(0)
    transformers.Qwen3VLForConditionalGeneration(transformers.Qwen3VLConfig(**sizes)).save_pretrained(qwen)
    config = transformers.VJEPA2Config(
        crop_size=32, frames_per_clip=4, hidden_size=WIDTH, num_attention_heads=2, num_hidden_layers=1,
        mlp_ratio=1.0, pred_hidden_size=WIDTH, pred_num_attention_heads=2, pred_num_hidden_layers=1,
    )  # fmt: skip
    transformers.VJEPA2Model(config).save_pretrained(jepa)
    transformers.VJEPA2VideoProcessor(size={"shortest_edge": 32}, crop_size=32).save_pretrained(jepa)
    fields = {
        "qwen_model_name": str(qwen), "jepa_encoder_name": str(jepa), "chunk_size": 4, "n_action_steps": 4,
        "num_video_frames": 4, "num_action_tokens_per_timestep": 2,
        "num_embodied_action_tokens_per_instruction": 4, "num_inference_timesteps": 2,
        "action_hidden_size": WIDTH, "action_num_layers": 1, "action_num_heads": 2,
        "action_attention_head_dim": 8, "num_target_vision_tokens": 4, "predictor_depth": 1,
        "predictor_num_heads": 2, "gripper_dim": 1,
    }  # fmt: skip
    return write_policy(directory, "vla_jepa", image=image, **(fields | options))


def write_wan(beside: Path) -> Path:
    """The video encoder of Wan 2.2, its text encoder and a tokeniser, each in a folder of its own."""
    folder = beside.with_name("wan")
    pieces = ["<pad>", "</s>", "<unk>", "▁", *"abcdefghijklmnopqrstuvwxyz"]
    vocabulary = [(piece, -float(i)) for i, piece in enumerate(pieces)]
    tokenizer = transformers.T5Tokenizer(vocab=vocabulary, extra_ids=0)
    tokenizer.save_pretrained(folder / "tokenizer")
    torch.manual_seed(0)
    text = transformers.UMT5Config(
        vocab_size=len(tokenizer), d_model=WIDTH, d_kv=8, d_ff=WIDTH, num_layers=1, num_heads=2,
        feed_forward_proj="gated-gelu",
    )  # fmt: skip
    transformers.UMT5EncoderModel(text).save_pretrained(folder / "text_encoder")
    video = AutoencoderKLWan(
        base_dim=4, decoder_base_dim=4, z_dim=WAN_CHANNELS, dim_mult=[1, 1, 1, 1], num_res_blocks=1,
        is_residual=True, patch_size=2, in_channels=12, out_channels=12, scale_factor_spatial=16,
        latents_mean=[0.0] * WAN_CHANNELS, latents_std=[1.0] * WAN_CHANNELS,
    )  # fmt: skip
    video.save_pretrained(folder / "vae")
    return folder


def write_fastwam(directory: Path, *, image: int = 64, **options: Any) -> Path:
    """A FastWAM on tiny parts of Wan 2.2; LeRobot takes the video encoder from the Hub, see `wan_hub`."""
    wan = write_wan(directory)
    sizes = {
        "hidden_dim": 24, "ffn_dim": WIDTH, "freq_dim": WIDTH, "text_dim": WIDTH, "num_heads": 2,
        "attn_head_dim": 12, "num_layers": 1, "eps": 1e-6,
    }  # fmt: skip
    video = {
        "patch_size": [1, 2, 2], "in_dim": WAN_CHANNELS, "out_dim": WAN_CHANNELS,
        "seperated_timestep": True, "video_attention_mask_mode": "first_frame_causal",
    }  # fmt: skip
    fields = {
        "proprio_dim": 4, "action_horizon": 4, "n_action_steps": 4, "num_video_frames": 5,
        "action_video_freq_ratio": 1, "image_size": (image, image), "video_dit_config": sizes | video,
        "action_dit_config": sizes | {"action_dim": 2}, "text_encoder_model_id": str(wan),
        "tokenizer_model_id": str(wan / "tokenizer"), "tokenizer_max_len": 16, "context_len": 16,
        "num_inference_steps": 2, "torch_dtype": "float32",
    }  # fmt: skip
    with wan_hub(wan):
        return write_policy(directory, "fastwam", image=image, **(fields | options))


@contextlib.contextmanager
def wan_hub(wan: Path) -> Iterator[None]:
    """A Hub cache with the tiny Wan 2.2 of `write_wan`, as after a download."""
    cache = wan.with_name(f"{wan.name}-hub")
    folder = cached_repo(cache, "Wan-AI/Wan2.2-TI2V-5B-Diffusers", COMMIT)
    if not (folder / "vae").exists():
        (folder / "vae").symlink_to(wan / "vae")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(constants, "HF_HUB_CACHE", str(cache))
        yield


def write_lingbot_va(directory: Path, *, image: int = 64, **options: Any) -> Path:
    """A LingBot-VA on tiny parts of Wan 2.2."""
    wan = write_wan(directory)
    fields = {
        "wan_pretrained_path": str(wan), "num_attention_heads": 2, "attention_head_dim": 12,
        "text_dim": WIDTH, "freq_dim": WIDTH, "ffn_dim": WIDTH, "num_layers": 1, "dtype": "float32",
        "obs_cam_keys": ["observation.images.front"], "height": 32, "width": 32, "attn_window": 8,
        "num_inference_steps": 2, "action_num_inference_steps": 2, "max_sequence_length": 16,
        "used_action_channel_ids": [0, 1],
    }  # fmt: skip
    return write_policy(directory, "lingbot_va", image=image, **(fields | options))
