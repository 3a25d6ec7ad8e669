# SPDX-License-Identifier: Apache-2.0
"""The flow likelihood: hand numbers, a slow oracle, and the stock sampler where nothing explores."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.errors import InputError
from accerl_lerobot.policies import flow
from accerl_lerobot.policies.flow import FlowShape
from accerl_lerobot.policies.samplers import FlowSamplerConfig
from tests.policies import oracle

SAMPLERS = [
    FlowSamplerConfig(stochastic=stochastic, noise=noise, noise_level=0.3, padded=padded)
    for stochastic, noise, padded in itertools.product(
        ("last", "all", "one"), ("euler", "flow_sde"), ("joint", "analytic")
    )
]
ROW_MIX = np.array([[0.2, -0.5, 0.3], [0.4, 0.1, -0.2], [-0.3, 0.6, 0.5]])
DIM_MIX = np.array(
    [[0.5, 0.8, -0.4, 0.3], [-0.6, 0.2, 0.7, -0.9], [0.9, -0.5, 0.1, 0.4], [0.2, 0.7, -0.8, 0.6]]
)


def name(config: FlowSamplerConfig) -> str:
    return f"{config.stochastic}-{config.noise}-{config.padded}"


def sizes(num_steps: int) -> FlowShape:
    """Three rows of which two are executed, two real dims and two padded ones."""
    return FlowShape(num_steps=num_steps, chunk_size=3, executed=2, padded_dim=4, action_dim=2)


def velocity(x: Tensor, t: Tensor) -> Tensor:
    """Every entry feeds back into every other, padded ones and rows that are not executed included."""
    rows, dims = torch.from_numpy(ROW_MIX).to(x), torch.from_numpy(DIM_MIX).to(x)
    return torch.tanh(rows @ x @ dims + t[:, None, None]) + 0.3 * x


def slow_velocity(x: np.ndarray, t: float, sample: int) -> np.ndarray:
    return np.tanh(ROW_MIX @ x @ DIM_MIX + t) + 0.3 * x


def draws(
    shape: FlowShape, count: int = 6, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(shape.num_steps)
    size = (shape.chunk_size, shape.padded_dim)
    x0 = torch.randn(count, *size, generator=generator, dtype=dtype)
    eps = torch.randn(count, shape.num_steps, *size, generator=generator, dtype=dtype)
    return x0, eps, torch.arange(count) % shape.num_steps


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


@pytest.mark.parametrize(("stochastic", "std"), [("last", 0.3), ("one", 0.3), ("all", 0.15)])
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
    x0, eps, index = draws(shape)
    x, latent, log_prob = flow.sample(velocity, x0, eps, index, explore_all(x0), shape, config)
    path = oracle.paths(slow_velocity, x0.numpy(), eps.numpy(), index.numpy(), shape, config)
    expected = oracle.log_prob(slow_velocity, path, index.numpy(), shape, config)
    rows = shape.executed if config.stochastic == "last" else shape.chunk_size
    assert np.allclose(x.numpy(), path[:, -1], atol=1e-12)
    assert log_prob.shape == (6, rows)
    assert np.allclose(log_prob.numpy(), expected[:, :rows], atol=1e-10)
    assert (expected[:, rows:] == 0).all(), "what is left out has no density"
    assert torch.allclose(flow.log_prob(velocity, latent, shape, config), log_prob, rtol=0, atol=1e-12)


@pytest.mark.parametrize("config", SAMPLERS, ids=name)
def test_other_weights_re_score_the_same_path(config: FlowSamplerConfig):
    shape = sizes(3)
    x0, eps, index = draws(shape)
    _, latent, old = flow.sample(velocity, x0, eps, index, explore_all(x0), shape, config)
    path = oracle.paths(slow_velocity, x0.numpy(), eps.numpy(), index.numpy(), shape, config)
    new = flow.log_prob(lambda x, t: 1.1 * velocity(x, t), latent, shape, config)
    expected = oracle.log_prob(
        lambda x, t, b: 1.1 * slow_velocity(x, t, b), path, index.numpy(), shape, config
    )
    assert np.allclose(new.numpy(), expected[:, : new.shape[1]], atol=1e-10)
    assert (new - old).abs().sum(1).min() > 1e-4


@pytest.mark.parametrize("num_steps", [1, 2, 3, 4])
@pytest.mark.parametrize("config", SAMPLERS, ids=name)
def test_not_exploring_is_the_stock_sampler_bit_for_bit(config: FlowSamplerConfig, num_steps: int):
    shape = sizes(num_steps)
    x0, eps, index = draws(shape, dtype=torch.float32)
    stock = plain_ode(x0, num_steps)
    still, everyone = torch.zeros(6, dtype=torch.bool), explore_all(x0)
    x, _, log_prob = flow.sample(velocity, x0, eps, index, still, shape, config)
    assert torch.equal(x, stock) and not log_prob.any()
    some = torch.tensor([True, False, False, True, False, True])
    mixed, _, mixed_log_prob = flow.sample(velocity, x0, eps, index, some, shape, config)
    exploring, _, exploring_log_prob = flow.sample(velocity, x0, eps, index, everyone, shape, config)
    assert torch.equal(mixed[~some], stock[~some]) and torch.equal(mixed[some], exploring[some])
    assert torch.equal(mixed_log_prob[some], exploring_log_prob[some])
    assert not mixed_log_prob[~some].any()
    assert not torch.isclose(exploring[:, :2, :2], stock[:, :2, :2]).any()


@pytest.mark.parametrize("config", SAMPLERS, ids=name)
def test_without_noise_exploring_is_the_stock_sampler(config: FlowSamplerConfig):
    quiet = FlowSamplerConfig(
        stochastic=config.stochastic, noise=config.noise, noise_level=1e-7, padded=config.padded
    )
    shape = sizes(3)
    x0, eps, index = draws(shape)
    x, _, _ = flow.sample(velocity, x0, eps, index, explore_all(x0), shape, quiet)
    difference = (x - plain_ode(x0, 3))[:, :2, :2].abs().max()
    if config.padded == "analytic" and config.stochastic != "last":
        assert difference > 1e-2, "documented: overwriting padded dims is another sampler"
    else:
        assert difference < 1e-5


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
    x, _, _ = flow.sample(
        exact, x0, eps, torch.zeros(count, dtype=torch.long), explore_all(x0), shape, config
    )
    ratio = x.std().item() / spread
    assert x.mean().item() == pytest.approx(centre, abs=0.03)
    assert abs(ratio - 1) < 0.03 if noise == "flow_sde" else ratio > 1.1


@pytest.mark.parametrize("num_steps", [2, 3, 6, 7, 10])
def test_a_drawn_step_is_re_scored_at_the_time_it_was_sampled_at(num_steps: int):
    # A last-bit difference in t is a phase error of 1e-4 in SmolVLA's time embedding.
    shape = FlowShape(num_steps=num_steps, chunk_size=1, executed=1, padded_dim=1, action_dim=1)
    config = FlowSamplerConfig(stochastic="one")
    seen: list[Tensor] = []

    def recording(x: Tensor, t: Tensor) -> Tensor:
        seen.append(t)
        return x

    x0, eps = torch.zeros(num_steps, 1, 1), torch.zeros(num_steps, num_steps, 1, 1)
    index = torch.arange(num_steps)
    _, latent, _ = flow.sample(recording, x0, eps, index, explore_all(x0), shape, config)
    sampled = torch.stack([seen[k][k] for k in range(num_steps)])
    flow.log_prob(recording, latent, shape, config)
    assert torch.equal(seen[-1], sampled)


@pytest.mark.parametrize("config", SAMPLERS, ids=name)
def test_gradient_against_finite_differences(config: FlowSamplerConfig):
    shape = sizes(3)
    x0, eps, index = draws(shape, count=3)
    _, latent, _ = flow.sample(velocity, x0, eps, index, explore_all(x0), shape, config)

    def score(rows: Tensor, dims: Tensor, shift: Tensor) -> Tensor:
        def parametrised(x: Tensor, t: Tensor) -> Tensor:
            return torch.tanh(rows @ x @ dims + t[:, None, None] * shift) + 0.2 * x

        return flow.log_prob(parametrised, latent, shape, config)

    parameters = [torch.from_numpy(ROW_MIX), torch.from_numpy(DIM_MIX), torch.ones(4, dtype=torch.float64)]
    assert torch.autograd.gradcheck(score, [p.clone().requires_grad_() for p in parameters], atol=1e-6)


@pytest.mark.parametrize("config", SAMPLERS, ids=name)
def test_entropy_is_minus_the_expected_log_density(config: FlowSamplerConfig):
    shape, count = sizes(2), 4000
    x0, eps, index = draws(shape, count=count)
    _, latent, log_prob = flow.sample(velocity, x0, eps, index, explore_all(x0), shape, config)
    entropy = flow.entropy(latent, shape, config)
    error = (entropy + log_prob.sum(1)).std().item() / math.sqrt(count)
    assert entropy.mean().item() == pytest.approx(-log_prob.sum(1).mean().item(), abs=4 * error)


@pytest.mark.parametrize("config", [c for c in SAMPLERS if c.stochastic == "last"], ids=name)
def test_what_is_not_executed_is_marginalised(config: FlowSamplerConfig):
    shape = sizes(3)
    x0, eps, index = draws(shape)
    _, latent, log_prob = flow.sample(velocity, x0, eps, index, explore_all(x0), shape, config)
    elsewhere = ~shape.action_mask()
    moved = latent["path"].clone()
    moved[:, 1] += 3.0 * elsewhere
    assert torch.allclose(flow.log_prob(velocity, {"path": moved}, shape, config), log_prob, atol=1e-12)
    moved[:, 1, 1, 1] += 0.1
    assert not torch.isclose(
        flow.log_prob(velocity, {"path": moved}, shape, config)[:, 1], log_prob[:, 1]
    ).any()


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"stochastic": "first"}, "policy.sampler.stochastic='first'"),
        ({"noise": "none"}, "policy.sampler.noise='none'"),
        ({"padded": "real"}, "policy.sampler.padded='real'"),
        ({"noise_level": 0.0}, "policy.sampler.noise_level=0.0"),
        ({"noise_level": math.nan}, "policy.sampler.noise_level=nan"),
        ({"noise_level": 2.5}, "policy.sampler.noise_level=2.5"),
    ],
)
def test_bad_options_name_their_field(values: dict, field: str):
    with pytest.raises(InputError, match=f"^{field}: use"):
        FlowSamplerConfig(**values)
