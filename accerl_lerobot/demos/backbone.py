# SPDX-License-Identifier: Apache-2.0
"""A vision-language backbone of any size, with random weights, written offline.

SmolVLA reads its backbone's architecture and tokeniser from a model directory. For policies small enough to
train on a laptop this writes such a directory: SmolVLM's own classes, shrunk, with a byte-level tokeniser, so
that the policy is LeRobot's `SmolVLAPolicy` on the same code path as ``lerobot/smolvla_base``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from accerl_lerobot.config.ranges import Range, Section
from accerl_lerobot.errors import InputError

SPECIAL_TOKENS = (
    "<|pad|>", "<|im_start|>", "<|im_end|>", "<image>", "<fake_token_around_image>", "<global-img>",
    "<end_of_utterance>", "<video>",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class BackboneConfig(Section, section="sft.backbone"):
    """Sizes of a random SmolVLM. The defaults give a SmolVLA of about 0.4 M parameters."""

    hidden: Annotated[int, Range("[8, 4096]")] = 96
    """Width of the language model; a multiple of 8."""
    patch: Annotated[int, Range("[1, 1024]")] = 16
    """Side of an image patch in pixels."""
    image: Annotated[int, Range("[1, 4096]")] = 64
    """Side of the image the encoder sees; a multiple of twice `patch`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.image % (2 * self.patch):
            hint = f"use a multiple of {2 * self.patch}, twice the patch"
            raise InputError("sft.backbone.image", self.image, hint)
        if self.hidden % 8:  # four heads, which rotary embeddings halve
            raise InputError("sft.backbone.hidden", self.hidden, "use a multiple of 8")


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """A SmolVLM's sizes: `BackboneConfig`'s, and others that no recipe changes."""

    hidden: int = 96
    layers: int = 2
    heads: int = 4
    kv_heads: int = 2
    intermediate: int = 0  # 0: twice the width, as below
    vision_hidden: int = 64
    vision_layers: int = 2
    vision_heads: int = 4
    vision_intermediate: int = 0
    patch: int = 16
    image: int = 64
    shuffle: int = 2  # side of the square of image tokens that become one token of the language model
    vocabulary: int = 512  # tokens at most
    embeddings: int = 0  # rows of the table; at least as many as there are tokens


def write_backbone(directory: Path, texts: Sequence[str] = (), sizes: Sizes = Sizes()) -> Path:
    """Writes config, tokeniser and image processor into `directory`; no weights.

    The tokeniser merges bytes on `texts`, so that these instructions become a few tokens instead of one per
    byte; any other text still encodes, byte by byte.
    """
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers
    from transformers import (
        PreTrainedTokenizerFast,
        SmolVLMConfig,
        SmolVLMImageProcessor,
        SmolVLMProcessor,
        SmolVLMVideoProcessor,
    )

    raw = Tokenizer(models.BPE())
    raw.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    raw.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=sizes.vocabulary,
        special_tokens=list(SPECIAL_TOKENS),
        initial_alphabet=sorted(pre_tokenizers.ByteLevel.alphabet()),
        show_progress=False,
    )
    raw.train_from_iterator(sorted(set(texts)), trainer)
    ids = raw.get_vocab()
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_object=raw,
        pad_token="<|pad|>",
        bos_token="<|im_start|>",
        eos_token="<|im_end|>",
        extra_special_tokens={
            "fake_image_token": "<fake_token_around_image>",
            "global_image_token": "<global-img>",
            "image_token": "<image>",
            "end_of_utterance_token": "<end_of_utterance>",
            "video_token": "<video>",
        },
    )
    architecture = SmolVLMConfig(
        image_token_id=ids["<image>"],
        pad_token_id=ids["<|pad|>"],
        scale_factor=sizes.shuffle,
        vision_config={
            "hidden_size": sizes.vision_hidden,
            "intermediate_size": sizes.vision_intermediate or 2 * sizes.vision_hidden,
            "num_hidden_layers": sizes.vision_layers,
            "num_attention_heads": sizes.vision_heads,
            "image_size": sizes.image,
            "patch_size": sizes.patch,
        },
        text_config={
            "model_type": "llama",
            "hidden_size": sizes.hidden,
            "intermediate_size": sizes.intermediate or 2 * sizes.hidden,
            "num_hidden_layers": sizes.layers,
            "num_attention_heads": sizes.heads,
            "num_key_value_heads": sizes.kv_heads,
            "head_dim": sizes.hidden // sizes.heads,
            "vocab_size": max(sizes.embeddings, len(ids)),
            "pad_token_id": ids["<|pad|>"],
            "max_position_embeddings": 1024,
            "rms_norm_eps": 1e-5,
        },
    )
    architecture.architectures = ["SmolVLMForConditionalGeneration"]
    directory.mkdir(parents=True, exist_ok=True)
    architecture.save_pretrained(directory)
    SmolVLMProcessor(
        image_processor=SmolVLMImageProcessor(),
        tokenizer=tokenizer,
        video_processor=SmolVLMVideoProcessor(),
        image_seq_len=(sizes.image // sizes.patch // sizes.shuffle) ** 2,
        chat_template="{% for m in messages %}{{ m['content'] }}{% endfor %}",
    ).save_pretrained(directory)
    return directory
