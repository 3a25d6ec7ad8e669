# SPDX-License-Identifier: Apache-2.0
"""A random backbone: SmolVLM's own files, small, with a tokeniser that has learned the instructions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from accerl_lerobot.demos.backbone import SPECIAL_TOKENS, Sizes, write_backbone

TEXTS = ["Open the door", "Close the drawer"]


def tokenizer_of(directory: Path) -> Any:
    from transformers import AutoTokenizer

    return AutoTokenizer.from_pretrained(directory)


def test_instructions_are_few_tokens_and_others_still_encode(tmp_path: Path):
    learned = tokenizer_of(write_backbone(tmp_path / "learned", TEXTS))
    plain = tokenizer_of(write_backbone(tmp_path / "plain"))
    assert [len(plain(text).input_ids) for text in TEXTS] == [13, 16], "a byte each"
    assert all(len(learned(text).input_ids) <= 5 for text in TEXTS)
    for text in (*TEXTS, "Öffne die Tür 🚪", "pick\tup\n"):
        for tokenizer in (learned, plain):
            assert tokenizer.decode(tokenizer(text).input_ids) == text


def test_the_vocabulary_is_bounded_and_ids_are_those_of_the_config(tmp_path: Path):
    from transformers import AutoConfig

    many = [f"Task number {i} of a benchmark: {i * 7919}" for i in range(200)]
    directory = write_backbone(tmp_path / "backbone", many, Sizes(vocabulary=300))
    tokenizer, config = tokenizer_of(directory), AutoConfig.from_pretrained(directory)
    assert len(tokenizer) == config.text_config.vocab_size <= 300
    assert config.image_token_id == tokenizer.convert_tokens_to_ids("<image>")
    assert config.pad_token_id == tokenizer.pad_token_id
    assert all(len(tokenizer(token).input_ids) == 1 for token in SPECIAL_TOKENS)
