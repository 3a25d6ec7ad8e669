# SPDX-License-Identifier: Apache-2.0
"""The diffusion family's likelihood: the denoising chain is a sequence of Gaussian steps, as in DPPO.

A diffusion policy goes from x_N (noise) to x_0 (actions), and each of its steps is a Gaussian whose mean the
network decides (Ren et al., arXiv 2409.00588):

    x̂ = clip((x − √(1−ᾱ)·ε(x)) / √ᾱ)
    DDPM   m = (√ᾱ′·β/(1−ᾱ))·x̂ + (√(1−β)·(1−ᾱ′)/(1−ᾱ))·x      s² = β·(1−ᾱ′)/(1−ᾱ),   β = 1 − ᾱ/ᾱ′
    DDIM   m = √ᾱ′·x̂ + √(1−ᾱ′−s²)·ε(x)                          s² = the same

with ᾱ at the step and ᾱ′ at the one after it (arXiv 2006.11239, eq. 7; arXiv 2010.02502, eq. 12). These are
the operations of LeRobot's scheduler, in its order. While exploring, a step's std is max(s, std_min) and its
log-density counts; the chain is what is stored, and re-scoring takes a network pass per step. x_N's
density does not depend on the weights and is left out. In every step but the last all rows feed back through
the network, so all count; after the last nothing feeds back, and rows that are not executed are left out.
Deviations from DPPO: all steps explore, with the std that is scored; their noise is not clipped; and no ratio
is of a single step.

Shapes: B batch, H horizon, A action dims, N steps, L factors: one per row.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE
from torch import Tensor

from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import DiffusionSamplerConfig
from accerl_lerobot.policies.family import (
    Action,
    Encoded,
    Latent,
    Model,
    NoiseFamily,
    normal_entropy,
    normal_log_prob,
)

Network = Callable[[Tensor, int], Tensor]
"""(x (B, H, A), timestep) → what the network predicts, fp32 (B, H, A), given the observations."""


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """The steps of LeRobot's scheduler, in the order in which they are taken."""

    timesteps: tuple[int, ...]  # N, falling to 0
    alphas: Tensor  # (N,) ᾱ at each step, fp32 on the CPU
    following: Tensor  # (N,) ᾱ at the step after it; 1 after the last
    scheduler: str  # DDPM or DDIM
    prediction: str  # target that the network predicts: epsilon (the noise) or sample (the actions)
    clip: float | None  # bound of x̂, if it is clipped

    def __len__(self) -> int:
        return len(self.timesteps)

    def step(self, k: int, x: Tensor, output: Tensor, eta: float = 0.0) -> tuple[Tensor, Tensor]:
        """Mean (B, H, A) and std, a scalar, of step k, counted from the noise, 0 to N − 1.

        `eta` is DDIM's: 0 is LeRobot's own, 1 adds as much noise as DDPM.
        """
        alpha = self.alphas[k]
        following = self.following[k]
        noise_share = 1 - alpha
        clean = output
        if self.prediction == "epsilon":
            clean = (x - noise_share**0.5 * output) / alpha**0.5
        if self.clip is not None:
            clean = clean.clamp(-self.clip, self.clip)
        remaining = alpha / following
        beta = 1 - remaining
        variance = (1 - following) / noise_share * beta
        if self.scheduler == "DDIM":
            noise = output
            if self.prediction == "sample":
                noise = (x - alpha**0.5 * output) / noise_share**0.5
            std = eta * variance**0.5
            of_noise = (1 - following - std**2) ** 0.5
            mean = following**0.5 * clean + of_noise * noise
            return mean, std
        of_clean = (following**0.5 * beta) / noise_share
        of_noisy = remaining**0.5 * (1 - following) / noise_share
        mean = of_clean * clean + of_noisy * x
        return mean, variance**0.5


