# SPDX-License-Identifier: Apache-2.0
"""A vision-language backbone of any size, with random weights, written offline.

SmolVLA reads its backbone's architecture and tokeniser from a model directory. For policies small enough to
train on a laptop this writes such a directory: SmolVLM's own classes, shrunk, with a byte-level tokeniser, so
that the policy is LeRobot's `SmolVLAPolicy` on the same code path as ``lerobot/smolvla_base``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from accerl_lerobot.config.ranges import Range, Section
from accerl_lerobot.errors import InputError

IMAGE = 64  # side in pixels of the images of the vision encoder
VOCABULARY = 512  # tokens at most
SPECIAL_TOKENS = (
    "<|pad|>", "<|im_start|>", "<|im_end|>", "<image>", "<fake_token_around_image>", "<global-img>",
    "<end_of_utterance>", "<video>",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class BackboneConfig(Section, section="sft.backbone"):
    """Sizes of a random SmolVLM. The defaults give a SmolVLA of about 0.4 M parameters."""

    hidden: Annotated[int, Range("[8, 4096]")] = 96
    """Width of the language model; a multiple of 8."""
    patch: Literal[1, 2, 4, 8, 16, 32] = 16
    """Side of an image patch in pixels."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.hidden % 8:  # four heads, which rotary embeddings halve
            raise InputError("sft.backbone.hidden", self.hidden, "use a multiple of 8")


def write_backbone(
    directory: Path,
    texts: Sequence[str] = (),
    sizes: BackboneConfig = BackboneConfig(),
    *,
    text: Mapping[str, int] | None = None,
    vision: Mapping[str, int] | None = None,
    shuffle: int = 2,
) -> Path:
    """Writes config, tokeniser and image processor into `directory`; no weights.

    The tokeniser merges bytes on `texts`, so that these instructions become a few tokens instead of one per
    byte; any other text still encodes, byte by byte.

    Args:
        text: fields of the language model's config that differ from those of `sizes`.
        vision: fields of the vision encoder's config that differ.
        shuffle: side of the square of image tokens that become one token of the language model.
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
        vocab_size=VOCABULARY,
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
    language_model: dict[str, Any] = {
        "model_type": "llama",
        "hidden_size": sizes.hidden,
        "intermediate_size": 2 * sizes.hidden,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "vocab_size": len(ids),
        "pad_token_id": ids["<|pad|>"],
        "max_position_embeddings": 1024,
        "rms_norm_eps": 1e-5,
    }
    encoder = {
        "hidden_size": 64,
        "intermediate_size": 128,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "image_size": IMAGE,
        "patch_size": sizes.patch,
    }
    language_model |= text or {}
    encoder |= vision or {}
    architecture = SmolVLMConfig(
        image_token_id=ids["<image>"],
        pad_token_id=ids["<|pad|>"],
        scale_factor=shuffle,
        vision_config=encoder,
        text_config=language_model,
    )
    architecture.architectures = ["SmolVLMForConditionalGeneration"]
    directory.mkdir(parents=True, exist_ok=True)
    architecture.save_pretrained(directory)
    SmolVLMProcessor(
        image_processor=SmolVLMImageProcessor(),
        tokenizer=tokenizer,
        video_processor=SmolVLMVideoProcessor(),
        image_seq_len=(encoder["image_size"] // encoder["patch_size"] // shuffle) ** 2,
        chat_template="{% for m in messages %}{{ m['content'] }}{% endfor %}",
    ).save_pretrained(directory)
    return directory
