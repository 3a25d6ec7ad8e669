# SPDX-License-Identifier: Apache-2.0
"""The Gaussian likelihood on a policy small enough to know its expectations."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.experience import Request
from accerl_lerobot.policies import gaussian
from accerl_lerobot.policies.config import GaussianSamplerConfig
from accerl_lerobot.policies.family import Encoded
from accerl_lerobot.policies.gaussian import GaussianContext, GaussianFamily, GaussianModel, log_slope
from tests.policies.tiny import deviation

SAMPLES = 40_000
EXACT, WRONG = 4.0, 10.0
"""Monte-Carlo errors: agreement is below the first, a detected mistake above the second."""


class Small(GaussianModel):
    """Three rows of two dims, of which two rows are executed."""

    executed, action_dim, width = 2, 2, 4

    def __init__(self, squashed: bool = False, own_std: bool = False) -> None:
        self.squashed, self.own_std = squashed, own_std
        self.row_width = None if own_std else 4

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        raise NotImplementedError

    def stock(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor | None]:
        raise NotImplementedError

    def under(self, weights: float, count: int) -> Encoded:
        """Mean, std and rows as a function of the policy's weights, here one number."""
        mean = torch.linspace(-0.5, 0.8, 6).view(1, 3, 2) + 0.3 * weights
        std = (0.5 + 0.1 * weights) * torch.linspace(0.8, 1.2, 6).view(1, 3, 2)
        rows = torch.sin(torch.arange(12.0) + weights).view(1, 3, 4)
        context = GaussianContext(
            mean=mean.expand(count, -1, -1),
            std=std.expand(count, -1, -1) if self.own_std else None,
            rows=None if self.own_std else rows.expand(count, -1, -1),
        )
        return Encoded(features=torch.zeros(count, 1, 4), mask=torch.ones(count, 1).bool(), context=context)


def asked(count: int, explore: bool = True, seed: int = 0) -> list[Request]:
    return [Request(observation={}, noise_seed=1_000_000 * seed + i, explore=explore) for i in range(count)]


def family(squashed: bool, own_std: bool, sampler: GaussianSamplerConfig | None = None) -> GaussianFamily:
    made = GaussianFamily(Small(squashed, own_std), sampler or GaussianSamplerConfig(std=0.4))
    if made.std is not None:
        with torch.no_grad():
            made.std.out.weight.copy_(torch.linspace(-1, 1, 8).view(2, 4))
    return made


def payoff(chunk: Tensor) -> Tensor:
    """Depends on every executed entry, and on two of them together."""
    return torch.tanh(2 * chunk[:, 0, 0] + chunk[:, 1, 1]) + 0.5 * chunk[:, 0, 1] ** 2 + 0.6 * chunk[:, 1, 0]


@pytest.mark.parametrize("squashed", [False, True])
@pytest.mark.parametrize("own_std", [False, True])
def test_weighted_samples_of_mu_are_samples_of_pi(squashed: bool, own_std: bool):
    it, (mu, pi) = family(squashed, own_std), (0.0, 1.0)
    with torch.no_grad():
        acted = it.act(it.model.under(mu, SAMPLES), asked(SAMPLES))
        score = it.score(it.model.under(pi, SAMPLES), acted.latent)
        new = payoff(it.act(it.model.under(pi, SAMPLES), asked(SAMPLES, seed=1)).chunk)
        old = payoff(it.act(it.model.under(mu, SAMPLES), asked(SAMPLES, seed=2)).chunk)
    ratio = (score.log_prob - acted.log_prob).sum(1).exp()
    product = ratio * payoff(acted.chunk)
    assert deviation(old, new) > WRONG, "the weights must matter, or the test shows nothing"
    assert deviation(ratio, torch.ones(2)) < EXACT
    assert deviation(product, new) < EXACT
    partial = (score.log_prob - acted.log_prob)[:, :1].sum(1).exp() * payoff(acted.chunk)
    assert deviation(partial, new) > WRONG, "an executed row left out of the density is noticed"


