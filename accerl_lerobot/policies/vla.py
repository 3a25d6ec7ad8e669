# SPDX-License-Identifier: Apache-2.0
"""LeRobot's vision-language-action policies: SmolVLA, π0, π0.5 and π0-FAST.

LeRobot's samplers run without gradient, so their parts are driven here: `embed_prefix`, the language model,
`denoise_step`. Each sampler is compared with the installed LeRobot's own whenever a policy is loaded.

*Flow.* Images and instruction are read once, into a key-value cache; `denoise_step` works on a copy that it
makes itself, so one cache serves every step of a chunk. Sampling and log-probs are `flow.FlowFamily`'s.

*Tokens of π0-FAST.* Both ways to the logits start from one pass over the prefix: images, prompt (which holds
the state), BOS, all attending to each other. `generate` goes on token by token with the cache; `logits` shows
the cache all tokens at once, each attending to those before it. LeRobot trains with BOS as the first of the
causal tokens and samples with BOS inside the bidirectional prefix: log-probs in the layout of training would
be another policy's, so here it is the layout of sampling, at both ends.

*Decoding* is LeRobot's `detokenize_actions` on the tokens before the terminator ``|``. Tokens that mean
nothing to FAST's tokeniser are skipped, missing coefficients are zeros, too many are cut off, and where
decoding fails the chunk is zeros. Only the check that the text begins with ``Action:``, an assertion, is
switched off in what is loaded and saved: a policy that explores will begin otherwise at times.
"""

from __future__ import annotations

import contextlib
import json
import logging
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from lerobot.policies.common.vla_utils import (
    clone_past_key_values,
    make_att_2d_masks,
    prepare_attention_masks_4d,
)
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from scipy.fft import dct
from torch import Tensor

from accerl_lerobot.checkpoint.layout import BACKBONE_FILES
from accerl_lerobot.checkpoint.safety import FileSource, matching_files
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.family import Encoded, NoDensityError
from accerl_lerobot.policies.flow import FlowModel, Velocity, flow_shape
from accerl_lerobot.policies.tokens import Choose, TokenContext, TokenModel


def _run(
    network: Any, embedded: Tensor, mask: Tensor, places: Tensor, cache: Any = None
) -> tuple[Tensor, Any]:
    """Hidden states of a language model on tokens at these places, and its key-value cache."""
    (hidden, _), cache = network.forward(
        attention_mask=mask,
        position_ids=places,
        past_key_values=cache,
        inputs_embeds=[embedded, None],
        use_cache=True,
    )
    return hidden, cache


def _read_prefix(network: Any, embedded: Tensor, pad: Tensor, mask: Tensor) -> tuple[Tensor, Any]:
    """`_run` on the prefix, whose real tokens `pad` (B, P) marks."""
    places = torch.cumsum(pad, dim=1) - 1
    return _run(network, embedded, mask, places)


def _velocity(model: Any, pad: Tensor, cache: Any, **shown: Tensor) -> Velocity:
    """The velocity field that a LeRobot network has after its prefix; `shown` goes to the expert directly."""

    def velocity(x: Tensor, t: Tensor) -> Tensor:
        return model.denoise_step(
            prefix_pad_masks=pad, past_key_values=cache, x_t=x, timestep=t.to(torch.float32), **shown
        ).float()

    return velocity


VISION_LAYER = r".*\.vision_model\.encoder\.layers\.\d+"
PART_OF_LAYER = r".*\.layers\.\d+\.(self_attn\.[qkvo]_proj|mlp)"  # of the language model and the expert
NORM_OF_EXPERT = r".*\.gemma_expert\.model\.layers\.\d+\.(input|post_attention)_layernorm"


class SmolVLA(FlowModel):
    """Drives LeRobot's `SmolVLAPolicy`."""

    backbone = "model.vlm_with_expert.vlm."
    blocks = rf"{VISION_LAYER}|{PART_OF_LAYER}"
    unread = ("model.vlm_with_expert.vlm.lm_head.weight",)

    def __init__(self, policy: Any) -> None:
        super().__init__(policy)
        if policy.config.adapt_to_pi_aloha:
            hint = "not supported in RL; train one without it"
            raise NoDensityError("policy.adapt_to_pi_aloha", True, hint)
        self.shape = flow_shape(policy.config, policy.config.num_steps, causal=True)
        self.width = policy.model.vlm_with_expert.config.text_config.hidden_size

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        """The features are the prefix's: images, instruction, state."""
        model = self.policy.model
        images, image_masks = self.policy.prepare_images(batch)
        embedded, pad, att = model.embed_prefix(
            images,
            image_masks,
            batch[OBS_LANGUAGE_TOKENS],
            batch[OBS_LANGUAGE_ATTENTION_MASK],
            state=self.policy.prepare_state(batch),
        )
        features, cache = _read_prefix(model.vlm_with_expert, embedded, pad, make_att_2d_masks(pad, att))
        return Encoded(features=features, mask=pad, context=_velocity(model, pad, cache))


