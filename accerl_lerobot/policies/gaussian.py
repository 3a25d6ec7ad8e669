# SPDX-License-Identifier: Apache-2.0
"""The Gaussian family's likelihood: one network pass predicts a chunk, and a Gaussian stands around it.

    u ~ N(m(o), s(o)²)        a = u, or tanh u        log π(a) = log N(u; m, s²) − Σ log(1 − tanh² u)

u is what is stored: a = tanh u rounds to ±1 from |u| ≈ 9 on, and then nothing can be re-scored. Nothing that
is sampled is fed back, so leaving out rows that are not executed marginalises them exactly. The tanh term
does not depend on the weights and cancels in every ratio; it makes the log-prob that of the action.

A policy that is deterministic in itself (act) gets a std from `StdHead`, whose weights are the family's; one
that has a std of its own (gaussian_actor) keeps it.

Shapes: B batch, K rows of a chunk, A action dims, W width of a row's features; L = executed rows.

ACT: one pass of LeRobot's transformer; its own forward is run, and watched at two places.

At inference the variational encoder is not run and the latent is 0, so the policy is deterministic. The
ResNet's batch norms are frozen in LeRobot's own code, and dropout is off, since a policy here is never in
training mode: nothing but the observations and the weights moves the chunk.

LeRobot's gaussian_actor, the policy of its SAC: one action a decision, a Gaussian through tanh.

Three things in LeRobot 0.6.1 are not what its config says, and the comparison at load time covers them: what
it clamps to [std_min, std_max] is handed to `MultivariateNormal` as a covariance, so the std is the
*square root* of it; ``use_tanh_squash`` is not read, every action is squashed; and ``select_action`` samples,
it does not take the mean. `predict_action_chunk` raises, and `forward` cannot score a stored action.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Request
from accerl_lerobot.policies.config import GaussianSamplerConfig
from accerl_lerobot.policies.family import (
    Action,
    BoundedStd,
    Encoded,
    Family,
    Model,
    Score,
    exploring,
    normal_entropy,
    normal_log_prob,
    standard_normal,
)

QUADRATURE_NODES = 32
"""For the tanh term of an entropy; off by 6e-8 at a std of 1, 2e-4 at 2, 0.003 at 3 and 0.16 (1 %) at 10."""


@dataclass(frozen=True, kw_only=True)
class GaussianContext:
    """`Encoded.context` of a Gaussian model."""

    mean: Tensor
    """fp32 (B, K, A), before any squashing; LeRobot's chunk where it is deterministic."""
    std: Tensor | None = None
    """fp32 (B, K, A), where the policy has one of its own."""
    rows: Tensor | None = None
    """(B, K, W), what a std is computed from where it has none."""


class GaussianModel(Model):
    """A LeRobot policy that predicts a chunk in one pass; `Encoded.context` is a `GaussianContext`."""

    executed: int
    """Rows that are executed in the environment."""
    action_dim: int
    row_width: int | None = None
    """W; None where the policy has a std of its own."""
    squashed: bool = False
    """True if the action is tanh u."""

    @abstractmethod
    def stock(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor | None]:
        """LeRobot's own chunk (B, K, A), and the standard normal noise (B, K, A) it drew, if it draws any."""


class StdHead(nn.Module):
    """A std per observation, row and action dim, within bounds; starts at ``sampler.std`` everywhere.

    It reads features of `width` without shaping them.
    """

    def __init__(self, width: int, action_dim: int, sampler: GaussianSamplerConfig) -> None:
        super().__init__()
        self.norm, self.out = nn.LayerNorm(width), nn.Linear(width, action_dim)
        self.bounded = BoundedStd(*sampler.bounds)
        self.bounded.start(self.out, sampler.std)

    def forward(self, rows: Tensor) -> Tensor:
        """(B, K, W) to (B, K, A)."""
        return self.bounded(self.out(self.norm(rows.detach().float())))


class GaussianFamily(Family):
    """Policies explored by noise around the chunk they predict."""

    imitates = True

    def __init__(self, model: GaussianModel, sampler: GaussianSamplerConfig) -> None:
        super().__init__()
        self.model, self.sampler = model, sampler
        self.std: StdHead | None = None
        if model.row_width is not None:
            self.std = StdHead(model.row_width, model.action_dim, sampler)

    def act(self, encoded: Encoded, requests: Sequence[Request]) -> Action:
        mean, std = self._gaussian(encoded)
        (eps,) = standard_normal(requests, tuple(mean.shape[1:]), device=mean.device)
        explore = exploring(requests, mean.device)
        # A policy with a std of its own samples in LeRobot too.
        noisy = explore if encoded.context.std is None else torch.ones_like(explore)
        u = torch.where(noisy[:, None, None], mean + std * eps, mean)
        return Action(
            chunk=self._action(u),
            latent={"u": u},
            log_prob=torch.where(explore[:, None], self._log_prob(u, mean, std), 0.0),
        )

    def score(self, encoded: Encoded, latent: dict[str, Tensor]) -> Score:
        mean, std = self._gaussian(encoded)
        entropy = normal_entropy(std)
        if self.model.squashed:
            entropy = entropy + expected_log_slope(mean, std)
        return Score(log_prob=self._log_prob(latent["u"], mean, std), entropy=entropy.sum((1, 2)))

    def difference(self, batch: dict[str, Tensor], encoded: Encoded) -> float:
        mean, std = self._gaussian(encoded)
        stock, eps = self.model.stock(batch)
        executed = self.model.executed
        u = mean if eps is None else mean + std * eps[:, :executed]
        return float((self._action(u) - stock[:, :executed]).abs().max())

    def imitation_loss(self, encoded: Encoded, chunk: Tensor) -> Tensor:
        """Mean absolute error, ACT's reconstruction loss."""
        return (self._action(self._gaussian(encoded)[0]) - chunk).abs().mean((1, 2))

    @property
    def actions(self) -> int:
        """Every factor is one executed row."""
        return self.model.executed

    def _gaussian(self, encoded: Encoded) -> tuple[Tensor, Tensor]:
        """Mean and std of the executed rows, each (B, L, A)."""
        context: GaussianContext = encoded.context
        executed = self.model.executed
        mean = context.mean[:, :executed]
        if context.std is not None:
            return mean, context.std[:, :executed]
        assert self.std is not None and context.rows is not None
        return mean, self.std(context.rows[:, :executed])

    def _action(self, u: Tensor) -> Tensor:
        return torch.tanh(u) if self.model.squashed else u

    def _log_prob(self, u: Tensor, mean: Tensor, std: Tensor) -> Tensor:
        """(B, L), summed over action dims."""
        density = normal_log_prob(u, mean, std)
        if self.model.squashed:
            density = density - log_slope(u)
        return density.sum(-1)


