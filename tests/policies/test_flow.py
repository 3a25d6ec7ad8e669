# SPDX-License-Identifier: Apache-2.0
"""The flow likelihood: hand numbers, a slow oracle, and the stock sampler where nothing explores."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.policies import flow
from accerl_lerobot.policies.config import FlowSamplerConfig
from accerl_lerobot.policies.flow import FlowShape, Velocity
from tests.policies import oracle
from tests.policies.tiny import deviation

SAMPLERS = [
    FlowSamplerConfig(stochastic=stochastic, noise=noise, noise_level=0.3)
    for stochastic, noise in itertools.product(("last", "all"), ("euler", "flow_sde"))
]
ROW_MIX = np.array([[0.2, -0.5, 0.3], [0.4, 0.1, -0.2], [-0.3, 0.6, 0.5]])
DIM_MIX = np.array(
    [[0.5, 0.8, -0.4, 0.3], [-0.6, 0.2, 0.7, -0.9], [0.9, -0.5, 0.1, 0.4], [0.2, 0.7, -0.8, 0.6]]
)


def name(config: FlowSamplerConfig) -> str:
    return f"{config.stochastic}-{config.noise}"


def sizes(num_steps: int) -> FlowShape:
    """Three rows of which two are executed, two real dims and two padded ones."""
    return FlowShape(num_steps=num_steps, chunk_size=3, executed=2, padded_dim=4, action_dim=2)


def velocity(x: Tensor, t: Tensor) -> Tensor:
    """Every entry feeds back into every other, padded ones and rows that are not executed included."""
    rows, dims = torch.from_numpy(ROW_MIX).to(x), torch.from_numpy(DIM_MIX).to(x)
    return torch.tanh(rows @ x @ dims + t[:, None, None]) + 0.3 * x


def slow_velocity(x: np.ndarray, t: float, sample: int) -> np.ndarray:
    return np.tanh(ROW_MIX @ x @ DIM_MIX + t) + 0.3 * x


def draws(shape: FlowShape, count: int = 6, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(shape.num_steps)
    size = (shape.chunk_size, shape.padded_dim)
    x0 = torch.randn(count, *size, generator=generator, dtype=dtype)
    eps = torch.randn(count, shape.num_steps, *size, generator=generator, dtype=dtype)
    return x0, eps


def explore_all(x0: Tensor) -> Tensor:
    return torch.ones(len(x0), dtype=torch.bool)


def plain_ode(x: Tensor, num_steps: int) -> Tensor:
    """LeRobot's loop."""
    dt = -1.0 / num_steps
    for step in range(num_steps):
        x = x + dt * velocity(x, torch.tensor(1.0 + step * dt).to(x).expand(len(x)))
    return x


@pytest.mark.parametrize(
    ("k", "std", "mean"), [(0, 0.5, 17 / 24), (1, 0.40825, 11 / 16), (2, 0.20412, 3 / 4)]
)
def test_flow_sde_by_hand(k: int, std: float, mean: float):
    # a = 0.5, N = 3, x = 1, v = 0.5; e.g. k = 1: t = 2/3, σ² = 0.25 · 2, so std = √(0.5/3) and
    # μ = 1 − 0.5/3 − (1/3 · 0.5 / (4/3)) · (1 + 1/3 · 0.5) = 11/16.
    config = FlowSamplerConfig(stochastic="all", noise="flow_sde", noise_level=0.5)
    shape = FlowShape(num_steps=3, chunk_size=1, executed=1, padded_dim=1, action_dim=1)
    x, v = torch.ones(1, 1, 1, dtype=torch.float64), torch.full((1, 1, 1), 0.5, dtype=torch.float64)
    t = torch.tensor([flow.step_time(k, 3)], dtype=torch.float64)
    got_mean, got_std = flow.transition(x, v, t, shape, config)
    assert got_std.item() == pytest.approx(std, abs=1e-5)
    assert got_mean.item() == pytest.approx(mean, abs=1e-12)


@pytest.mark.parametrize(("stochastic", "std"), [("last", 0.3), ("all", 0.15)])
def test_euler_by_hand(stochastic: str, std: float):
    # Under ``all`` four steps share the variance 0.3²: std 0.3/√4.
    config = FlowSamplerConfig(stochastic=stochastic, noise="euler", noise_level=0.3)
    shape = FlowShape(num_steps=4, chunk_size=1, executed=1, padded_dim=1, action_dim=1)
    x, v = torch.ones(1, 1, 1), torch.full((1, 1, 1), 0.5)
    mean, got = flow.transition(x, v, torch.tensor([0.25]), shape, config)
    assert got.item() == pytest.approx(std) and mean.item() == 0.875