VLM = "model.paligemma_with_expert.paligemma."
LANGUAGE_MODEL = f"{VLM}model.language_model."


class Pi05(FlowModel):
    """Drives LeRobot's `PI05Policy`: PaliGemma reads, a smaller Gemma, the action expert, denoises."""

    backbone = VLM
    blocks = rf"{VISION_LAYER}|{PART_OF_LAYER}|{NORM_OF_EXPERT}"
    unread = (f"{VLM}lm_head.weight", "model.paligemma_with_expert.gemma_expert.lm_head.weight")

    def __init__(self, policy: Any) -> None:
        super().__init__(policy)
        self.shape = flow_shape(policy.config, policy.config.num_inference_steps)
        language_model = policy.model.paligemma_with_expert.paligemma.model.language_model
        # As LeRobot's own sampler has it, which switches it on at its first call.
        language_model.config._attn_implementation = "eager"
        self.width = language_model.config.hidden_size
        # The expert reads the last layer's keys and values; what that layer makes of them is for the critic.
        last = f"{LANGUAGE_MODEL}layers.{len(language_model.layers) - 1}"
        self.idle = (
            *self.unread,
            f"{LANGUAGE_MODEL}norm.",
            f"{last}.self_attn.q_proj.",
            f"{last}.self_attn.o_proj.",
            f"{last}.mlp.",
            f"{last}.post_attention_layernorm.",
        )

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        """The features are the prefix's: images and prompt."""
        model = self.policy.model
        images, image_masks = self.policy._preprocess_images(batch)
        embedded, pad, att = model.embed_prefix(
            images, image_masks, batch[OBS_LANGUAGE_TOKENS], batch[OBS_LANGUAGE_ATTENTION_MASK]
        )
        mask = prepare_attention_masks_4d(make_att_2d_masks(pad, att))
        features, cache = _read_prefix(model.paligemma_with_expert, embedded, pad, mask)
        shown = self._shown_to_expert(batch)
        # The critic reads the prefix: what is not in it stands beside every token, so their mean keeps it.
        for tensor in shown.values():
            beside = tensor[:, None].expand(-1, features.shape[1], -1)
            features = torch.cat([features, beside], -1)
        return Encoded(features=features, mask=pad, context=_velocity(model, pad, cache, **shown))

    def _shown_to_expert(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Observations (B, ...) that reach the action expert without passing the prefix."""
        return {}


class Pi0(Pi05):
    """Drives LeRobot's `PI0Policy`, which shows the state to its action expert only."""

    def __init__(self, policy: Any) -> None:
        super().__init__(policy)
        self.width += policy.config.max_state_dim

    def _shown_to_expert(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        return {"state": self.policy.prepare_state(batch)}


END = "|"


@dataclass(frozen=True, kw_only=True)
class FastTokenizer:
    """FAST's action tokeniser (Pertsch et al., arXiv 2501.09747), with the methods that LeRobot calls.

    A chunk is transformed along time (orthonormal DCT-II), scaled and rounded; the coefficients, row by row
    of frequency, become characters, which byte-pair encoding merges into tokens. On the Hub such a tokeniser
    comes as JSON beside a Python file, and LeRobot runs the newest version of that file with full rights. The
    JSON is enough, so `data_only` has LeRobot use this class instead.
    """

    bpe_tokenizer: Any  # merges characters into tokens, a `PreTrainedTokenizerFast`
    scale: float  # factor on coefficients before they are rounded
    min_token: int  # the coefficient that character 0 stands for
    folder: Path

    @classmethod
    def from_pretrained(cls, name: str, **options: Any) -> FastTokenizer:
        """Reads a folder, or the JSON files of a Hub repository; no option changes that."""
        from huggingface_hub import snapshot_download
        from transformers import PreTrainedTokenizerFast

        folder = Path(name)
        if not folder.is_dir():
            folder = Path(snapshot_download(name, allow_patterns=["*.json"]))
        sizes = json.loads((folder / "processor_config.json").read_text())
        merges = PreTrainedTokenizerFast.from_pretrained(folder)
        return cls(bpe_tokenizer=merges, scale=sizes["scale"], min_token=sizes["min_token"], folder=folder)

    def __call__(self, chunks: Any) -> list[list[int]]:
        """Tokens of each of the chunks (B, K, A)."""
        chunks = np.asarray(chunks, dtype=np.float64)
        coefficients = dct(chunks, axis=-2, norm="ortho")
        rounded = np.around(coefficients * self.scale)
        characters = np.maximum(rounded - self.min_token, 0).astype(int)
        texts = ["".join(map(chr, each.flatten())) for each in characters]
        return [self.bpe_tokenizer(text)["input_ids"] for text in texts]

    def save_pretrained(self, directory: Path) -> None:
        """Copies its files; code, where it lies beside them, for those who run it."""
        directory.mkdir(parents=True, exist_ok=True)
        files = matching_files(self.folder, BACKBONE_FILES, FileSource("policy.path", str(self.folder)))
        for name, file in files.items():
            if not (directory / name).exists():
                shutil.copyfile(file, directory / name)


@contextlib.contextmanager
def data_only() -> Iterator[None]:
    """While it lasts, LeRobot reads FAST's tokeniser of actions and runs no code that comes with it."""
    from lerobot.policies.pi0_fast import modeling_pi0_fast
    from lerobot.processor import tokenizer_processor

    with (
        patch.object(modeling_pi0_fast, "AutoProcessor", FastTokenizer),
        patch.object(tokenizer_processor, "AutoProcessor", FastTokenizer),
    ):
        yield


class Pi0Fast(TokenModel):
    """Drives LeRobot's `PI0FastPolicy`."""

    blocks = rf"{VISION_LAYER}|{PART_OF_LAYER}"
    loading = staticmethod(data_only)

    def __init__(self, policy: Any) -> None:
        super().__init__(policy)
        config = policy.config
        if config.temperature != 0:
            hint = "LeRobot's sampler has to be greedy here: set it to 0 in config.json; exploration has a "
            hint += "policy.sampler.temperature"
            raise NoDensityError("policy.temperature", config.temperature, hint)
        rows = config.chunk_size
        if config.n_action_steps != rows:
            # The coefficients of K rows, read as those of fewer, are another, faster and larger movement.
            hint = f"LeRobot decodes so many rows from the coefficients of {rows}; use {rows}"
            raise InputError("policy.n_action_steps", config.n_action_steps, hint)
        config.validate_action_token_prefix = False
        logging.root.addFilter(_decodable)
        self.length = config.max_decoding_steps
        self.terminator = policy._paligemma_tokenizer.convert_tokens_to_ids(END)
        paligemma = policy.model.paligemma_with_expert.paligemma
        self.width = paligemma.model.language_model.config.hidden_size

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        """The features are the prefix's: images, prompt, BOS."""
        model = self.policy.model
        network = model.paligemma_with_expert
        images, image_masks = self.policy._preprocess_images(batch)
        prompt = batch[OBS_LANGUAGE_TOKENS]
        known = batch[OBS_LANGUAGE_ATTENTION_MASK]
        bos = torch.full_like(prompt[:, :1], self.policy._paligemma_tokenizer.bos_token_id)
        prompt = torch.cat([prompt, bos], 1)
        known = torch.cat([known, torch.ones_like(known[:, :1])], 1)
        embedded, pad, att, _, _ = model.embed_prefix_fast(images, image_masks, prompt, known)
        mask = prepare_attention_masks_4d(att, dtype=embedded.dtype)
        features, cache = _read_prefix(network, embedded, pad, mask)

        def follow(tokens: Tensor, cache: Any, first: int) -> Tensor:
            """Hidden states (B, n, width) at the n positions from `first` on, whose tokens are (B, n)."""
            positions = torch.arange(first + tokens.shape[1], device=tokens.device)
            asked = positions[first:]
            seen = positions <= asked[:, None]
            whole = pad[:, None].expand(-1, len(asked), -1)
            generated = seen.expand(len(pad), -1, -1)
            attends = torch.cat([whole, generated], 2)
            embedded = network.embed_language_tokens(tokens)
            mask = prepare_attention_masks_4d(attends, dtype=embedded.dtype)
            places = pad.sum(1, keepdim=True) + asked
            states, _ = _run(network, embedded, mask, places, cache)
            return states

        def logits(tokens: Tensor) -> Tensor:
            states = features[:, -1:]
            if tokens.shape[1] > 1:
                following = follow(tokens[:, :-1], clone_past_key_values(cache), 0)
                states = torch.cat([states, following], 1)
            return network.paligemma.lm_head(states)

        def generate(choose: Choose) -> None:
            own = clone_past_key_values(cache)
            state = features[:, -1]
            for position in range(self.length):
                tokens = choose(network.paligemma.lm_head(state), position)
                if position == self.length - 1 or bool((tokens == self.terminator).all()):
                    return
                state = follow(tokens[:, None], own, position)[:, 0]

        return Encoded(features=features, mask=pad, context=TokenContext(logits=logits, generate=generate))

    def chunk(self, tokens: Tensor) -> Tensor:
        config = self.policy.config
        (action_dim,) = config.action_feature.shape
        return self.policy.detokenize_actions(
            tokens, action_horizon=config.n_action_steps, action_dim=action_dim
        )


def _decodable(record: logging.LogRecord) -> bool:
    """False for both lines that LeRobot logs of a sequence that it cannot decode: exploring draws many."""
    return not str(record.msg).startswith(("Error decoding tokens", "Tokens: "))
