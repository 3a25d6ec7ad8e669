# SPDX-License-Identifier: Apache-2.0
"""SmolVLA: prefix once, then denoising steps against its key-value cache.

Touches LeRobot internals (`embed_prefix`, `vlm_with_expert.forward`, `denoise_step`), so the hand-driven
sampler is compared with the installed LeRobot's own whenever a policy is loaded.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.family import Encoded
from accerl_lerobot.policies.flow import FlowContext, FlowModel, flow_shape, refuse_options
from accerl_lerobot.policies.tokens import TokenContext, TokenModel


class SmolVLA(FlowModel):
    """Drives LeRobot's `SmolVLAPolicy`."""

    backbone = "model.vlm_with_expert.vlm."
    unread = ("model.vlm_with_expert.vlm.lm_head.weight",)

    def __init__(self, policy: Any) -> None:
        config = policy.config
        refuse_options(config)
        if config.adapt_to_pi_aloha:
            raise InputError(
                "policy.adapt_to_pi_aloha", True, "not supported in RL; train a policy without it"
            )
        self.policy = policy
        self.shape = flow_shape(config, config.num_steps)
        self.width = policy.model.vlm_with_expert.config.text_config.hidden_size

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        """The features are the prefix's: images, instruction, state."""
        from lerobot.policies.common.vla_utils import make_att_2d_masks
        from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS

        model = self.policy.model
        images, image_masks = self.policy.prepare_images(batch)
        embedded, pad, att = model.embed_prefix(
            images, image_masks, batch[OBS_LANGUAGE_TOKENS], batch[OBS_LANGUAGE_ATTENTION_MASK],
            state=self.policy.prepare_state(batch),
        )  # fmt: skip
        (features, _), cache = model.vlm_with_expert.forward(
            attention_mask=make_att_2d_masks(pad, att),
            position_ids=torch.cumsum(pad, dim=1) - 1,
            past_key_values=None,
            inputs_embeds=[embedded, None],
            use_cache=True,
        )

        def velocity(x: Tensor, t: Tensor) -> Tensor:
            v: Tensor = model.denoise_step(
                prefix_pad_masks=pad, past_key_values=cache, x_t=x, timestep=t.to(torch.float32)
            )
            return v.float()

        return Encoded(features=features, mask=pad, context=FlowContext(velocity=velocity))

    def stock(self, batch: dict[str, Tensor], noise: Tensor) -> Tensor:
        chunk: Tensor = self.policy.predict_action_chunk(batch, noise=noise)
        return chunk


class SmolVLABins(TokenModel):
    """Drives `bins_plugin`'s policy; queries of rows that are not executed have no token."""

    backbone = "model.vlm."
    parallel = True
    terminator = None

    def __init__(self, policy: Any) -> None:
        self.policy = policy
        self.rows = int(policy.config.n_action_steps)
        self.length = self.rows * policy.config.action_feature.shape[0]
        self.width = policy.model.head.in_features

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        """The features are the queries' hidden states, as in AcceRL."""
        hidden = self.policy.hidden(batch)
        logits = self.policy.model.logits(hidden[:, : self.length])
        mask = torch.ones(hidden.shape[:2], dtype=torch.bool, device=hidden.device)
        return Encoded(features=hidden, mask=mask, context=TokenContext(logits=lambda tokens: logits))

    def chunk(self, tokens: Tensor) -> Tensor:
        chunk: Tensor = self.policy.decode_tokens(tokens).view(len(tokens), self.rows, -1)
        return chunk

    def stock(self, batch: dict[str, Tensor]) -> Tensor:
        chunk: Tensor = self.policy.predict_action_chunk(batch)[:, : self.rows]
        return chunk