@pytest.mark.parametrize("num_steps", [1, 2, 3, 4])
@pytest.mark.parametrize("config", SAMPLERS, ids=name)
def test_the_path_and_its_density_are_the_oracle_s(config: FlowSamplerConfig, num_steps: int):
    shape = sizes(num_steps)
    x0, eps = draws(shape)
    x, latent, log_prob = flow.sample(velocity, x0, eps, explore_all(x0), shape, config)
    path = oracle.paths(slow_velocity, x0.numpy(), eps.numpy(), shape, config)
    expected = oracle.log_prob(slow_velocity, path, shape, config)
    rows = shape.executed if config.stochastic == "last" else shape.chunk_size
    assert np.allclose(x.numpy(), path[:, -1], atol=1e-12)
    assert log_prob.shape == (6, rows)
    assert np.allclose(log_prob.sum(1), expected, atol=1e-10)
    assert torch.allclose(flow.log_prob(velocity, latent, shape, config), log_prob, rtol=0, atol=1e-12)


@pytest.mark.parametrize("num_steps", [1, 2, 3, 4])
@pytest.mark.parametrize("config", SAMPLERS, ids=name)
def test_not_exploring_is_the_stock_sampler_bit_for_bit(config: FlowSamplerConfig, num_steps: int):
    shape = sizes(num_steps)
    x0, eps = draws(shape, dtype=torch.float32)
    stock = plain_ode(x0, num_steps)
    still, everyone = torch.zeros(6, dtype=torch.bool), explore_all(x0)
    x, _, log_prob = flow.sample(velocity, x0, eps, still, shape, config)
    assert torch.equal(x, stock) and not log_prob.any()
    some = torch.tensor([True, False, False, True, False, True])
    mixed, _, mixed_log_prob = flow.sample(velocity, x0, eps, some, shape, config)
    exploring, _, exploring_log_prob = flow.sample(velocity, x0, eps, everyone, shape, config)
    assert torch.equal(mixed[~some], stock[~some]) and torch.equal(mixed[some], exploring[some])
    assert torch.equal(mixed_log_prob[some], exploring_log_prob[some])
    assert not mixed_log_prob[~some].any()
    assert not torch.isclose(exploring[:, :2, :2], stock[:, :2, :2]).any()


@pytest.mark.parametrize("noise", ["euler", "flow_sde"])
def test_only_flow_sde_keeps_the_distribution(noise: str):
    # Data N(0.7, 0.5²): x_t is Gaussian, and v(x, t) = E[ε − a | x_t = x] is linear in x.
    centre, spread, n, count = 0.7, 0.5, 100, 20_000

    def exact(x: Tensor, t: Tensor) -> Tensor:
        t = t[:, None, None]
        slope = (t - (1 - t) * spread**2) / ((1 - t) ** 2 * spread**2 + t**2)
        return slope * (x - (1 - t) * centre) - centre

    shape = FlowShape(num_steps=n, chunk_size=1, executed=1, padded_dim=1, action_dim=1)
    generator = torch.Generator().manual_seed(0)
    x0 = torch.randn(count, 1, 1, generator=generator)
    eps = torch.randn(count, n, 1, 1, generator=generator)
    config = FlowSamplerConfig(stochastic="all", noise=noise, noise_level=0.7)
    x, _, _ = flow.sample(exact, x0, eps, explore_all(x0), shape, config)
    ratio = x.std().item() / spread
    assert x.mean().item() == pytest.approx(centre, abs=0.03)
    assert abs(ratio - 1) < 0.03 if noise == "flow_sde" else ratio > 1.1


@pytest.mark.parametrize("config", SAMPLERS, ids=name)
def test_gradient_against_finite_differences(config: FlowSamplerConfig):
    shape = sizes(3)
    x0, eps = draws(shape, count=3)
    _, latent, _ = flow.sample(velocity, x0, eps, explore_all(x0), shape, config)

    def score(rows: Tensor, dims: Tensor, shift: Tensor) -> Tensor:
        def parametrised(x: Tensor, t: Tensor) -> Tensor:
            return torch.tanh(rows @ x @ dims + t[:, None, None] * shift) + 0.2 * x

        return flow.log_prob(parametrised, latent, shape, config)

    parameters = [torch.from_numpy(ROW_MIX), torch.from_numpy(DIM_MIX), torch.ones(4, dtype=torch.float64)]
    assert torch.autograd.gradcheck(score, [p.clone().requires_grad_() for p in parameters], atol=1e-6)