def log_slope(u: Tensor) -> Tensor:
    """log d(tanh u)/du = log(1 − tanh² u), finite and exact however far u is from 0."""
    return 2 * (math.log(2) - u - functional.softplus(-2 * u))


def expected_log_slope(mean: Tensor, std: Tensor) -> Tensor:
    """E[log(1 − tanh² u)] for u ~ N(mean, std²), by Gauss-Hermite quadrature; differentiable, same shape."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(QUADRATURE_NODES)
    x = torch.from_numpy(nodes).to(mean)
    w = torch.from_numpy(weights / weights.sum()).to(mean)
    return log_slope(mean[..., None] + std[..., None] * x) @ w


class ACT(GaussianModel):
    """Drives LeRobot's `ACTPolicy`."""

    idle = ("model.vae_encoder", "model.encoder_latent_input_proj.weight")

    def __init__(self, policy: Any) -> None:
        config = policy.config
        if config.temporal_ensemble_coeff is not None:
            remedy = "averaging over earlier chunks makes actions depend on more than the observation"
            raise InputError(
                "policy.temporal_ensemble_coeff", config.temporal_ensemble_coeff, f"{remedy}; set it to null"
            )
        self.policy = policy
        self.executed, self.action_dim = config.n_action_steps, config.action_feature.shape[0]
        self.width = self.row_width = config.dim_model

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        """The features are the encoder's output: latent, state, image positions."""
        from lerobot.utils.constants import OBS_IMAGES

        model: Any = self.policy.model
        inputs: dict[str, Any] = dict(batch)
        if self.policy.config.image_features:
            inputs[OBS_IMAGES] = [batch[key] for key in self.policy.config.image_features]
        seen: dict[str, Tensor] = {}

        def encoder_done(module: nn.Module, arguments: Any, output: Tensor) -> None:
            seen["features"] = output.transpose(0, 1)

        def head_starts(module: nn.Module, arguments: tuple[Tensor]) -> None:
            seen["rows"] = arguments[0]

        hooks = [
            model.encoder.register_forward_hook(encoder_done),
            model.action_head.register_forward_pre_hook(head_starts),
        ]
        try:
            mean, _ = model(inputs)
        finally:
            for hook in hooks:
                hook.remove()
        features = seen["features"]
        return Encoded(
            features=features,
            mask=features.new_ones(features.shape[:2]).bool(),
            context=GaussianContext(mean=mean.float(), rows=seen["rows"]),
        )

    def stock(self, batch: dict[str, Tensor]) -> tuple[Tensor, None]:
        return self.policy.predict_action_chunk(batch), None


class GaussianActor(GaussianModel):
    """Drives LeRobot's `GaussianActorPolicy`."""

    squashed = True
    executed = 1

    def __init__(self, policy: Any) -> None:
        config = policy.config
        if config.num_discrete_actions is not None:
            remedy = "LeRobot takes the discrete action that a critic likes best, which has no density"
            raise InputError("policy.num_discrete_actions", config.num_discrete_actions, remedy)
        self.policy = policy
        self.action_dim = policy.actor.action_dim
        self.width = policy.actor.encoder.output_dim
        if not config.shared_encoder:
            self.idle = ("encoder_critic.",)

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        """The features are the encoder's output, one token.

        Unlike in LeRobot's SAC, whose critic shapes a shared image encoder, the log-prob's gradient reaches
        it: our critic reads features and does not shape them.
        """
        actor = self.policy.actor
        features = actor.encoder(batch)
        hidden = actor.network(features)
        variance = torch.exp(actor.std_layer(hidden).float()).clamp(actor.std_min, actor.std_max)
        mean = actor.mean_layer(hidden).float()
        return Encoded(
            features=features[:, None],
            mask=features.new_ones(len(features), 1).bool(),
            context=GaussianContext(mean=mean[:, None], std=variance.sqrt()[:, None]),
        )

    def stock(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """LeRobot draws from the global generator, which is put back."""
        device = next(self.policy.parameters()).device
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.manual_seed(0)
            action = self.policy.select_action(batch)
            torch.manual_seed(0)
            zeros = torch.zeros_like(action)
            eps = torch.normal(zeros, zeros + 1)
        return action[:, None], eps[:, None]
