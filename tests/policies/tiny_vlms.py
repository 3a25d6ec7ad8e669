# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of LeRobot's large vision-language-action policies with random weights of tiny size.

Each backbone, with its tokeniser, is written beside the policy's folder.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from safetensors.torch import save_file

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
NAMED = {
    "vision_start": "vision_start", "vision_end": "vision_end", "image": "image_pad", "video": "video_pad",
}  # fmt: skip
"""Beginning of a field of Qwen-VL's config → the token that it names."""
MARKS = ("im_start", "im_end", *NAMED.values())
ROOM = 64  # tokens that a policy may add to a tokeniser
WIDTH = 16
WAN_CHANNELS = 48  # of Wan 2.2's video latents
VISION = {
    "depth": 1, "hidden_size": WIDTH, "intermediate_size": WIDTH, "num_heads": 2, "out_hidden_size": WIDTH,
}  # fmt: skip


def write_letters(folder: Path, *marks: str, **options: Any) -> Any:
    """Saves a tokeniser of bytes and of `marks`, in the files of Qwen's."""
    from tokenizers import pre_tokenizers
    from transformers import Qwen2Tokenizer

    letters = sorted(pre_tokenizers.ByteLevel.alphabet())
    vocabulary = {token: i for i, token in enumerate([*letters, "<|endoftext|>"])}
    tokenizer = Qwen2Tokenizer(vocab=vocabulary, merges=[], **options)
    tokenizer.add_special_tokens({"additional_special_tokens": list(marks)})
    tokenizer.save_pretrained(folder)
    return tokenizer


def token_ids(tokenizer: Any) -> dict[str, Any]:
    """Fields of the config of a Qwen-VL that name tokens."""
    ids: dict[str, Any] = {"dtype": "float32"}
    for name, mark in NAMED.items():
        ids[f"{name}_token_id"] = tokenizer.convert_tokens_to_ids(f"<|{mark}|>")
    return ids


def write_qwen25_vl(folder: Path, *marks: str) -> tuple[dict[str, Any], Any]:
    """The processor of a Qwen2.5-VL of one layer, with more `marks`; returns its config and the tokeniser."""
    from transformers import Qwen2_5_VLProcessor, Qwen2VLImageProcessor, Qwen2VLVideoProcessor

    tokenizer = write_letters(folder, *(f"<|{mark}|>" for mark in MARKS), *marks)
    config = token_ids(tokenizer)
    config["text_config"] = {
        "hidden_size": WIDTH, "intermediate_size": WIDTH, "num_hidden_layers": 1, "num_attention_heads": 2,
        "num_key_value_heads": 1, "vocab_size": len(tokenizer) + ROOM, "max_position_embeddings": 4096,
        "rope_parameters": {"rope_type": "default", "rope_theta": 10000.0, "mrope_section": [2, 1, 1]},
    }  # fmt: skip
    config["vision_config"] = VISION | {"window_size": 56, "fullatt_block_indexes": [0]}
    images = Qwen2VLImageProcessor(min_pixels=28 * 28, max_pixels=56 * 56)
    Qwen2_5_VLProcessor(images, tokenizer, Qwen2VLVideoProcessor(), TEMPLATE).save_pretrained(folder)
    return config, tokenizer


def write_eo1(directory: Path, *, image: int = 64, **options: Any) -> Path:
    """An EO1 on a tiny Qwen2.5-VL."""
    import torch
    from transformers import Qwen2_5_VLConfig, Qwen2_5_VLForConditionalGeneration

    backbone = directory.parent / f"{directory.name}-qwen"
    config, _ = write_qwen25_vl(backbone)
    torch.manual_seed(0)
    Qwen2_5_VLForConditionalGeneration(Qwen2_5_VLConfig(**config)).save_pretrained(backbone)
    fields = {
        "vlm_base": str(backbone), "image_min_pixels": 28 * 28, "image_max_pixels": 56 * 56,
        "chunk_size": 4, "n_action_steps": 4, "max_state_dim": 4, "max_action_dim": 4,
        "num_denoise_steps": 2, "num_action_layers": 2,
    }  # fmt: skip
    return write_policy(directory, "eo1", image=image, **(fields | options))