@pytest.mark.parametrize("squashed", [False, True])
def test_the_density_integrates_to_one_over_actions(squashed: bool):
    it = family(squashed, own_std=True)
    low, high = (-1 + 1e-6, 1 - 1e-6) if squashed else (-6.0, 6.0)
    action = torch.linspace(low, high, 200_001, dtype=torch.float64)
    u = torch.atanh(action) if squashed else action
    encoded = it.model.under(0.0, 1)
    # One entry varies and the other of its row stays at its own mean, where its density is known.
    mean, std = encoded.context.mean[0, 0].double(), encoded.context.std[0, 0].double()
    latent = torch.stack([u, torch.full_like(u, float(mean[1]))], -1)[:, None].expand(-1, 2, -1)
    density = it._log_prob(latent, mean.expand(len(u), 2, 2), std.expand(len(u), 2, 2))[:, 0]
    other = -torch.log(std[1]) - 0.5 * math.log(2 * math.pi)
    if squashed:
        other = other - torch.log(1 - torch.tanh(mean[1]) ** 2)
    assert torch.trapezoid((density - other).exp(), action).item() == pytest.approx(1.0, abs=1e-4)


def test_the_slope_of_tanh_near_and_far():
    places = [-90.0, -20.0, -3.0, -1e-3, 0.0, 0.5, 3.0, 20.0, 90.0]
    u = torch.tensor(places, dtype=torch.float64, requires_grad=True)
    x = np.abs(places)
    exact = 2 * (math.log(2) - x - np.log1p(np.exp(-2 * x)))
    assert np.allclose(log_slope(u).detach(), exact, rtol=1e-12, atol=1e-12)
    assert np.allclose(log_slope(u.float()).detach(), exact, rtol=1e-5, atol=1e-6), "finite and exact"
    log_slope(u).sum().backward()
    assert np.allclose(u.grad, -2 * np.tanh(places), atol=1e-12)
    naive = torch.log(1 - torch.tanh(torch.tensor(20.0)) ** 2)
    assert not torch.isfinite(naive), "which is why it is not computed so"


@pytest.mark.parametrize(("std", "tolerance"), [(0.05, 1e-5), (0.5, 1e-5), (1.0, 1e-5), (3.0, 1e-3)])
def test_a_squashed_action_s_entropy_against_numerical_integration(std: float, tolerance: float):
    for mean in (-2.0, 0.0, 0.7):
        u = np.linspace(mean - 12 * std, mean + 12 * std, 400_001)
        weight = np.exp(-0.5 * ((u - mean) / std) ** 2) / (std * math.sqrt(2 * math.pi))
        slope = 2 * (math.log(2) - np.abs(u) - np.log1p(np.exp(-2 * np.abs(u))))
        exact = np.trapezoid(weight * slope, u)
        found = gaussian.expected_log_slope(*torch.tensor([[mean], [std]], dtype=torch.float64))
        assert abs(float(found) - exact) < tolerance * max(1, abs(exact))


@pytest.mark.parametrize("squashed", [False, True])
def test_entropy_is_the_mean_surprise_of_what_is_sampled(squashed: bool):
    it = family(squashed, own_std=False)
    with torch.no_grad():
        encoded = it.model.under(0.0, SAMPLES)
        acted = it.act(encoded, asked(SAMPLES))
        entropy = it.score(encoded, acted.latent).entropy
    assert entropy.shape == (SAMPLES,) and entropy.std() < 1e-4
    assert deviation(-acted.log_prob.sum(1), entropy) < EXACT


def test_entropy_moves_with_the_std():
    it = family(squashed=True, own_std=False)
    encoded = it.model.under(0.0, 4)
    it.score(encoded, it.act(encoded, asked(4)).latent).entropy.sum().backward()
    assert it.std.out.bias.grad.min() > 0, "a wider std is more entropy"


@pytest.mark.parametrize("own_std", [False, True])
def test_evaluation(own_std: bool):
    it = family(False, own_std)
    encoded = it.model.under(0.0, 4)
    still, moving = it.act(encoded, asked(4, explore=False)), it.act(encoded, asked(4))
    assert not still.log_prob.any() and still.chunk.shape == (4, 2, 2)
    if own_std:  # a policy that has a std of its own samples in LeRobot too
        assert torch.equal(still.chunk, moving.chunk)
    else:
        assert torch.equal(still.chunk, encoded.context.mean[:, :2])
    assert not torch.equal(moving.chunk, encoded.context.mean[:, :2])


def test_the_learned_std_does_not_shape_the_features():
    it = family(squashed=False, own_std=False)
    encoded = it.model.under(0.0, 4)
    encoded.context.rows.requires_grad_()
    it.score(encoded, it.act(encoded, asked(4)).latent).log_prob.sum().backward()
    assert encoded.context.rows.grad is None and it.std.out.weight.grad.abs().max() > 0
