# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
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
from accerl_lerobot.policies.flow import FlowContext, FlowModel, FlowShape


class SmolVLA(FlowModel):
    """Drives LeRobot's `SmolVLAPolicy`.

    Args:
        policy: a loaded one.
    """

    backbone = "model.vlm_with_expert.vlm."

    def __init__(self, policy: Any) -> None:
        config = policy.config
        refuse_flow_options(config)
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


def flow_shape(config: Any, num_steps: int) -> FlowShape:
    """The sizes in a LeRobot flow policy's config.

    Args:
        config: LeRobot's.
        num_steps: what this policy type calls its number of denoising steps.
    """
    return FlowShape(
        num_steps=num_steps,
        chunk_size=config.chunk_size,
        executed=config.n_action_steps,
        padded_dim=config.max_action_dim,
        action_dim=config.action_feature.shape[0],
    )


def refuse_flow_options(config: Any) -> None:
    """Refuses what would change the sampler's density behind our back.

    Raises:
        InputError: real-time chunking or compilation is on.
    """
    if config.rtc_config is not None and config.rtc_config.enabled:
        raise InputError(
            "policy.rtc_config.enabled",
            True,
            "real-time chunking changes the sampler's density; turn it off",
        )
    if config.compile_model:
        raise InputError(
            "policy.compile_model",
            True,
            "a compiled sampler rounds unlike the re-scoring pass; set it to false in config.json",
        )
