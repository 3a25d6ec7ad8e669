# SPDX-License-Identifier: Apache-2.0
"""π0 and its kin at a tenth of a million parameters, offline.

LeRobot's configs know two sizes of Gemma, 0.3 and 2 billion parameters. `small` puts other sizes in where
LeRobot's modules look theirs up, whenever a policy is built or loaded; everything else is LeRobot's own code.
"""

import contextlib
import importlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from huggingface_hub import constants
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers
from transformers import PreTrainedTokenizerFast

from accerl_lerobot.checkpoint.layout import BACKBONE, FAST
from accerl_lerobot.policies.vla import data_only
from tests.hub_cache import cached_repo
from tests.policies.checkpoints import write_policy

PALIGEMMA = "google/paligemma-3b-pt-224"  # the tokeniser that LeRobot's processors ask the Hub for
ACTIONS = "lerobot/fast-action-tokenizer"  # the tokeniser of actions that π0-FAST asks for
COMMIT = "0123456789abcdef0123456789abcdef01234567"
KINDS = ("pi0", "pi05")  # policies of the flow family
VOCABULARY = 400
SKIP = 8  # PaliGemma's last tokens, which are none of FAST's; LeRobot's `fast_skip_tokens`
SCALE, LOWEST, CHARACTERS = 8.0, -32, 64
"""FAST rounds coefficients times the first to one of so many integers from the second on."""
IMAGE = 32
TEXTS = ("Match the target", "Mirror the target", "Task: , State: 0 1 2 3;\nAction: |")


@contextlib.contextmanager
def small() -> Iterator[None]:
    """Two narrow Gemmas in place of both of LeRobot's, and a SigLIP of one layer."""
    with pytest.MonkeyPatch.context() as patch:
        for kind in (*KINDS, "pi0_fast"):
            module = importlib.import_module(f"lerobot.policies.{kind}.modeling_{kind}")
            patch.setattr(module, "get_gemma_config", _sizes(module.GemmaConfig))
            name = "PaliGemmaForConditionalGenerationWithPiGemma"
            patch.setattr(module, name, _shrunk(getattr(module, name)))
            if kind in KINDS:
                patch.setattr(module, "PiGemmaForCausalLM", _shrunk(module.PiGemmaForCausalLM))
        yield


def _sizes(gemma_config: Any) -> Any:
    def get_gemma_config(variant: str) -> Any:
        width = {"gemma_2b": 32, "gemma_300m": 24}[variant]
        return gemma_config(width=width, depth=2, mlp_dim=2 * width, num_heads=8, num_kv_heads=1, head_dim=8)

    return get_gemma_config


def _shrunk(real: Any) -> Any:
    def build(config: Any) -> Any:
        text = getattr(config, "text_config", config)
        text.vocab_size = VOCABULARY
        if text is not config:
            config._vocab_size, config.image_token_index = VOCABULARY, VOCABULARY - 1
            vision = config.vision_config
            vision.hidden_size, vision.intermediate_size, vision.num_attention_heads = 16, 32, 2
            vision.num_hidden_layers, vision.image_size, vision.patch_size = 1, IMAGE, 16
            vision.projection_dim = config.projection_dim = text.hidden_size
        return real(config=config)

    return build


def write_fast(directory: Path) -> Path:
    """A tokeniser of actions in the files that FAST's has: characters, two zeros in one, half a letter."""
    byte_level = pre_tokenizers.ByteLevel(add_prefix_space=False)
    letters = [byte_level.pre_tokenize_str(chr(i))[0][0] for i in range(CHARACTERS)]
    half = byte_level.pre_tokenize_str("é")[0][0][0]  # decodes to U+FFFD
    zeros = letters[-LOWEST] * 2
    vocabulary = {token: i for i, token in enumerate([*letters, half, zeros])}
    raw = Tokenizer(models.BPE(vocab=vocabulary, merges=[(letters[-LOWEST], letters[-LOWEST])]))
    raw.pre_tokenizer, raw.decoder = byte_level, decoders.ByteLevel()
    PreTrainedTokenizerFast(tokenizer_object=raw).save_pretrained(directory)
    config = {"processor_class": "UniversalActionProcessor", "scale": SCALE, "min_token": LOWEST}
    config["auto_map"] = {"AutoProcessor": "processing_action_tokenizer.UniversalActionProcessor"}
    (directory / "processor_config.json").write_text(json.dumps(config))
    return directory