def write_internvl(folder: Path, image: int) -> Any:
    """An InternVL of one layer with its tokeniser; an image is a single token of it."""
    import torch
    from transformers import InternVLConfig, InternVLModel

    tokenizer = write_letters(folder, "<img>", "</img>", "<IMG_CONTEXT>")
    layers = {
        "hidden_size": WIDTH, "intermediate_size": WIDTH, "num_hidden_layers": 1, "num_attention_heads": 2,
    }  # fmt: skip
    text = layers | {"model_type": "qwen2", "num_key_value_heads": 1, "vocab_size": len(tokenizer)}
    vision = layers | {"image_size": (image, image), "patch_size": (image // 2, image // 2)}
    torch.manual_seed(0)
    config = InternVLConfig(
        text_config=text,
        vision_config=vision,
        image_token_id=tokenizer.convert_tokens_to_ids("<IMG_CONTEXT>"),
        image_seq_length=1,
        downsample_ratio=0.5,
        dtype="float32",
    )
    model = InternVLModel(config)
    model.save_pretrained(folder)
    return model


def write_evo1(directory: Path, *, image: int = 64, **options: Any) -> Path:
    """An EVO1 on a tiny InternVL, whose actions are wider than those that it executes."""
    backbone = directory.parent / f"{directory.name}-internvl"
    write_internvl(backbone, 28)
    fields = {
        "vlm_model_name": str(backbone), "vlm_num_layers": 1, "image_resolution": (28, 28), "max_views": 1,
        "chunk_size": 4, "n_action_steps": 4, "max_state_dim": 6, "max_action_dim": 3, "embed_dim": WIDTH,
        "hidden_dim": WIDTH, "state_hidden_dim": WIDTH, "num_heads": 2, "num_layers": 1,
        "num_inference_timesteps": 2,
    }  # fmt: skip
    return write_policy(directory, "evo1", image=image, **(fields | options))


def write_molmo(folder: Path, fast: Path, state_tokens: int) -> None:
    """A MolmoAct2 model of one layer with its processor, an image being one token of it.

    `fast` is written, too: its tokeniser of actions.
    """
    import torch
    from lerobot.policies.molmoact2.molmoact2_hf_model.configuration_molmoact2 import MolmoAct2Config
    from lerobot.policies.molmoact2.molmoact2_hf_model.modeling_molmoact2 import (
        MolmoAct2ForConditionalGeneration,
    )
    from transformers import PreTrainedTokenizerFast

    write_fast(fast)
    count = len(PreTrainedTokenizerFast.from_pretrained(fast))
    marks = {
        "image_patch_id": "<im_patch>", "image_low_res_id": "<im_low>", "image_start_token_id": "<im_start>",
        "low_res_image_start_token_id": "<low_res_im_start>", "frame_start_token_id": "<frame_start>",
        "image_end_token_id": "<im_end>", "frame_end_token_id": "<frame_end>", "image_col_id": "<im_col>",
        "action_output_token_id": "<action_output>", "action_start_token_id": "<action_start>",
        "action_end_token_id": "<action_end>", "state_start_token_id": "<state_start>",
        "state_end_token_id": "<state_end>",
    }  # fmt: skip
    states = [f"<state_{i}>" for i in range(state_tokens)]
    actions = [f"<action_{i}>" for i in range(count)]
    tokenizer = write_letters(
        folder, "<|im_start|>", "<|im_end|>", *marks.values(), *states, *actions, padding_side="left"
    )
    ids = {name: tokenizer.convert_tokens_to_ids(mark) for name, mark in marks.items()}
    heads = {"num_attention_heads": 2, "num_key_value_heads": 2, "head_dim": WIDTH // 2}
    sizes = {"hidden_size": WIDTH, "intermediate_size": WIDTH}
    torch.manual_seed(0)
    config = MolmoAct2Config(
        vit_config=heads | sizes | {
            "num_hidden_layers": 1, "image_default_input_size": (28, 28), "image_num_pos": 4,
        },
        adapter_config=heads | sizes | {"vit_layers": (-1,), "text_hidden_size": WIDTH},
        text_config=heads | sizes | {
            "num_hidden_layers": 1, "vocab_size": len(tokenizer), "additional_vocab_size": 8,
        },
        action_expert_config={
            "hidden_size": WIDTH, "num_layers": 1, "num_heads": 2, "ffn_multiple_of": 8,
            "timestep_embed_dim": 8,
        },
        action_token_start_id=tokenizer.convert_tokens_to_ids(actions[0]), num_action_tokens=count,
        state_token_start_id=tokenizer.convert_tokens_to_ids(states[0]), num_state_tokens=state_tokens,
        eos_token_id=tokenizer.eos_token_id, **ids,
    )  # fmt: skip
    MolmoAct2ForConditionalGeneration(config).save_pretrained(folder)
    images = {"size": {"height": 28, "width": 28}, "crop_mode": "resize"}
    (folder / "processor_config.json").write_text(json.dumps({"image_processor": images}))


def write_molmoact2(directory: Path, *, image: int = 64, **options: Any) -> Path:
    """A MolmoAct2 with flow and tokens of actions."""
    backbone = directory.parent / f"{directory.name}-molmo"
    fast = backbone.with_name(f"{backbone.name}-fast")
    write_molmo(backbone, fast, 4)
    fields = {
        "checkpoint_path": str(backbone), "discrete_action_tokenizer": str(fast), "num_state_tokens": 4,
        "chunk_size": 4, "n_action_steps": 4, "inference_action_mode": "continuous",
        "max_sequence_length": 1024, "num_flow_timesteps": 2, "num_inference_steps": 2,
    }  # fmt: skip
    return write_policy(directory, "molmoact2", image=image, **(fields | options))


def write_wall_x(directory: Path, *, image: int = 64, **options: Any) -> Path:
    """A Wall-X on a tiny Qwen2.5-VL with two experts."""
    import torch
    from lerobot.policies.wall_x.modeling_wall_x import Qwen2_5_VLMoEForAction
    from lerobot.policies.wall_x.qwen_model.configuration_qwen2_5_vl import Qwen2_5_VLConfig

    backbone = directory.parent / f"{directory.name}-qwen"
    config, tokenizer = write_qwen25_vl(backbone, "<|action|>", "<|propri|>")
    expert = {"hidden_size": WIDTH, "intermediate_size": WIDTH, "hidden_act": "silu"}
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
    """The processor of a Qwen3-VL of one layer; returns its config."""
    from transformers import Qwen2VLImageProcessor, Qwen3VLProcessor, Qwen3VLVideoProcessor

    tokenizer = write_letters(folder, *(f"<|{mark}|>" for mark in MARKS), chat_template=TEMPLATE)
    images = Qwen2VLImageProcessor(min_pixels=32 * 32, max_pixels=64 * 64, patch_size=16)
    Qwen3VLProcessor(images, tokenizer, Qwen3VLVideoProcessor(), TEMPLATE).save_pretrained(folder)
    config = token_ids(tokenizer)
    config["text_config"] = {
        "hidden_size": WIDTH, "intermediate_size": WIDTH, "num_hidden_layers": 1, "num_attention_heads": 2,
        "num_key_value_heads": 1, "head_dim": 8, "vocab_size": len(tokenizer) + ROOM,
        "rope_parameters": {"rope_type": "default", "rope_theta": 10000.0, "mrope_section": [2, 1, 1]},
    }  # fmt: skip
    config["vision_config"] = VISION | {"num_position_embeddings": 16, "deepstack_visual_indexes": [0]}
    return config


def write_groot(directory: Path, *, image: int = 64, **options: Any) -> Path:
    """A GR00T N1.7 on a tiny Qwen3-VL."""
    import torch
    from lerobot.policies.groot.groot_n1_7 import GR00TN17, GR00TN17Config
    from transformers import Qwen3VLConfig

    qwen, base = (directory.parent / f"{directory.name}-{part}" for part in ("qwen", "groot"))
    Qwen3VLConfig(**write_qwen3_vl(qwen)).save_pretrained(qwen)
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
    import torch
    from transformers import (
        Qwen3VLConfig,
        Qwen3VLForConditionalGeneration,
        VJEPA2Config,
        VJEPA2Model,
        VJEPA2VideoProcessor,
    )

    qwen, jepa = (directory.parent / f"{directory.name}-{part}" for part in ("qwen", "jepa"))
    torch.manual_seed(0)
    Qwen3VLForConditionalGeneration(Qwen3VLConfig(**write_qwen3_vl(qwen))).save_pretrained(qwen)
    config = VJEPA2Config(
        crop_size=32, frames_per_clip=4, hidden_size=WIDTH, num_attention_heads=2, num_hidden_layers=1,
        mlp_ratio=1.0, pred_hidden_size=WIDTH, pred_num_attention_heads=2, pred_num_hidden_layers=1,
    )  # fmt: skip
    VJEPA2Model(config).save_pretrained(jepa)
    VJEPA2VideoProcessor(size={"shortest_edge": 32}, crop_size=32).save_pretrained(jepa)
    fields = {
        "qwen_model_name": str(qwen), "jepa_encoder_name": str(jepa), "chunk_size": 4, "n_action_steps": 4,
        "num_video_frames": 4, "num_action_tokens_per_timestep": 2,
        "num_embodied_action_tokens_per_instruction": 4, "num_inference_timesteps": 2,
        "action_hidden_size": WIDTH, "action_num_layers": 1, "action_num_heads": 2,
        "action_attention_head_dim": 8, "num_target_vision_tokens": 4, "predictor_depth": 1,
        "predictor_num_heads": 2, "gripper_dim": 1,
    }  # fmt: skip
    return write_policy(directory, "vla_jepa", image=image, **(fields | options))


def write_wan(folder: Path) -> None:
    """The video encoder of Wan 2.2, its text encoder and a tokeniser, each in a folder of its own."""
    import torch
    from diffusers import AutoencoderKLWan
    from transformers import T5Tokenizer, UMT5Config, UMT5EncoderModel

    pieces = ["<pad>", "</s>", "<unk>", "▁", *"abcdefghijklmnopqrstuvwxyz"]
    tokenizer = T5Tokenizer(vocab=[(piece, -float(i)) for i, piece in enumerate(pieces)], extra_ids=0)
    tokenizer.save_pretrained(folder / "tokenizer")
    torch.manual_seed(0)
    text = UMT5Config(
        vocab_size=len(tokenizer), d_model=WIDTH, d_kv=8, d_ff=WIDTH, num_layers=1, num_heads=2,
        feed_forward_proj="gated-gelu",
    )  # fmt: skip
    UMT5EncoderModel(text).save_pretrained(folder / "text_encoder")
    video = AutoencoderKLWan(
        base_dim=4, decoder_base_dim=4, z_dim=WAN_CHANNELS, dim_mult=[1, 1, 1, 1], num_res_blocks=1,
        is_residual=True, patch_size=2, in_channels=12, out_channels=12, scale_factor_spatial=16,
        latents_mean=[0.0] * WAN_CHANNELS, latents_std=[1.0] * WAN_CHANNELS,
    )  # fmt: skip
    video.save_pretrained(folder / "vae")


def write_fastwam(directory: Path, *, image: int = 64, **options: Any) -> Path:
    """A FastWAM on tiny parts of Wan 2.2; LeRobot takes the video encoder from the Hub, see `wan_hub`."""
    wan = directory.parent / "wan"
    write_wan(wan)
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
    from huggingface_hub import constants

    cache = wan.with_name(f"{wan.name}-hub")
    folder = cached_repo(cache, "Wan-AI/Wan2.2-TI2V-5B-Diffusers", COMMIT)
    if not (folder / "vae").exists():
        (folder / "vae").symlink_to(wan / "vae")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(constants, "HF_HUB_CACHE", str(cache))
        yield


def write_lingbot_va(directory: Path, *, image: int = 64, **options: Any) -> Path:
    """A LingBot-VA on tiny parts of Wan 2.2."""
    wan = directory.parent / "wan"
    write_wan(wan)
    fields = {
        "wan_pretrained_path": str(wan), "num_attention_heads": 2, "attention_head_dim": 12,
        "text_dim": WIDTH, "freq_dim": WIDTH, "ffn_dim": WIDTH, "num_layers": 1, "dtype": "float32",
        "obs_cam_keys": ["observation.images.front"], "height": 32, "width": 32, "attn_window": 8,
        "num_inference_steps": 2, "action_num_inference_steps": 2, "max_sequence_length": 16,
        "used_action_channel_ids": [0, 1],
    }  # fmt: skip
    return write_policy(directory, "lingbot_va", image=image, **(fields | options))
