# SPDX-License-Identifier: Apache-2.0
"""Steering a frozen flow policy by its initial noise (DSRL, Wagenmaker et al., arXiv 2506.15799).

The policy's Euler loop maps noise to actions and is left as it is; what acts at random, and is learnt, is a
small head that says which noise to start from, z ~ N(m(o), s(o)²). Its density is a Gaussian's, so the ratio
is exact, costs no velocity pass to re-score, and every objective here applies; the paper uses SAC instead.

What is learnt lies beside the checkpoint in ``family.safetensors``; stock LeRobot loads the frozen policy
without it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from accerl_lerobot.experience import Request
from accerl_lerobot.policies import flow
from accerl_lerobot.policies.density import BoundedStd, normal_entropy, normal_log_prob, pooled
from accerl_lerobot.policies.family import Action, Encoded, Family, Score, exploring, normal
from accerl_lerobot.policies.samplers import NoiseSpaceSamplerConfig


class NoiseSpaceFamily(Family):
    """A Gaussian over the noise a flow policy starts from.

    Args:
        model: the frozen policy.
        sampler: bounds of the Gaussian.
    """

    frozen = True

    def __init__(self, model: flow.FlowModel, sampler: NoiseSpaceSamplerConfig) -> None:
        super().__init__()
        self.model, self.sampler, self.shape = model, sampler, model.shape
        self.rows = self.shape.chunk_size if sampler.per_row else 1
        size = self.rows * self.shape.padded_dim
        self.norm = nn.LayerNorm(model.width)
        self.hidden = nn.Linear(model.width, sampler.hidden)
        self.mean = nn.Linear(sampler.hidden, size)
        self.width = nn.Linear(sampler.hidden, size)
        nn.init.zeros_(self.mean.weight)
        nn.init.zeros_(self.mean.bias)
        self.bounded = BoundedStd(sampler.std_min, sampler.std_max)
        self.bounded.start(self.width, sampler.std)

    def act(self, encoded: Encoded, requests: Sequence[Request]) -> Action:
        """See the base class; at rest it starts from the mean, see `NoiseSpaceSamplerConfig.at_rest`."""
        mean, std = self._gaussian(encoded)
        shape, size = self.shape, tuple(mean.shape[1:])
        (eps,) = normal(requests, size, device=mean.device)
        explore = exploring(requests, mean.device)
        noisy = explore | (self.sampler.at_rest == "sample")
        z = torch.where(noisy[:, None, None], mean + std * eps, mean)
        x = flow.integrate(encoded.context.velocity, z.expand(-1, shape.chunk_size, -1), shape)
        return Action(
            chunk=x[:, : shape.executed, : shape.action_dim],
            latent={"z": z},
            log_prob=torch.where(explore[:, None], _log_prob(z, mean, std), 0.0),
        )

    def score(self, encoded: Encoded, latent: dict[str, Tensor]) -> Score:
        """See the base class."""
        mean, std = self._gaussian(encoded)
        entropy = normal_entropy(std).sum((1, 2))
        return Score(log_prob=_log_prob(latent["z"], mean, std), entropy=entropy)

    def difference(self, batch: dict[str, Tensor], encoded: Encoded) -> float:
        """See the base class: the frozen policy is the one LeRobot runs."""
        return flow.difference(self.model, batch, encoded)

    @property
    def actions(self) -> int:
        """One factor per row of noise."""
        return self.rows

    def _gaussian(self, encoded: Encoded) -> tuple[Tensor, Tensor]:
        """Mean and std of z, each (B, rows, D)."""
        hidden = torch.relu(self.hidden(self.norm(pooled(encoded.features, encoded.mask))))
        size = (-1, self.rows, self.shape.padded_dim)
        bound = self.sampler.bound
        mean = bound * torch.tanh(self.mean(hidden).float() / bound)
        return mean.view(size), self.bounded(self.width(hidden)).view(size)


def _log_prob(z: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """(B, rows), summed over dims; padded ones act on the others, so they are part of the choice."""
    return normal_log_prob(z, mean, std).sum(-1)
