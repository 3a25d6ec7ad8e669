# SPDX-License-Identifier: Apache-2.0
"""The Gaussian family's likelihood: one network pass predicts a chunk, and a Gaussian stands around it.

    a ~ N(m(o), s(o)²)

Nothing that is sampled is fed back, so leaving out rows that are not executed marginalises them exactly. The
std comes from `StdHead`, whose weights are the family's, as the policy itself is deterministic: at inference
ACT's variational encoder is not run, and its batch norms are frozen in LeRobot's own code.

Shapes: B batch, K rows of a chunk, A action dims, W width of a row's features; L = executed rows.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from lerobot.utils.constants import OBS_IMAGES
from torch import Tensor, nn

from accerl_lerobot.policies.config import GaussianSamplerConfig
from accerl_lerobot.policies.family import (
    Action,
    Encoded,
    Latent,
    Model,
    NoDensityError,
    NoiseFamily,
    normal_entropy,
    normal_log_prob,
)


class GaussianModel(Model):
    """A LeRobot policy that predicts a chunk in one pass.

    `Encoded.context` is its chunk, fp32 (B, K, A), and the rows (B, K, W) that the std is computed from.
    """

    executed: int  # rows that are executed in the environment
    action_dim: int
    row_width: int  # w


class StdHead(nn.Module):
    """A std per observation, row and action dim, within bounds; starts at ``sampler.std`` everywhere.

    It reads features of `width` without shaping them.
    """

    def __init__(self, width: int, action_dim: int, sampler: GaussianSamplerConfig) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.out = nn.Linear(width, action_dim)
        low, high = sampler.bounds
        self.low = math.log(low)
        self.high = math.log(high)
        share = (math.log(sampler.std) - self.low) / (self.high - self.low)
        start = math.log(share / (1 - share))
        nn.init.zeros_(self.out.weight)
        nn.init.constant_(self.out.bias, start)

    def forward(self, rows: Tensor) -> Tensor:
        """(B, K, W) to (B, K, A): between the bounds by a sigmoid between their logarithms."""
        raw = self.out(self.norm(rows.detach().float())).float()
        share = torch.sigmoid(raw)
        return torch.exp(self.low + (self.high - self.low) * share)


class GaussianFamily(NoiseFamily):
    """Policies explored by noise around the chunk they predict."""

    def __init__(self, model: GaussianModel, sampler: GaussianSamplerConfig) -> None:
        super().__init__(model, sampler)
        self.std = StdHead(model.row_width, model.action_dim, sampler)
        self.noise_sizes = ((model.executed, model.action_dim),)

    def sample(self, context: Any, eps: Tensor, explore: Tensor) -> Action:
        """The predicted chunk, with noise `eps` (B, L, A) where `explore` (B,)."""
        mean, std = self._gaussian(context)
        u = torch.where(explore[:, None, None], mean + std * eps, mean)
        log_prob = normal_log_prob(u, mean, std).sum(-1)
        log_prob = torch.where(explore[:, None], log_prob, 0.0)
        return Action(u, {"u": u}, log_prob)

    def score(self, encoded: Encoded, latent: Latent) -> tuple[Tensor, Tensor]:
        mean, std = self._gaussian(encoded.context)
        log_prob = normal_log_prob(latent["u"], mean, std).sum(-1)
        return log_prob, normal_entropy(std).sum((1, 2))

    def imitation_loss(self, encoded: Encoded, chunk: Tensor) -> Tensor:
        """Mean absolute error, ACT's reconstruction loss."""
        mean, _ = self._gaussian(encoded.context)
        return (mean - chunk).abs().mean((1, 2))

    def _gaussian(self, context: Any) -> tuple[Tensor, Tensor]:
        """Mean and std of the executed rows, each (B, L, A)."""
        mean, rows = context
        executed = self.model.executed
        return mean[:, :executed], self.std(rows[:, :executed])


class ACT(GaussianModel):
    """LeRobot's `ACTPolicy`: its own forward pass is run, and watched at two places."""

    blocks = r"model\.((encoder|decoder)\.layers\.\d+|backbone\.layer\d\.\d+)"
    idle = ("model.vae_encoder", "model.encoder_latent_input_proj.weight")

    def __init__(self, policy: Any) -> None:
        super().__init__(policy)
        config = policy.config
        if config.temporal_ensemble_coeff is not None:
            hint = "averaging over earlier chunks makes actions depend on more than the observation; "
            hint += "set it to null in the config.json of a copy"
            raise NoDensityError("policy.temporal_ensemble_coeff", config.temporal_ensemble_coeff, hint)
        self.executed = config.n_action_steps
        self.action_dim = config.action_feature.shape[0]
        self.width = config.dim_model
        self.row_width = config.dim_model

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        """The features are the encoder's output: latent, state, image positions."""
        model = self.policy.model
        inputs: dict[str, Any] = dict(batch)
        cameras = self.policy.config.image_features
        if cameras:
            inputs[OBS_IMAGES] = [batch[camera] for camera in cameras]
        seen: dict[str, Tensor] = {}

        def note_features(module: nn.Module, given: Any, made: Tensor) -> None:
            seen["features"] = made

        def note_rows(module: nn.Module, given: Any) -> None:
            seen["rows"] = given[0]

        with (
            model.encoder.register_forward_hook(note_features),
            model.action_head.register_forward_pre_hook(note_rows),
        ):
            mean, _ = model(inputs)
        features = seen["features"].transpose(0, 1)
        mask = features.new_ones(features.shape[:2]).bool()
        return Encoded(features=features, mask=mask, context=(mean.float(), seen["rows"]))
