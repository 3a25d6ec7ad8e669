# SPDX-License-Identifier: Apache-2.0
"""The policy ``smolvla_bins``: all bins of a chunk in one pass through SmolVLM.

    [images, instruction] [state] [K·A queries]  ──language model──►  K·A hidden states ──head──► bins

Images, instruction and state form the prefix as in smolvla: what is in brackets sees itself and what is to
the left. Queries are learned vectors, one per row and action dimension, and see each other both ways, so
that the bins, independent given the observations, can still agree on what to do.

Unlike smolvla, the language model runs as Transformers runs it: with its own rotary base and without scaling
of embeddings, as it was trained.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import torch
from lerobot.policies.common.vla_utils import resize_with_pad
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS, OBS_STATE
from torch import Tensor, nn
from torch.nn import functional
from transformers import AutoConfig, AutoModelForImageTextToText

from lerobot_policy_smolvla_bins.configuration_smolvla_bins import SmolVLABinsConfig


class ParallelDecoder(nn.Module):
    def __init__(self, config: SmolVLABinsConfig) -> None:
        super().__init__()
        # SDPA: the one implementation that takes our mask as it is, on every device.
        options = {"attn_implementation": "sdpa", "dtype": torch.float32}
        auto, name = AutoModelForImageTextToText, config.vlm_model_name
        if config.load_vlm_weights:
            whole = auto.from_pretrained(name, **options)
        else:
            whole = auto.from_config(AutoConfig.from_pretrained(name), **options)
        self.vlm = whole.model  # without the output layer: its vocabulary is replaced by the bins
        text = self.vlm.text_model
        text.layers = text.layers[: config.num_vlm_layers or None]
        width = text.config.hidden_size
        state, action = config.robot_state_feature, config.action_feature
        self.state_proj = None if state is None else nn.Linear(state.shape[0], width)
        self.queries = nn.Parameter(0.02 * torch.randn(config.chunk_size * action.shape[0], width))
        self.head = nn.Linear(width, config.num_bins)
        self.vlm.vision_model.requires_grad_(not config.freeze_vision_encoder)
        text.requires_grad_(not config.freeze_language_model)

    def forward(self, images: list[Tensor], tokens: Tensor, mask: Tensor, state: Tensor | None) -> Tensor:
        """The queries' hidden states (B, K·A, width).

        Images are (B, 3, H, W) in [-1, 1]; `mask`, bool (B, T), is True where a token is no padding.
        """
        parts = [self.vlm.connector(self.vlm.vision_model(pixel_values=i).last_hidden_state) for i in images]
        parts.append(self.vlm.text_model.get_input_embeddings()(tokens))
        blocks, words = [0] * len(parts), len(parts) - 1
        if state is not None and self.state_proj is not None:
            parts.append(self.state_proj(state)[:, None])
            blocks.append(1)
        parts.append(self.queries.expand(len(tokens), -1, -1))
        blocks.append(2)
        real = [torch.ones_like(part[..., 0], dtype=torch.bool) for part in parts]
        real[words] = mask
        sizes = torch.tensor([p.shape[1] for p in parts], device=mask.device)
        block = torch.tensor(blocks, device=mask.device).repeat_interleave(sizes)
        # Padding is seen by none but sees, so that no row of the softmax is empty.
        attention = (block[None, :] <= block[:, None])[None, None] & torch.cat(real, 1)[:, None, None]
        hidden: Tensor = self.vlm.text_model(
            inputs_embeds=torch.cat(parts, 1),
            attention_mask=attention,
            position_ids=(torch.cat(real, 1).long().cumsum(1) - 1).clamp(min=0),
            use_cache=False,
        ).last_hidden_state
        return hidden[:, -len(self.queries) :]

    def logits(self, hidden: Tensor) -> Tensor:
        """(B, L, bins), in single precision under autocast too: in bfloat16 a logit of 10 is off by 0.03."""
        with torch.autocast(hidden.device.type, enabled=False):
            logits: Tensor = self.head(hidden.float())
        return logits


class SmolVLABinsPolicy(PreTrainedPolicy):
    """The policy as LeRobot knows it: greedy; a chunk is the centres of the most likely bins."""

    config_class = SmolVLABinsConfig
    name = "smolvla_bins"

    def __init__(self, config: SmolVLABinsConfig, **kwargs: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.config = config
        self.model = ParallelDecoder(config)
        config.load_vlm_weights = False  # what is saved from here on has them
        self.reset()

    def reset(self) -> None:
        self._queue: deque[Tensor] = deque(maxlen=self.config.n_action_steps)

    def get_optim_params(self) -> list[nn.Parameter]:
        return [p for p in self.parameters() if p.requires_grad]

    def hidden(self, batch: dict[str, Tensor]) -> Tensor:
        """The queries' hidden states (B, K·A, width) for a preprocessed batch."""
        images = []
        for key in self.config.image_features:
            image = batch[key]
            if (size := self.config.resize_imgs_with_padding) is not None:
                image = resize_with_pad(image, size[1], size[0], pad_value=0)
            images.append(2 * image - 1)
        tokens, mask = batch[OBS_LANGUAGE_TOKENS], batch[OBS_LANGUAGE_ATTENTION_MASK].bool()
        hidden: Tensor = self.model(images, tokens, mask, batch.get(OBS_STATE))
        return hidden

    def encode_actions(self, actions: Tensor) -> Tensor:
        """Normalised actions (...) to bins (...), int64."""
        bins = self.config.num_bins
        return ((actions + 1) / 2 * bins).floor().clamp(0, bins - 1).long()

    def decode_tokens(self, tokens: Tensor) -> Tensor:
        """Bins (...) to their centres (...) in normalised units."""
        return (2 * tokens.float() + 1) / self.config.num_bins - 1

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Cross-entropy of the demonstrated bins, over rows that belong to the episode.

        `batch` is preprocessed, with ``action`` (B, K, A) and ``action_is_pad`` (B, K); ``reduction="none"``
        gives one loss per sample.
        """
        actions = batch[ACTION]
        tokens = self.encode_actions(actions)
        logits = self.model.logits(self.hidden(batch)).view(*tokens.shape, -1)
        losses = functional.cross_entropy(logits.movedim(-1, 1), tokens, reduction="none")
        pad = batch.get("action_is_pad")
        rows = torch.ones_like(actions[..., 0]) if pad is None else (~pad).to(losses)
        weights = rows[..., None].expand_as(losses)
        each = (losses * weights).sum((1, 2)) / weights.sum((1, 2)).clamp(min=1)
        loss = each if reduction == "none" else (losses * weights).sum() / weights.sum().clamp(min=1)
        return loss, {"loss": loss.mean().item()}

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """(B, K, A), normalised."""
        self.eval()
        tokens = self.model.logits(self.hidden(batch)).argmax(-1)
        return self.decode_tokens(tokens).view(len(tokens), self.config.chunk_size, -1)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """(B, A): the next action of the chunk; a new one when all its `n_action_steps` are used up."""
        if not self._queue:
            chunk = self.predict_action_chunk(batch)
            self._queue.extend(chunk.transpose(0, 1)[: self.config.n_action_steps])
        return self._queue.popleft()

    def _get_default_peft_targets(self) -> dict[str, Any]:
        targets = r"model\.(vlm\.text_model\..*\.(q|v)_proj|state_proj|head)"
        return {"target_modules": targets, "modules_to_save": []}
