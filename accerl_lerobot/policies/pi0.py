# SPDX-License-Identifier: Apache-2.0
"""π0 and π0.5: PaliGemma reads images and instruction once, a smaller Gemma denoises against its cache.

LeRobot's `sample_actions` runs without gradient, so its parts are driven here: `embed_prefix`, the language
model, `denoise_step`. Each `denoise_step` works on a copy of the cache that it makes itself, so one cache
serves every step of a chunk, and one velocity is one pass of the suffix (the action expert) alone.

π0 shows the state to its action expert only, π0.5 writes it into the prompt. The critic, which reads the
prefix, is therefore given π0's state beside every token: whatever the tokens are weighted with, their mean
keeps it whole.

*Precision.* Weights are held in float32 whatever the checkpoint's ``dtype`` says: steps of RL are smaller
than bfloat16 resolves, and log-probs would differ between batches. ``policy.precision=bf16`` computes in
bfloat16 instead. What is saved is float32 and says so; the 4.0 billion parameters of π0 take 16 GB.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from accerl_lerobot.policies.family import Encoded
from accerl_lerobot.policies.flow import FlowContext, FlowModel, flow_shape, refuse_options

VLM = "model.paligemma_with_expert.paligemma."
LANGUAGE_MODEL = f"{VLM}model.language_model."


class Pi05(FlowModel):
    """Drives LeRobot's `PI05Policy`."""

    backbone = VLM
    unread = (f"{VLM}lm_head.weight", "model.paligemma_with_expert.gemma_expert.lm_head.weight")

    def __init__(self, policy: Any) -> None:
        config = policy.config
        refuse_options(config)
        self.policy = policy
        self.shape = flow_shape(config, config.num_inference_steps)
        language_model = policy.model.paligemma_with_expert.paligemma.model.language_model
        # As LeRobot's own sampler has it, which switches it on at its first call.
        language_model.config._attn_implementation = "eager"
        self.width = language_model.config.hidden_size
        # The expert reads the last layer's keys and values; what that layer makes of them is for the critic.
        last = f"{LANGUAGE_MODEL}layers.{len(language_model.layers) - 1}."
        parts = ("self_attn.q_proj.", "self_attn.o_proj.", "mlp.", "post_attention_layernorm.")
        self.idle = (*self.unread, f"{LANGUAGE_MODEL}norm.", *(last + part for part in parts))

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        """The features are the prefix's: images and prompt."""
        from lerobot.policies.common.vla_utils import make_att_2d_masks, prepare_attention_masks_4d
        from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS

        model = self.policy.model
        images, image_masks = self.policy._preprocess_images(batch)
        embedded, pad, att = model.embed_prefix(
            images, image_masks, batch[OBS_LANGUAGE_TOKENS], batch[OBS_LANGUAGE_ATTENTION_MASK]
        )
        (features, _), cache = model.paligemma_with_expert.forward(
            attention_mask=prepare_attention_masks_4d(make_att_2d_masks(pad, att)),
            position_ids=torch.cumsum(pad, dim=1) - 1,
            past_key_values=None,
            inputs_embeds=[embedded, None],
            use_cache=True,
        )
        shown = self._shown_to_expert(batch)

        def velocity(x: Tensor, t: Tensor) -> Tensor:
            v: Tensor = model.denoise_step(
                prefix_pad_masks=pad, past_key_values=cache, x_t=x, timestep=t.to(torch.float32), **shown
            )
            return v.float()

        for tensor in shown.values():
            features = torch.cat([features, tensor[:, None].expand(-1, features.shape[1], -1)], -1)
        return Encoded(features=features, mask=pad, context=FlowContext(velocity=velocity))

    def stock(self, batch: dict[str, Tensor], noise: Tensor) -> Tensor:
        chunk: Tensor = self.policy.predict_action_chunk(batch, noise=noise)
        return chunk

    def _shown_to_expert(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Observations (B, ...) that reach the action expert without passing the prefix."""
        return {}


class Pi0(Pi05):
    """Drives LeRobot's `PI0Policy`."""

    def __init__(self, policy: Any) -> None:
        super().__init__(policy)
        self.width += policy.config.max_state_dim

    def _shown_to_expert(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        return {"state": self.policy.prepare_state(batch)}