class Diffusion(Model):
    """LeRobot's `DiffusionPolicy`: reads observations once, then runs its U-Net once per step, the `context`.

    Never in training mode: batch norms keep their statistics, and the crop is the centre one. LeRobot's
    `predict_action_chunk` wants a time dimension that its preprocessor does not add; `stock` adds it.
    """

    blocks = r"diffusion\.unet\.((down|up)_modules\.\d+|mid_modules|final_conv)\.\d+"
    size: tuple[int, int]  # (H, A)
    rows: slice  # the executed ones among the H
    schedule: Schedule

    def __init__(self, policy: Any) -> None:
        super().__init__(policy)
        config = policy.config
        steps = policy.diffusion.num_inference_steps
        most = config.num_train_timesteps
        if steps > most:
            hint = f"use at most {most}, as many as it was trained with"
            raise InputError("policy.num_steps", steps, hint)
        self.size = (config.horizon, config.action_feature.shape[0])
        first = config.n_obs_steps - 1  # rows before it stand for the past
        end = first + config.n_action_steps
        self.rows = slice(first, end)
        scheduler = policy.diffusion.noise_scheduler
        scheduler.set_timesteps(steps)
        timesteps = scheduler.timesteps.tolist()
        alphas = scheduler.alphas_cumprod.float().cpu()[timesteps]
        clip = None
        if config.clip_sample:
            clip = config.clip_sample_range
        self.schedule = Schedule(
            timesteps=tuple(timesteps),
            alphas=alphas,
            following=torch.cat([alphas[1:], torch.ones(1)]),
            scheduler=config.noise_scheduler_type,
            prediction=config.prediction_type,
            clip=clip,
        )
        of_state = config.robot_state_feature.shape[0]
        of_images = 2 * config.spatial_softmax_num_keypoints * len(config.image_features)
        self.width = config.n_obs_steps * (of_state + of_images)

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        """The features, one token, are the U-Net's condition: state, image keypoints."""
        diffusion = self.policy.diffusion
        condition = diffusion._prepare_global_conditioning(self._with_time(batch))

        def network(x: Tensor, timestep: int) -> Tensor:
            t = torch.full(x.shape[:1], timestep, dtype=torch.long, device=x.device)
            return diffusion.unet(x, t, global_cond=condition).float()

        mask = condition.new_ones(len(condition), 1).bool()
        return Encoded(features=condition[:, None], mask=mask, context=network)

    def stock_and_noise(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """LeRobot's own chunk, the noise (B, H, A) that it began with and its step noise (B, N, H, A).

        It draws from the global generator, which is put back.
        """
        inputs = self._with_time(batch)
        state = inputs[OBS_STATE]
        size = (len(state), *self.size)
        self.policy.reset()
        gpus = [state.device] if state.device.type == "cuda" else []
        with torch.random.fork_rng(gpus):
            torch.manual_seed(0)
            chunk = self.stock(inputs)
            torch.manual_seed(0)
            noise = torch.randn(size, device=state.device)
            # A DDIM step draws none, nor does the last one; their std is 0.
            eps = [torch.randn_like(noise) for _ in self.schedule.timesteps]
        return chunk, noise, torch.stack(eps, 1)

    def _with_time(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """As LeRobot's sampler wants it: state (B, O, S), images stacked (B, O, cameras, 3, H, W)."""
        config = self.policy.config
        inputs = {key: batch[key] for key in (OBS_STATE, *config.image_features)}
        if config.n_obs_steps == 1:
            inputs = {key: value[:, None] for key, value in inputs.items()}
        images = [inputs[key] for key in config.image_features]
        return inputs | {OBS_IMAGES: torch.stack(images, dim=-4)}


class DiffusionFamily(NoiseFamily):
    """Diffusion policies explored by the noise of their steps. The latent is ``path``, (N + 1, H, A)."""

    counted: Tensor  # bool (N, H, 1), rows of each step's outcome that belong to the density

    def __init__(self, model: Diffusion, sampler: DiffusionSamplerConfig) -> None:
        super().__init__(model, sampler)
        self.size = model.size
        self.rows = model.rows
        self.schedule = model.schedule
        self._factors = slice(None)
        """L rows. Those without a density are left out: as constant factors they would dilute means."""
        steps = len(self.schedule)
        self.noise_sizes = (self.size, (steps, *self.size))
        if steps == 1:
            self._factors = self.rows
        horizon, action_dim = self.size
        counted = torch.ones(steps, horizon, 1, dtype=torch.bool)
        counted[-1] = False
        counted[-1, self.rows] = True
        self.register_buffer("counted", counted, persistent=False)
        zero = torch.zeros(1, 1, 1)
        self.entropy = 0.0
        """Differential entropy of the steps; no weight changes it."""
        for k in range(steps):
            _, std = self._exploring_step(k, zero, zero)
            entries = int(counted[k].sum()) * action_dim
            self.entropy += entries * float(normal_entropy(std))

    def sample(self, network: Network, x: Tensor, eps: Tensor, explore: Tensor) -> Action:
        """Denoises `x` (B, H, A) with step noise `eps` (B, N, H, A); as LeRobot where not `explore` (B,).

        Without exploration a DDPM policy still draws step noise, as LeRobot's does.
        """
        path = [x]
        log_prob = x.new_zeros(x.shape[:2])
        for k, timestep in enumerate(self.schedule.timesteps):
            output = network(x, timestep)
            mean, std = self.schedule.step(k, x, output)
            stock = mean + std * eps[:, k]
            mean, std = self._exploring_step(k, x, output)
            noisy = mean + std * eps[:, k]
            x = torch.where(explore[:, None, None], noisy, stock)
            rows = self._rows(k, x, mean, std)
            log_prob = log_prob + torch.where(explore[:, None], rows, 0.0)
            path.append(x)
        latent = {"path": torch.stack(path, 1)}
        return Action(x[:, self.rows], latent, log_prob[:, self._factors])

    def log_prob(self, network: Network, latent: Latent) -> Tensor:
        """Log-density of stored chains under the current network, (B, L), differentiable."""
        path = latent["path"].unbind(1)
        log_prob = path[0].new_zeros(path[0].shape[:2])
        for k, timestep in enumerate(self.schedule.timesteps):
            output = network(path[k], timestep)
            mean, std = self._exploring_step(k, path[k], output)
            log_prob = log_prob + self._rows(k, path[k + 1], mean, std)
        return log_prob[:, self._factors]

    def difference(self, batch: dict[str, Tensor], encoded: Encoded) -> float:
        stock, noise, eps = self.model.stock_and_noise(batch)
        explore = torch.zeros(len(noise), dtype=torch.bool, device=noise.device)
        ours = self.sample(encoded.context, noise, eps, explore)
        return float((ours.chunk - stock).abs().max())

    def _exploring_step(self, k: int, x: Tensor, output: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (B, H, A) and std (1, 1, 1) of step k while exploring."""
        mean, std = self.schedule.step(k, x, output, eta=1.0)
        std = std.clamp(min=self.sampler.std_min)
        return mean, std.to(x).view(1, 1, 1)

    def _rows(self, k: int, x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
        """Log-density of each row (B, H) of step k's outcome x."""
        entries = normal_log_prob(x, mean, std)
        return torch.where(self.counted[k], entries, 0.0).sum(-1)
