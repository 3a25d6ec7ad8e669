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
"""SmolVLA as a stochastic policy: prefix once, then denoising steps against its key-value cache.

Touches LeRobot internals (`embed_prefix`, `vlm_with_expert.forward`, `denoise_step`), so `self_check`
compares the hand-driven sampler with the installed LeRobot's own whenever a policy is loaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Decision, Request
from accerl_lerobot.policies import flow
from accerl_lerobot.policies.base import Evaluation, PolicyAdapter, stack_observations
from accerl_lerobot.policies.processing import Processing
from accerl_lerobot.policies.value_head import ValueHead, ValueHeadConfig

SELF_CHECK_TOLERANCE = 1e-5
"""Largest difference, in normalised action units, between our ODE and LeRobot's; fp32 noise is 1e-6."""


class SmolVLAAdapter(PolicyAdapter):
    """Flow-matching likelihood over LeRobot's `SmolVLAPolicy`.

    Args:
        policy: a loaded `SmolVLAPolicy`.
        processing: its LeRobot processors.
        sampler: how it explores.
        value_head: the critic.
    """

    def __init__(
        self,
        policy: Any,
        processing: Processing,
        sampler: flow.FlowSamplerConfig,
        value_head: ValueHeadConfig,
    ) -> None:
        super().__init__()
        config = policy.config
        if config.rtc_config is not None and config.rtc_config.enabled:
            raise InputError(
                "policy.rtc_config.enabled",
                True,
                "real-time chunking changes the sampler's density; turn it off",
            )
        if config.adapt_to_pi_aloha:
            raise InputError(
                "policy.adapt_to_pi_aloha", True, "not supported in RL; train a policy without it"
            )
        if config.compile_model:
            raise InputError(
                "policy.compile_model",
                True,
                "a compiled sampler rounds unlike the re-scoring pass; set it to false in config.json",
            )
        self.policy = policy
        self.processing = processing
        self.sampler = sampler
        self.device = next(policy.parameters()).device
        self.shape = flow.FlowShape(
            num_steps=config.num_steps,
            chunk_size=config.chunk_size,
            executed=config.n_action_steps,
            padded_dim=config.max_action_dim,
            action_dim=config.action_feature.shape[0],
        )
        width = policy.model.vlm_with_expert.config.text_config.hidden_size
        self.value_head = ValueHead(width, value_head).to(self.device)
        self.policy.eval()

    @property
    def actions(self) -> int:
        """See the base class; a factor is a row of the chunk."""
        return flow.factors(self.shape, self.sampler)

    def decide(self, requests: Sequence[Request], version: int) -> list[Decision]:
        """See the base class; each decision's noise is its own request's, whatever batch it lands in."""
        arrays, tasks = stack_observations(requests)
        x0, eps, index = self._noise(requests)
        explore = torch.tensor([r.explore for r in requests], device=self.device)
        with torch.no_grad():
            velocity, value = self._prefix(arrays, tasks)
            x, latent, logp = flow.sample(velocity, x0, eps, index, explore, self.shape, self.sampler)
            chunk = self.processing.unnormalise(x[:, : self.shape.executed, : self.shape.action_dim])
        stored = {k: v.cpu().numpy() for k, v in latent.items()}
        chunks, logps, values = chunk.cpu().numpy(), logp.cpu().numpy(), value.cpu().numpy()
        return [
            Decision(
                chunk=chunks[i],
                latent={k: v[i] for k, v in stored.items()},
                log_prob=logps[i],
                value=float(values[i]),
                version=version,
            )
            for i in range(len(requests))
        ]

    def evaluate(
        self, observations: dict[str, np.ndarray], tasks: Sequence[str], latent: dict[str, Tensor]
    ) -> Evaluation:
        """See the base class."""
        velocity, value = self._prefix(observations, tasks)
        latent = {k: v.to(self.device) for k, v in latent.items()}
        return Evaluation(
            log_prob=flow.log_prob(velocity, latent, self.shape, self.sampler),
            entropy=flow.entropy(latent, self.shape, self.sampler),
            value=value,
        )

    @torch.no_grad()
    def values(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> Tensor:
        """See the base class."""
        return self._prefix(observations, tasks)[1]

    def trainable(self) -> dict[str, nn.Parameter]:
        """See the base class; what LeRobot's config freezes stays frozen."""
        named = {f"policy.{k}": p for k, p in self.policy.named_parameters() if p.requires_grad}
        return named | {f"value_head.{k}": p for k, p in self.value_head.named_parameters()}

    def self_check(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> float:
        """Largest difference between our σ = 0 sampler and LeRobot's `predict_action_chunk` on equal noise.

        Raises:
            RuntimeError: above `SELF_CHECK_TOLERANCE`, or LeRobot's internals have changed.
        """
        size = (len(tasks), self.shape.chunk_size, self.shape.padded_dim)
        x0 = torch.randn(size, generator=torch.Generator().manual_seed(0)).to(self.device)
        still = torch.zeros(len(tasks), dtype=torch.bool, device=self.device)
        eps, index = x0[:, None].expand(-1, self.shape.num_steps, -1, -1), still.long()
        try:
            batch = self.processing.prepare(observations, tasks)
            stock = self.policy.predict_action_chunk(batch, noise=x0.clone())
            with torch.no_grad():
                velocity, _ = self._prefix(observations, tasks)
                ours, _, _ = flow.sample(velocity, x0, eps, index, still, self.shape, self.sampler)
        except (AttributeError, ImportError, KeyError, TypeError) as error:
            raise _incompatible(f"cannot drive it ({type(error).__name__}: {error})") from error
        self.policy.reset()
        difference = float((ours[..., : self.shape.action_dim] - stock).abs().max())
        if not difference <= SELF_CHECK_TOLERANCE:
            raise _incompatible(f"differs from its sampler by {difference:.2e}")
        return difference

    def _prefix(
        self, observations: dict[str, np.ndarray], tasks: Sequence[str]
    ) -> tuple[flow.Velocity, Tensor]:
        """Encodes observations; returns the velocity field conditioned on them and V (B,)."""
        from lerobot.policies.common.vla_utils import make_att_2d_masks
        from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS

        batch, model = self.processing.prepare(observations, tasks), self.policy.model
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
            return model.denoise_step(
                prefix_pad_masks=pad, past_key_values=cache, x_t=x, timestep=t.to(torch.float32)
            )

        return velocity, self.value_head(features, pad)

    def _noise(self, requests: Sequence[Request]) -> tuple[Tensor, Tensor, Tensor]:
        """x0 (B, K, D), eps (B, N, K, D) and the drawn step (B,), each from its own request's seed."""
        n, size = self.shape.num_steps, (self.shape.chunk_size, self.shape.padded_dim)
        x0, eps, index = [], [], []
        for request in requests:
            rng = np.random.default_rng(request.noise_seed)
            x0.append(rng.standard_normal(size, dtype=np.float32))
            eps.append(rng.standard_normal((n, *size), dtype=np.float32))
            index.append(rng.integers(n))
        to = self.device
        return (
            torch.from_numpy(np.stack(x0)).to(to),
            torch.from_numpy(np.stack(eps)).to(to),
            torch.tensor(index, device=to),
        )


def _incompatible(what: str) -> RuntimeError:
    import lerobot

    return RuntimeError(
        f"our SmolVLA adapter does not fit LeRobot {lerobot.__version__}: it {what}, so log-probs would be "
        "those of another policy; install the LeRobot version that this package pins"
    )