@pytest.mark.parametrize("config", SAMPLERS, ids=name)
def test_entropy_is_minus_the_expected_log_density(config: FlowSamplerConfig):
    shape, count = sizes(2), 4000
    x0, eps = draws(shape, count=count)
    _, _, log_prob = flow.sample(velocity, x0, eps, explore_all(x0), shape, config)
    error = log_prob.sum(1).std().item() / math.sqrt(count)
    assert flow.entropy(shape, config) == pytest.approx(-log_prob.sum(1).mean().item(), abs=4 * error)


# ---- importance weights: E_μ[ρ f(a)] = E_π[f(a)] for the action the environment executes. "ρ = 1 at equal
# weights" and "E_μ[ρ] = 1" also hold for log-probs that leave out padded dims; this identity does not.

SHAPE = FlowShape(num_steps=3, chunk_size=2, executed=1, padded_dim=3, action_dim=1)
SAMPLES = 150_000
EXACT, WRONG = 4.0, 10.0
"""Monte-Carlo errors: agreement is below the first, a detected mistake above the second."""


def network(perturbation: float, drift: float) -> Velocity:
    """A nonlinear mix of all K·D entries, in which the executed one hangs on every other.

    Args:
        perturbation: size of a fixed random change of all weights.
        drift: added to the velocity of padded dims; a third of it is taken from that of real ones.
    """
    base, other = torch.Generator().manual_seed(7), torch.Generator().manual_seed(8)
    size = SHAPE.chunk_size * SHAPE.padded_dim
    mix = 0.3 * torch.randn(size, size, generator=base)
    mix[0] = torch.tensor([0.2, 0.9, 0.9, 0.5, 0.5, 0.5])
    mix += perturbation * torch.randn(size, size, generator=other)
    added = torch.where(torch.arange(SHAPE.padded_dim) < SHAPE.action_dim, -drift / 3, drift)

    def velocity(x: Tensor, t: Tensor) -> Tensor:
        return torch.tanh(x.flatten(1) @ mix.T + 0.5 * t[:, None]).view(x.shape) + added

    return velocity


MU, PI = network(0.0, 0.0), network(0.1, 0.3)


def act(velocity: Velocity, config: FlowSamplerConfig, seed: int) -> tuple[Tensor, dict[str, Tensor], Tensor]:
    """(executed action (B,), latent, log-prob (B,))."""
    generator = torch.Generator().manual_seed(seed)
    size = (SHAPE.chunk_size, SHAPE.padded_dim)
    x0 = torch.randn(SAMPLES, *size, generator=generator)
    eps = torch.randn(SAMPLES, SHAPE.num_steps, *size, generator=generator)
    explore = torch.ones(SAMPLES, dtype=torch.bool)
    x, latent, log_prob = flow.sample(velocity, x0, eps, explore, SHAPE, config)
    return x[:, 0, 0], latent, log_prob.sum(1)


def payoff(action: Tensor) -> Tensor:
    return torch.tanh(2 * action + 0.5) + 0.2 * action**2


def weighted(config: FlowSamplerConfig) -> tuple[Tensor, Tensor]:
    """Samples of μ: ρ (B,) and ρ·f(a) (B,)."""
    action, latent, behaviour = act(MU, config, 11)
    ratio = (flow.log_prob(PI, latent, SHAPE, config).sum(1) - behaviour).exp()
    return ratio, ratio * payoff(action)


EXACT_SAMPLERS = [
    FlowSamplerConfig(stochastic="last", noise="euler", noise_level=0.4),
    FlowSamplerConfig(stochastic="last", noise="flow_sde", noise_level=1.0),
    FlowSamplerConfig(stochastic="all", noise="euler", noise_level=0.8),
    FlowSamplerConfig(stochastic="all", noise="flow_sde", noise_level=0.8),
]


@pytest.mark.parametrize("config", EXACT_SAMPLERS, ids=name)
def test_weighted_samples_of_mu_are_samples_of_pi(config: FlowSamplerConfig):
    ratio, product = weighted(config)
    new, old = payoff(act(PI, config, 12)[0]), payoff(act(MU, config, 13)[0])
    assert deviation(old, new) > WRONG, "the weights must matter, or the test shows nothing"
    assert deviation(ratio, torch.ones(2)) < EXACT
    assert deviation(product, new) < EXACT
