# SPDX-License-Identifier: Apache-2.0
"""Likelihood of flow policies: noise in the denoising steps.

A flow policy integrates x from t = 1 (noise) to t = 0 (action) in N Euler steps of δ = 1/N:
x ← x − δ·v(x, t). That map has no usable density, so exploration makes some steps Gaussian and the log-prob
is that of the path. Which steps:

``last``  Every step but the last is the stock ODE; the last one adds N(0, s²). Given the initial noise x₀,
          whose density does not depend on the weights, the executed action is exactly N(G_θ(x₀), s²). Padded
          action dims and rows that are not executed are never fed back after the last step, so leaving them
          out marginalises them exactly. Re-scoring replays the ODE from x₀: N velocity passes.
``all``   Every step is Gaussian; the path density is the sum over steps (Flow-GRPO, arXiv 2505.05470; πRL,
          arXiv 2510.25889). Exact as well; N velocity passes. Padded dims feed back into real ones, so they
          get noise and belong to the density.
Two noise laws, `FlowSamplerConfig.noise`: ``euler`` keeps the ODE's mean and adds a constant std, so that
under ``last`` the executed mean is the stock action; it does not preserve the ODE's marginals. ``flow_sde``
scales the noise with t and corrects the drift, so that under ``all`` it does preserve them, up to the step
size.

Shapes: B batch, K actions per chunk, D = max_action_dim (real dims first, then padding), A real dims,
N steps, L log-prob factors: one per executed row under ``last``; one per row under ``all``, since all rows
feed back.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Request
from accerl_lerobot.policies.config import FlowSamplerConfig
from accerl_lerobot.policies.family import (
    Action,
    Encoded,
    Family,
    Model,
    Score,
    exploring,
    normal_entropy,
    normal_log_prob,
    standard_normal,
)

Velocity = Callable[[Tensor, Tensor], Tensor]
"""(x (B, K, D), t (B,)) → v (B, K, D)."""


@dataclass(frozen=True, kw_only=True)
class FlowShape:
    """The sizes a chunk is sampled in."""

    num_steps: int
    """N denoising steps."""
    chunk_size: int
    """K rows the network denoises."""
    executed: int
    """Rows that are executed in the environment, ≤ K (LeRobot's n_action_steps)."""
    padded_dim: int
    """D, LeRobot's max_action_dim."""
    action_dim: int
    """A real dims."""

    def action_mask(self) -> Tensor:
        """(K, D) bool: the entries that are executed."""
        mask = torch.zeros(self.chunk_size, self.padded_dim, dtype=torch.bool)
        mask[: self.executed, : self.action_dim] = True
        return mask


def integrate(velocity: Velocity, x0: Tensor, shape: FlowShape) -> Tensor:
    """LeRobot's Euler loop from noise (B, K, D) to actions (B, K, D), padding included."""
    x, n = x0, shape.num_steps
    for k in range(n):
        x = x + (-1.0 / n) * velocity(x, x.new_full((len(x),), step_time(k, n)))
    return x


def factors(shape: FlowShape, config: FlowSamplerConfig) -> int:
    """L. Rows without a density are left out: as constant factors they would dilute means over factors."""
    return shape.executed if config.stochastic == "last" else shape.chunk_size


def step_time(k: int, num_steps: int) -> float:
    """t at the start of denoising step k ∈ [0, N], as LeRobot's Euler loop counts it, in double precision."""
    return 1.0 + k * (-1.0 / num_steps)


def transition(
    x: Tensor, v: Tensor, t: Tensor, shape: FlowShape, config: FlowSamplerConfig
) -> tuple[Tensor, Tensor]:
    """Mean and std of one Gaussian denoising step.

    Args:
        x: (B, K, D) at time t.
        v: (B, K, D) velocity there.
        t: (B,) in (0, 1].
        shape: the sizes.
        config: the noise law.

    Returns:
        mean (B, K, D) and std (B, 1, 1).
    """
    delta = 1.0 / shape.num_steps
    t = t.to(x)[:, None, None]
    ode = x + (-delta) * v
    if config.noise == "euler":
        share = shape.num_steps if config.stochastic == "all" else 1
        return ode, torch.full_like(t, config.noise_level / math.sqrt(share))
    # 1 − t is 0 at the first step: the next grid time stands in, as in Flow-GRPO's discretisation.
    sigma = config.noise_level * torch.sqrt(t / torch.clamp(1 - t, min=delta))
    mean = ode - (delta * sigma**2 / (2 * t)) * (x + (1 - t) * v)
    return mean, sigma * math.sqrt(delta)


def gaussian_log_prob(x: Tensor, mean: Tensor, std: Tensor, mask: Tensor) -> Tensor:
    """Per-row log-density, summed over the dims `mask` (K, D) keeps. Returns (B, K)."""
    return torch.where(mask, normal_log_prob(x, mean, std), 0.0).sum(-1)


def sample(
    velocity: Velocity,
    x0: Tensor,
    eps: Tensor,
    explore: Tensor,
    shape: FlowShape,
    config: FlowSamplerConfig,
) -> tuple[Tensor, dict[str, Tensor], Tensor]:
    """Denoises a batch, some samples exploring and the others by the stock ODE.

    Args:
        x0: (B, K, D) initial noise.
        eps: (B, N, K, D) standard normal, the step noise; only stochastic steps read it.
        explore: (B,) bool; False samples take the stock path, equal to LeRobot's sampler.

    Returns:
        x_N (B, K, D); the latent that `log_prob` re-scores; its log-prob (B, L), zero where not exploring.
    """
    n = shape.num_steps
    mask = shape.action_mask().to(x0.device)
    path, x = [x0], x0
    logp = x0.new_zeros(x0.shape[:2])
    for k in range(n):
        t = x0.new_full((x0.shape[0],), step_time(k, n))
        v = velocity(x, t)
        noisy = explore & (config.stochastic == "all" or k == n - 1)
        mean, width = transition(x, v, t, shape, config)
        step = torch.where(noisy[:, None, None], mean + width * eps[:, k], x + (-1.0 / n) * v)
        counted = gaussian_log_prob(step, mean, width, _counted(k, mask, shape))
        logp = logp + torch.where(noisy[:, None], counted, 0.0)
        x = step
        path.append(x)
    kept = path if config.stochastic == "all" else [x0, x]
    return x, {"path": torch.stack(kept, 1)}, logp[:, : factors(shape, config)]


def log_prob(
    velocity: Velocity, latent: dict[str, Tensor], shape: FlowShape, config: FlowSamplerConfig
) -> Tensor:
    """Log-density of stored latents under the current velocity field, (B, L), differentiable."""
    path, n = latent["path"], shape.num_steps
    b = path.shape[0]
    mask = shape.action_mask().to(path.device)
    if config.stochastic == "last":
        x = path[:, 0]
        for k in range(n - 1):
            x = x + (-1.0 / n) * velocity(x, x.new_full((b,), step_time(k, n)))
        t = x.new_full((b,), step_time(n - 1, n))
        mean, width = transition(x, velocity(x, t), t, shape, config)
        return gaussian_log_prob(path[:, 1], mean, width, mask)[:, : factors(shape, config)]
    total = path.new_zeros(b, shape.chunk_size)
    for k in range(n):
        t = path.new_full((b,), step_time(k, n))
        mean, width = transition(path[:, k], velocity(path[:, k], t), t, shape, config)
        total = total + gaussian_log_prob(path[:, k + 1], mean, width, _counted(k, mask, shape))
    return total


def entropy(shape: FlowShape, config: FlowSamplerConfig) -> float:
    """Differential entropy of the Gaussian steps; no weight changes it."""
    n, mask, zero = shape.num_steps, shape.action_mask(), torch.zeros(1, 1, 1)
    total = 0.0
    for k in range(n) if config.stochastic == "all" else (n - 1,):
        _, width = transition(zero, zero, torch.tensor([step_time(k, n)]), shape, config)
        total += int(_counted(k, mask, shape).sum()) * float(normal_entropy(width))
    return total


def _counted(k: int, action_mask: Tensor, shape: FlowShape) -> Tensor:
    """(K, D) entries of step k's outcome that belong to the density; all but the last's feed back."""
    return action_mask if k == shape.num_steps - 1 else torch.ones_like(action_mask)


@dataclass(frozen=True, kw_only=True)
class FlowContext:
    """`Encoded.context` of a flow model."""

    velocity: Velocity
    """Conditioned on the observations; output in fp32."""


class FlowModel(Model):
    """A LeRobot policy that denoises a chunk with a velocity field; `Encoded.context` is a `FlowContext`."""

    shape: FlowShape

    @abstractmethod
    def stock(self, batch: dict[str, Tensor], noise: Tensor) -> Tensor:
        """LeRobot's own chunk (B, K, A) in normalised units from noise (B, K, D)."""


def flow_shape(config: Any, num_steps: int) -> FlowShape:
    """The sizes in a LeRobot flow policy's config."""
    return FlowShape(
        num_steps=num_steps,
        chunk_size=config.chunk_size,
        executed=config.n_action_steps,
        padded_dim=config.max_action_dim,
        action_dim=config.action_feature.shape[0],
    )


def refuse_options(config: Any) -> None:
    """Refuses options of LeRobot's vision-language-action policies that would change the sampler's density.

    Raises:
        InputError: real-time chunking or compilation is on.
    """
    if config.rtc_config is not None and config.rtc_config.enabled:
        remedy = "real-time chunking changes the sampler's density; turn it off"
        raise InputError("policy.rtc_config.enabled", True, remedy)
    if config.compile_model:
        remedy = "a compiled sampler rounds unlike the re-scoring pass; set it to false in config.json"
        raise InputError("policy.compile_model", True, remedy)


def difference(model: FlowModel, batch: dict[str, Tensor], encoded: Encoded) -> float:
    """Largest difference between `integrate` and LeRobot's own sampler on equal noise."""
    shape = model.shape
    size = (len(encoded.features), shape.chunk_size, shape.padded_dim)
    x0 = torch.randn(size, generator=torch.Generator().manual_seed(0)).to(encoded.features.device)
    stock = model.stock(batch, x0.clone())
    ours = integrate(encoded.context.velocity, x0, shape)
    return float((ours[..., : shape.action_dim] - stock).abs().max())


class FlowFamily(Family):
    """Flow policies explored by noise in their denoising steps; the functions above do the work."""

    imitates = True

    def __init__(self, model: FlowModel, sampler: FlowSamplerConfig) -> None:
        super().__init__()
        self.model, self.sampler, self.shape = model, sampler, model.shape
        self.entropy = entropy(model.shape, sampler)

    def act(self, encoded: Encoded, requests: Sequence[Request]) -> Action:
        n, size = self.shape.num_steps, (self.shape.chunk_size, self.shape.padded_dim)
        x0, eps = standard_normal(requests, size, (n, *size), device=encoded.features.device)
        explore, velocity = exploring(requests, x0.device), encoded.context.velocity
        x, latent, log_prob = sample(velocity, x0, eps, explore, self.shape, self.sampler)
        return Action(chunk=self._executed_part(x), latent=latent, log_prob=log_prob)

    def score(self, encoded: Encoded, latent: dict[str, Tensor]) -> Score:
        logp = log_prob(encoded.context.velocity, latent, self.shape, self.sampler)
        return Score(log_prob=logp, entropy=logp.new_full((len(logp),), self.entropy))

    def difference(self, batch: dict[str, Tensor], encoded: Encoded) -> float:
        return difference(self.model, batch, encoded)

    def imitation_loss(self, encoded: Encoded, chunk: Tensor) -> Tensor:
        """Flow matching at a time from LeRobot's Beta(1.5, 1), executed entries only."""
        target = chunk.new_zeros(len(chunk), self.shape.chunk_size, self.shape.padded_dim)
        self._executed_part(target).copy_(chunk)
        noise = torch.randn_like(target)
        t = (
            torch.distributions.Beta(1.5, 1.0, validate_args=False).sample((len(chunk),)).to(chunk) * 0.999
            + 0.001
        )
        mixed = t[:, None, None] * noise + (1 - t[:, None, None]) * target
        error = (encoded.context.velocity(mixed, t) - (noise - target)).square()
        return self._executed_part(error).mean((1, 2))

    def _executed_part(self, x: Tensor) -> Tensor:
        return x[:, : self.shape.executed, : self.shape.action_dim]

    @property
    def actions(self) -> int:
        """Every factor is one row of the chunk."""
        return factors(self.shape, self.sampler)
