# SPDX-License-Identifier: Apache-2.0
"""Importance weights: E_μ[ρ f(a)] = E_π[f(a)] for the action the world executes.

"ρ = 1 at equal weights" and "E_μ[ρ] = 1" also hold for log-probs that leave out the padded dims they put
noise into; this identity does not, because padded dims feed back into executed ones.
"""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from accerl_lerobot.policies import flow
from accerl_lerobot.policies.flow import FlowShape, Velocity
from accerl_lerobot.policies.samplers import FlowSamplerConfig

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
    index = torch.randint(SHAPE.num_steps, (SAMPLES,), generator=generator)
    explore = torch.ones(SAMPLES, dtype=torch.bool)
    x, latent, log_prob = flow.sample(velocity, x0, eps, index, explore, SHAPE, config)
    return x[:, 0, 0], latent, log_prob.sum(1)


def payoff(action: Tensor) -> Tensor:
    return torch.tanh(2 * action + 0.5) + 0.2 * action**2


def weighted(config: FlowSamplerConfig) -> tuple[Tensor, Tensor]:
    """Samples of μ: ρ (B,) and ρ·f(a) (B,)."""
    action, latent, behaviour = act(MU, config, 11)
    ratio = (flow.log_prob(PI, latent, SHAPE, config).sum(1) - behaviour).exp()
    return ratio, ratio * payoff(action)


def deviation(one: Tensor, other: Tensor) -> float:
    """Difference of two means in units of its standard error."""
    error = math.sqrt(one.var().item() / len(one) + other.var().item() / len(other))
    return abs(one.mean().item() - other.mean().item()) / error


EXACT_SAMPLERS = [
    FlowSamplerConfig(stochastic="last", noise="euler", noise_level=0.4),
    FlowSamplerConfig(stochastic="last", noise="flow_sde", noise_level=1.0),
    FlowSamplerConfig(stochastic="all", noise="euler", noise_level=0.8, padded="joint"),
    FlowSamplerConfig(stochastic="all", noise="flow_sde", noise_level=0.8, padded="joint"),
    FlowSamplerConfig(stochastic="all", noise="euler", noise_level=0.8, padded="analytic"),
    FlowSamplerConfig(stochastic="all", noise="flow_sde", noise_level=0.8, padded="analytic"),
]


def name(config: FlowSamplerConfig) -> str:
    return f"{config.stochastic}-{config.noise}-{config.padded}"


@pytest.mark.parametrize("config", EXACT_SAMPLERS, ids=name)
def test_weighted_samples_of_mu_are_samples_of_pi(config: FlowSamplerConfig):
    ratio, product = weighted(config)
    new, old = payoff(act(PI, config, 12)[0]), payoff(act(MU, config, 13)[0])
    assert deviation(old, new) > WRONG, "the weights must matter, or the test shows nothing"
    assert deviation(ratio, torch.ones(2)) < EXACT
    assert deviation(product, new) < EXACT


@pytest.mark.parametrize("noise", ["euler", "flow_sde"])
def test_leaving_out_padded_dims_is_caught(noise: str, monkeypatch: pytest.MonkeyPatch):
    config = FlowSamplerConfig(stochastic="all", noise=noise, noise_level=0.8, padded="joint")
    real = torch.zeros(SHAPE.chunk_size, SHAPE.padded_dim, dtype=torch.bool)
    real[:, : SHAPE.action_dim] = True
    monkeypatch.setattr(flow, "_counted", lambda k, mask, shape, config: real)
    _, latent, behaviour = act(MU, config, 11)
    assert torch.allclose(flow.log_prob(MU, latent, SHAPE, config).sum(1), behaviour, atol=1e-4)
    ratio, product = weighted(config)
    assert deviation(ratio, torch.ones(2)) < EXACT, "E[ρ] = 1 does not catch it"
    assert deviation(product, payoff(act(PI, config, 12)[0])) > WRONG


def test_taking_the_last_step_s_start_as_given_is_caught():
    # The tempting shortcut for ``last``: re-score from the stored x_{N−1} in one velocity pass.
    config = FlowSamplerConfig(stochastic="last", noise="euler", noise_level=0.4)
    action, latent, behaviour = act(MU, config, 11)
    x, b, n = latent["path"][:, 0], SAMPLES, SHAPE.num_steps
    for k in range(n - 1):
        x = x - MU(x, x.new_full((b,), flow.step_time(k, n))) / n
    t = x.new_full((b,), flow.step_time(n - 1, n))
    mean, std = flow.transition(x, PI(x, t), t, SHAPE, config)
    shortcut = flow.gaussian_log_prob(latent["path"][:, 1], mean, std, SHAPE.action_mask()).sum(1)
    product = (shortcut - behaviour).exp() * payoff(action)
    assert deviation(product, payoff(act(PI, config, 12)[0])) > WRONG


@pytest.mark.parametrize("noise", ["euler", "flow_sde"])
@pytest.mark.parametrize("padded", ["joint", "analytic"])
def test_one_drawn_step_weights_towards_that_step_alone(noise: str, padded: str):
    config = FlowSamplerConfig(stochastic="one", noise=noise, noise_level=0.8, padded=padded)
    ratio, product = weighted(config)
    index = torch.randint(
        SHAPE.num_steps, (SAMPLES,), generator=_after_noise(torch.Generator().manual_seed(12))
    )
    times = torch.tensor([flow.step_time(k, SHAPE.num_steps) for k in range(SHAPE.num_steps)])

    def only_the_drawn_step_is_new(x: Tensor, t: Tensor) -> Tensor:
        return torch.where((t == times[index])[:, None, None], PI(x, t), MU(x, t))

    hybrid = payoff(act(only_the_drawn_step_is_new, config, 12)[0])
    assert deviation(ratio, torch.ones(2)) < EXACT
    assert deviation(product, hybrid) < EXACT
    assert deviation(product, payoff(act(PI, config, 12)[0])) > WRONG, "not π: the other steps are still μ's"


def _after_noise(generator: torch.Generator) -> torch.Generator:
    """Advances a generator to where `act` draws its steps."""
    size = (SHAPE.chunk_size, SHAPE.padded_dim)
    torch.randn(SAMPLES, *size, generator=generator)
    torch.randn(SAMPLES, SHAPE.num_steps, *size, generator=generator)
    return generator