def write_tokenizer(directory: Path) -> Path:
    """Bytes, some words, and at the end fillers, which is where PaliGemma has tokens that are no text."""
    raw = Tokenizer(models.BPE())
    raw.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    trainer = trainers.BpeTrainer(
        vocab_size=300,
        special_tokens=["<pad>", "<eos>", "<bos>", "<unk>"],
        initial_alphabet=sorted(pre_tokenizers.ByteLevel.alphabet()),
        show_progress=False,
    )
    raw.train_from_iterator(TEXTS, trainer)
    learnt = json.loads(raw.to_str())["model"]
    vocabulary = learnt["vocab"]
    vocabulary |= {f"<loc{i:04d}>": i for i in range(len(vocabulary), VOCABULARY)}
    full = Tokenizer(models.BPE(vocab=vocabulary, merges=[tuple(pair) for pair in learnt["merges"]]))
    full.pre_tokenizer, full.decoder = raw.pre_tokenizer, decoders.ByteLevel()
    PreTrainedTokenizerFast(
        tokenizer_object=full, pad_token="<pad>", eos_token="<eos>", bos_token="<bos>", unk_token="<unk>"
    ).save_pretrained(directory)
    return directory


@contextlib.contextmanager
def hub(cache: Path) -> Iterator[None]:
    """A Hub cache that holds both tokenisers, as after a download; nothing else reaches the Hub."""
    for name, write in ((PALIGEMMA, write_tokenizer), (ACTIONS, write_fast)):
        config = cached_repo(cache, name, COMMIT) / "config.json"
        if not config.exists():
            write(config.parent)
            config.write_text('{"model_type": "paligemma"}')
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(constants, "HF_HUB_CACHE", str(cache))
        yield


def write_pi(
    directory: Path, kind: str, *, padded_dim: int = 2, chunk: int = 4, executed: int = 4,
    num_steps: int = 3, prompt: int = 48, whole: bool = True, image: int = IMAGE, **fields: Any,
) -> Path:  # fmt: skip
    """Saves a random policy with identity-like normalisation as LeRobot does; call it within `small`.

    `num_steps` are pi0_fast's most tokens. The longest of `tiny.TEXTS` takes 20 tokens of a `prompt`, π0.5
    adds 20 or so with the state. If `whole`, the tokeniser lies beside it, as in our checkpoints.
    """
    fast = {"max_decoding_steps": num_steps, "max_action_tokens": 32, "fast_skip_tokens": SKIP}
    cache = directory.parent / f"{directory.name}-hub"
    with hub(cache), data_only():
        write_policy(
            directory, kind, image=image, seed=1, prepare=_spread,
            chunk_size=chunk, n_action_steps=executed, max_state_dim=4, max_action_dim=padded_dim,
            image_resolution=(IMAGE, IMAGE), tokenizer_max_length=prompt,
            **({"num_inference_steps": num_steps} if kind in KINDS else fast), **fields,
        )  # fmt: skip
    if whole:
        write_tokenizer(directory / BACKBONE)
        shutil.rmtree(cache)
        if kind == "pi0_fast":
            write_fast(directory / FAST)
    return directory


def _spread(policy: Any) -> None:
    """Makes the time matter, and action tokens of π0-FAST more likely than others."""
    with torch.no_grad():
        for name, parameter in policy.named_parameters():
            if ".dense." in name:  # adaptive norms start at zero, where the time has no effect
                parameter.normal_(std=0.1)
        if policy.config.type == "pi0_fast":
            head = policy.model.paligemma_with_expert.paligemma.lm_head.weight
            head.normal_(std=0.4)
            head[: VOCABULARY - SKIP - CHARACTERS - 2] *= 0.1
