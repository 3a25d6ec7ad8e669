# SPDX-License-Identifier: Apache-2.0
"""Likelihood of flow policies: Gaussian noise on the denoised chunk.

A flow policy integrates x from t = 1 (noise) to t = 0 (action) in N Euler steps of δ = 1/N:
x ← x − δ·v(x, t). That map has no usable density, so exploration adds N(0, s²) to its result. Given the
initial noise x₀, whose density does not depend on the weights, the executed action is exactly N(G_θ(x₀), s²),
and its mean is the stock action. Padded action dims and rows that are not executed are never fed back, so
leaving them out marginalises them exactly. Re-scoring replays the ODE from x₀: N velocity passes.
Flow-GRPO (arXiv 2505.05470) and πRL (arXiv 2510.25889) make every step Gaussian instead.

Shapes: B batch, K actions per chunk, D = max_action_dim (real dims first, then padding), A real dims,
N steps, L log-prob factors, one per executed row.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from accerl_lerobot.policies.config import FlowSamplerConfig
from accerl_lerobot.policies.family import (
    Action,
    Encoded,
    Latent,
    Model,
    NoiseFamily,
    normal_entropy,
    normal_log_prob,
)

Velocity = Callable[[Tensor, Tensor], Tensor]
"""(x (B, K, D), t (B,)) → v (B, K, D), conditioned on the observations; output in fp32."""


@dataclass(frozen=True, kw_only=True)
class FlowShape:
    """The sizes a chunk is sampled in."""

    num_steps: int  # N denoising steps
    chunk_size: int  # K rows the network denoises
    executed: int  # rows that are executed in the environment, ≤ K (LeRobot's n_action_steps)
    padded_dim: int  # D, LeRobot's max_action_dim
    action_dim: int  # A real dims
    causal: bool = False  # True if no row depends on later ones

    def executed_part(self, x: Tensor) -> Tensor:
        """The executed entries (B, L, A) of (B, K, D)."""
        return x[:, : self.executed, : self.action_dim]

    def integrate(self, velocity: Velocity, x: Tensor) -> Tensor:
        """LeRobot's Euler loop from noise (B, K, D) to actions (B, K, D), padding included."""
        step = -1.0 / self.num_steps
        for k in range(self.num_steps):
            t = 1.0 + k * step  # in double precision, as LeRobot counts it
            times = x.new_full((len(x),), t)
            x = x + step * velocity(x, times)
        return x


class FlowModel(Model):
    """A LeRobot policy that denoises a chunk with a velocity field; `Encoded.context` is a `Velocity`."""

    shape: FlowShape


def flow_shape(config: Any, num_steps: int, causal: bool = False) -> FlowShape:
    """The sizes in a LeRobot flow policy's config."""
    return FlowShape(
        num_steps=num_steps,
        chunk_size=config.chunk_size,
        executed=config.n_action_steps,
        padded_dim=config.max_action_dim,
        action_dim=config.action_feature.shape[0],
        causal=causal,
    )


class FlowFamily(NoiseFamily):
    """Flow policies explored by noise on the denoised chunk.

    The latent is ``path``, (2, K, D): the noise that was denoised, and the noisy result.
    """

    def __init__(self, model: FlowModel, sampler: FlowSamplerConfig) -> None:
        super().__init__(model, sampler)
        self.shape = model.shape
        size = (self.shape.chunk_size, self.shape.padded_dim)
        # As many as steps are drawn, though one is used: recorded runs used these numbers.
        self.noise_sizes = (size, (self.shape.num_steps, *size))
        entries = self.shape.executed * self.shape.action_dim
        self.entropy = entries * float(normal_entropy(torch.tensor(sampler.noise_level)))
        """Differential entropy of the executed entries; no weight changes it."""

    def sample(self, velocity: Velocity, x0: Tensor, eps: Tensor, explore: Tensor) -> Action:
        """Denoises `x0` (B, K, D); adds the last noise of `eps` (B, N, K, D) where `explore` (B,)."""
        mean = self.shape.integrate(velocity, x0)
        noisy = mean + self._std(x0) * eps[:, -1]
        x = torch.where(explore[:, None, None], noisy, mean)
        log_prob = self._rows(x, mean)
        return Action(
            chunk=self.shape.executed_part(x),
            latent={"path": torch.stack([x0, x], 1)},
            log_prob=torch.where(explore[:, None], log_prob, 0.0),
        )

    def log_prob(self, velocity: Velocity, latent: Latent) -> Tensor:
        """Log-density of stored latents under the current velocity field, (B, L), differentiable."""
        x0, x = latent["path"].unbind(1)
        return self._rows(x, self.shape.integrate(velocity, x0))

    def imitation_loss(self, encoded: Encoded, chunk: Tensor) -> Tensor:
        """Flow matching at a time from LeRobot's Beta(1.5, 1).

        The last action stands for those after it, as at the end of an episode in LeRobot's training. These
        rows count where executed ones depend on them.
        """
        rows = torch.arange(self.shape.chunk_size).clamp(max=self.shape.executed - 1)
        target = chunk.new_zeros(len(chunk), self.shape.chunk_size, self.shape.padded_dim)
        target[..., : self.shape.action_dim] = chunk[:, rows]
        noise = torch.randn_like(target)
        times = torch.distributions.Beta(1.5, 1.0).sample((len(chunk),))
        t = times.to(chunk) * 0.999 + 0.001
        share = t[:, None, None]
        mixed = share * noise + (1 - share) * target
        error = encoded.context(mixed, t) - (noise - target)
        counted = self.shape.executed if self.shape.causal else self.shape.chunk_size
        return error[:, :counted, : self.shape.action_dim].square().mean((1, 2))

    def _std(self, like: Tensor) -> Tensor:
        return like.new_full((), self.sampler.noise_level)

    def _rows(self, x: Tensor, mean: Tensor) -> Tensor:
        """Log-density (B, L) of the executed entries of x (B, K, D)."""
        executed = self.shape.executed_part(x)
        executed_mean = self.shape.executed_part(mean)
        return normal_log_prob(executed, executed_mean, self._std(x)).sum(-1)
