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


LARGEST_BACKBONE = 10
"""Billions of weights."""


@dataclass(frozen=True, kw_only=True)
class BackboneConfig(Section, section="sft.backbone"):
    """Sizes of a random SmolVLM. The defaults give a SmolVLA of about 0.4 M parameters."""

    hidden: Annotated[int, Range("[1, 65536]")] = 96
    """Width of the language model; a multiple of 2·`heads`."""
    layers: Annotated[int, Range("[1, 1000]")] = 2
    """Language-model layers; the action expert has as many."""
    heads: Annotated[int, Range("[1, 1024]")] = 4
    kv_heads: Annotated[int, Range("[1, 1024]")] = 2
    """Key and value heads; a divisor of `heads`."""
    vision_hidden: Annotated[int, Range("[1, 65536]")] = 64
    """Width of the image encoder."""
    vision_layers: Annotated[int, Range("[1, 1000]")] = 2
    vision_heads: Annotated[int, Range("[1, 1024]")] = 4
    patch: Annotated[int, Range("[1, 1024]")] = 16
    """Side of an image patch in pixels."""
    image: Annotated[int, Range("[1, 4096]")] = 64
    """Side of the image the encoder sees; a multiple of `patch` · `shuffle`."""

    vocabulary: Annotated[int, Range("[264, 1000000]")] = 512
    """Most tokens the tokeniser has; 264 are bytes and special tokens."""
    embeddings: Annotated[int, Range("[0, 1000000]")] = 0
    """Rows of the embedding table; 0: as many as the tokeniser has tokens."""
    intermediate: Annotated[int, Range("[0, 262144]")] = 0
    """Width inside the language model's MLPs; 0: twice `hidden`."""
    vision_intermediate: Annotated[int, Range("[0, 262144]")] = 0
    """Width inside the image encoder's; 0: twice `vision_hidden`."""
    shuffle: Annotated[int, Range("[1, 64]")] = 2
    """Side of the square of image tokens that become one token of the language model."""

    def __post_init__(self) -> None:
        super().__post_init__()
        tile = self.patch * self.shuffle
        if self.image % tile:
            remedy = f"use a multiple of {tile}, the patch times the shuffle"
            raise InputError("sft.backbone.image", self.image, remedy)
        for heads, width in (("heads", self.hidden), ("vision_heads", self.vision_hidden)):
            if width % getattr(self, heads):
                remedy = f"use a divisor of the width {width}"
                raise InputError(f"sft.backbone.{heads}", getattr(self, heads), remedy)
        if self.hidden % (2 * self.heads):  # rotary embeddings halve a head
            remedy = f"use a multiple of {2 * self.heads}, twice the heads"
            raise InputError("sft.backbone.hidden", self.hidden, remedy)
        language = self.layers * self.hidden * (self.hidden + (self.intermediate or 2 * self.hidden))
        vision = self.vision_layers * self.vision_hidden
        vision *= self.vision_hidden + (self.vision_intermediate or 2 * self.vision_hidden)
        if (weights := 3 * (language + vision) / 1e9) > LARGEST_BACKBONE:
            field = "hidden" if language > vision else "vision_hidden"
            remedy = f"about {weights:,.0f} billion weights; use fewer or narrower layers"
            raise InputError(f"sft.backbone.{field}", getattr(self, field), remedy)
        if self.heads % self.kv_heads:
            remedy = f"use a divisor of the {self.heads} heads"
            raise InputError("sft.backbone.kv_heads", self.kv_heads, remedy)


SMOLVLM2_500M = BackboneConfig(
    hidden=960,
    layers=32,
    heads=15,
    kv_heads=5,
    vision_hidden=768,
    vision_layers=12,
    vision_heads=12,
    patch=16,
    image=512,
    embeddings=49280,
    intermediate=2560,
    vision_intermediate=3072,
    shuffle=4,
)
"""The sizes of SmolVLM2-500M, the backbone of ``lerobot/smolvla_base``."""


def write_backbone(directory: Path, config: BackboneConfig, texts: Sequence[str] = ()) -> Path:
    """Writes config, tokeniser and image processor; no weights.

    Args:
        directory: created if need be.
        config: the sizes.
        texts: instructions the tokeniser merges bytes on, so that they become a few tokens instead of one per
            byte; any other text still encodes, byte by byte.

    Returns:
        `directory`.
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
        vocab_size=config.vocabulary,
        special_tokens=list(SPECIAL_TOKENS),
        initial_alphabet=sorted(pre_tokenizers.ByteLevel.alphabet()),
        show_progress=False,
    )
    raw.train_from_iterator(sorted(set(texts)), trainer)
    vocabulary = raw.get_vocab()
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
        image_token_id=vocabulary["<image>"],
        pad_token_id=vocabulary["<|pad|>"],
        scale_factor=config.shuffle,
        vision_config={
            "hidden_size": config.vision_hidden,
            "intermediate_size": config.vision_intermediate or 2 * config.vision_hidden,
            "num_hidden_layers": config.vision_layers,
            "num_attention_heads": config.vision_heads,
            "image_size": config.image,
            "patch_size": config.patch,
        },
        text_config={
            "model_type": "llama",
            "hidden_size": config.hidden,
            "intermediate_size": config.intermediate or 2 * config.hidden,
            "num_hidden_layers": config.layers,
            "num_attention_heads": config.heads,
            "num_key_value_heads": config.kv_heads,
            "head_dim": config.hidden // config.heads,
            "vocab_size": max(config.embeddings, len(vocabulary)),
            "pad_token_id": vocabulary["<|pad|>"],
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
        image_seq_len=(config.image // config.patch // config.shuffle) ** 2,
        chat_template="{% for m in messages %}{{ m['content'] }}{% endfor %}",
    ).save_pretrained(directory)
    return directory
