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
from accerl_lerobot.policies.flow import FlowContext, FlowModel
from accerl_lerobot.policies.models.options import flow_shape, refuse_options


class SmolVLA(FlowModel):
    """Drives LeRobot's `SmolVLAPolicy`.

    Args:
        policy: a loaded one.
    """

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
        """See the base class; the features are the prefix's: images, instruction, state."""
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
        """See the base class."""
        chunk: Tensor = self.policy.predict_action_chunk(batch, noise=noise)
        return chunk
