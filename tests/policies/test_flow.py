# SPDX-License-Identifier: Apache-2.0
"""The flow likelihood: hand numbers, a slow oracle, and the stock sampler where nothing explores."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.policies import flow
from accerl_lerobot.policies.config import FlowSamplerConfig
from accerl_lerobot.policies.family import Encoded
from accerl_lerobot.policies.flow import FlowShape, Velocity
from tests.policies import oracle
from tests.policies.tiny import deviation
from tests.rounding import assert_close

SAMPLERS = [
    FlowSamplerConfig(stochastic=stochastic, noise=noise, noise_level=0.3)
    for stochastic, noise in itertools.product(("last", "all", "one"), ("euler", "flow_sde"))
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
    assert np.allclose(log_prob.sum(1), expected, atol=1e-10)
    assert torch.allclose(flow.log_prob(velocity, latent, shape, config), log_prob, rtol=0, atol=1e-12)


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


def act(
    velocity: Velocity, config: FlowSamplerConfig, seed: int, std: flow.Std | None = None
) -> tuple[Tensor, dict[str, Tensor], Tensor]:
    """(executed action (B,), latent, log-prob (B,))."""
    generator = torch.Generator().manual_seed(seed)
    size = (SHAPE.chunk_size, SHAPE.padded_dim)
    x0 = torch.randn(SAMPLES, *size, generator=generator)
    eps = torch.randn(SAMPLES, SHAPE.num_steps, *size, generator=generator)
    index = torch.randint(SHAPE.num_steps, (SAMPLES,), generator=generator)
    explore = torch.ones(SAMPLES, dtype=torch.bool)
    x, latent, log_prob = flow.sample(velocity, x0, eps, index, explore, SHAPE, config, std)
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


@pytest.mark.parametrize("noise", ["euler", "flow_sde"])
def test_one_drawn_step_weights_towards_that_step_alone(noise: str):
    config = FlowSamplerConfig(stochastic="one", noise=noise, noise_level=0.8)
    ratio, product = weighted(config)
    generator = torch.Generator().manual_seed(12)  # advanced to where `act` draws its steps
    for steps in (1, SHAPE.num_steps):
        torch.randn(SAMPLES, steps, SHAPE.chunk_size, SHAPE.padded_dim, generator=generator)
    index = torch.randint(SHAPE.num_steps, (SAMPLES,), generator=generator)
    times = torch.tensor([flow.step_time(k, SHAPE.num_steps) for k in range(SHAPE.num_steps)])

    def only_the_drawn_step_is_new(x: Tensor, t: Tensor) -> Tensor:
        return torch.where((t == times[index])[:, None, None], PI(x, t), MU(x, t))

    hybrid = payoff(act(only_the_drawn_step_is_new, config, 12)[0])
    assert deviation(ratio, torch.ones(2)) < EXACT
    assert deviation(product, hybrid) < EXACT
    assert deviation(product, payoff(act(PI, config, 12)[0])) > WRONG, "not π: the other steps are still μ's"


# ---- a learned std


def head(config: FlowSamplerConfig, shift: float) -> Callable[[Encoded], flow.Std]:
    made = flow.NoiseHead(2, SHAPE, config)
    with torch.no_grad():
        made.out.bias += shift * torch.linspace(0.5, 1.5, len(made.out.bias))
    return made


@pytest.mark.parametrize("stochastic", ["last", "all"])
def test_weighted_samples_of_mu_are_samples_of_pi_where_the_std_is_learned(stochastic: str):
    config = FlowSamplerConfig(stochastic=stochastic, noise="learned", noise_level=0.4, noise_max=1.0)
    encoded = Encoded(features=torch.ones(SAMPLES, 1, 2), mask=torch.ones(SAMPLES, 1).bool(), context=None)
    with torch.no_grad():
        old, new = head(config, 0.0)(encoded), head(config, 0.5)(encoded)
        action, latent, behaviour = act(MU, config, 11, old)
        ratio = (flow.log_prob(PI, latent, SHAPE, config, new).sum(1) - behaviour).exp()
        wanted, unchanged = (payoff(act(PI, config, seed, std)[0]) for seed, std in ((12, new), (13, old)))
    assert deviation(ratio * payoff(action), wanted) < EXACT
    assert deviation(wanted, payoff(action)) > WRONG
    if stochastic == "all":
        assert deviation(wanted, unchanged) > EXACT, "the std must matter"


def test_the_learned_std_starts_at_the_level_and_differs_between_steps_and_observations_within_bounds():
    config = FlowSamplerConfig(noise="learned", noise_level=0.2)
    features = torch.randn(4, 1, 2, generator=torch.Generator().manual_seed(0))
    encoded = Encoded(features=features, mask=torch.ones(4, 1).bool(), context=None)
    made = flow.NoiseHead(2, SHAPE, config)

    def widths() -> Tensor:
        with torch.no_grad():
            std = made(encoded)
            return torch.stack([std(torch.full((4,), flow.step_time(k, 3)))[:, 0] for k in range(3)])

    assert_close(widths(), torch.full((3, 4, 3), 0.2))
    with torch.no_grad():
        made.out.weight.normal_(0, 6, generator=torch.Generator().manual_seed(0))
    moved = widths()
    assert 0.0799 < moved.min() < 0.1 and 0.35 < moved.max() < 0.4001
    assert moved.std(0).max() > 0.01 and moved.std(1).max() > 0.01


@pytest.mark.parametrize(("stochastic", "entries"), [("last", 1), ("all", 2 * 6 + 1)])
def test_entropy_of_a_learned_std_by_hand(stochastic: str, entries: int):
    config = FlowSamplerConfig(stochastic=stochastic, noise="learned", noise_level=0.2)
    encoded = Encoded(features=torch.ones(4, 1, 2), mask=torch.ones(4, 1).bool(), context=None)
    latent = {"path": torch.zeros(4, 4 if stochastic == "all" else 2, 2, 3)}
    small, large = (flow.entropy(latent, SHAPE, config, head(config, s)(encoded)) for s in (0.0, 1.0))
    assert_close(small, torch.full((4,), entries * (math.log(0.2) + 0.5 * math.log(2 * math.pi * math.e))))
    assert (large > small).all() and small.requires_grad
