# SPDX-License-Identifier: Apache-2.0
"""E_μ[ρ f(a)] = E_π[f(a)] for what is executed, on networks small enough to be sampled often.

"ρ = 1 at equal weights" and "E_μ[ρ] = 1" also hold for log-probs that leave out padded dims; this does not.
`test_tokens` has the same for tokens, by enumeration.
"""

import math
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from accerl_lerobot.experience import Request
from accerl_lerobot.policies.config import DiffusionSamplerConfig, FlowSamplerConfig, GaussianSamplerConfig
from accerl_lerobot.policies.diffusion import DiffusionFamily, Schedule
from accerl_lerobot.policies.family import Action, Encoded
from accerl_lerobot.policies.flow import FlowFamily, FlowShape
from accerl_lerobot.policies.gaussian import GaussianFamily
from tests.policies.tiny import deviation
from tests.rounding import assert_close

EXACT, WRONG = 4.0, 10.0
"""Monte-Carlo errors: agreement is below the first, a detected mistake above the second."""
MU, PI = False, True


class Case(NamedTuple):
    act: Callable[[bool, int], Action]
    """Decisions of μ or π, with noise of a seed."""
    log_prob: Callable[[bool, dict[str, Tensor]], Tensor]
    entropy: Tensor
    """That of μ, (B,)."""


def network(size: int, pi: bool) -> Callable[[Tensor, Any], Tensor]:
    """A mix of `size` entries, each of which hangs on every other."""
    base, other = torch.Generator().manual_seed(7), torch.Generator().manual_seed(8)
    mix, added = 0.3 * torch.randn(size, size, generator=base), torch.zeros(size)
    mix[:2] = torch.tensor([0.3] + [0.8] * (size - 1))
    if pi:
        mix += 0.1 * torch.randn(size, size, generator=other)
        added = torch.tensor([-0.2] + [0.6] * (size - 1))

    def predict(x: Tensor, t: Any) -> Tensor:
        mixed = x.flatten(1) @ mix.T + 0.3 * torch.as_tensor(t).view(-1, 1)
        return (torch.tanh(mixed) + added).view(x.shape)

    return predict


def flow(count: int = 150_000) -> Case:
    """Two rows of three dims, of which one entry is executed."""
    shape = FlowShape(num_steps=3, chunk_size=2, executed=1, padded_dim=3, action_dim=1)
    family = FlowFamily(SimpleNamespace(shape=shape), FlowSamplerConfig(noise_level=0.4))

    def act(pi: bool, seed: int) -> Action:
        draw = torch.Generator().manual_seed(seed)
        x0, eps = (torch.randn(count, 2, 3, generator=draw) for _ in range(2))
        return family.sample(network(6, pi), x0, eps[:, None], torch.ones(count, dtype=torch.bool))

    entropy = torch.full((2,), family.entropy)
    return Case(act, lambda pi, latent: family.log_prob(network(6, pi), latent), entropy)


def chain(scheduler: str, prediction: str = "epsilon") -> DiffusionFamily:
    """Three steps of three rows, of which the second is executed."""
    alphas = torch.tensor([0.1, 0.5, 0.9])
    schedule = Schedule(
        timesteps=(2, 1, 0),
        alphas=alphas,
        following=torch.cat([alphas[1:], torch.ones(1)]),
        scheduler=scheduler,
        prediction=prediction,
        clip=1.5,
    )
    model = SimpleNamespace(size=(3, 1), rows=slice(1, 2), schedule=schedule)
    return DiffusionFamily(model, DiffusionSamplerConfig(std_min=0.3))


def diffusion(*kind: str, count: int = 100_000) -> Case:
    family = chain(*kind)

    def act(pi: bool, seed: int) -> Action:
        draw = torch.Generator().manual_seed(seed)
        x, eps = torch.randn(count, 3, 1, generator=draw), torch.randn(count, 3, 3, 1, generator=draw)
        return family.sample(network(3, pi), x, eps, torch.ones(count, dtype=torch.bool))

    entropy = torch.full((2,), family.entropy)
    return Case(act, lambda pi, latent: family.log_prob(network(3, pi), latent), entropy)


def encoded(pi: bool, count: int) -> Encoded:
    """Three rows of two dims, of which two rows are executed."""
    mean = torch.linspace(-0.5, 0.8, 6).view(1, 3, 2) + 0.3 * pi
    rows = torch.sin(torch.arange(12.0) + pi).view(1, 3, 4)
    context = mean.expand(count, -1, -1), rows.expand(count, -1, -1)
    return Encoded(features=torch.zeros(count, 1, 4), mask=torch.ones(count, 1).bool(), context=context)


def gaussian_family() -> GaussianFamily:
    model = SimpleNamespace(executed=2, action_dim=2, row_width=4)
    family = GaussianFamily(model, GaussianSamplerConfig(std=0.4))
    with torch.no_grad():
        family.std.out.weight.copy_(torch.linspace(-1, 1, 8).view(2, 4))
    return family


@torch.no_grad()
def gaussian(count: int = 40_000) -> Case:
    family = gaussian_family()

    def act(pi: bool, seed: int) -> Action:
        asked = [Request(observation={}, noise_seed=count * seed + i) for i in range(count)]
        return family.act(encoded(pi, count), asked)

    def score(pi: bool, latent: dict[str, Tensor]) -> Tensor:
        return family.score(encoded(pi, count), latent)[0]

    return Case(act, score, family.score(encoded(MU, 2), {"u": torch.zeros(2, 2, 2)})[1])


def payoff(chunk: Tensor) -> Tensor:
    """Depends on the executed entries, and on two of them together."""
    x = chunk.flatten(1)
    return torch.tanh(2 * x[:, 0] + x[:, -1] + 0.5) + 0.2 * x[:, 0] ** 2


@torch.no_grad()
@pytest.mark.parametrize(
    "make",
    [flow, partial(diffusion, "DDPM"), partial(diffusion, "DDIM", "sample"), gaussian],
    ids=["flow", "ddpm", "ddim", "gaussian"],
)
def test_weighted_samples_of_mu_are_samples_of_pi(make: Callable[[], Case]):
    case = make()
    acted = case.act(MU, 11)
    ratio = (case.log_prob(PI, acted.latent) - acted.log_prob).sum(1).exp()
    new, old = (payoff(case.act(pi, seed).chunk) for pi, seed in ((PI, 12), (MU, 13)))
    assert deviation(old, new) > WRONG, "the weights must matter, or the test shows nothing"
    assert deviation(ratio, torch.ones(2)) < EXACT
    assert deviation(ratio * payoff(acted.chunk), new) < EXACT
    assert deviation(-acted.log_prob.sum(1), case.entropy) < EXACT, "entropy is the mean surprise"


def test_diffusion_explores_with_the_least_std():
    family, x, eps = chain("DDPM"), torch.zeros(1, 3, 1), torch.ones(1, 3, 3, 1)
    path = family.sample(network(3, MU), x, eps, torch.tensor([True])).latent["path"]
    for k, timestep in enumerate((2, 1, 0)):
        mean, std = family.schedule.step(k, path[:, k], network(3, MU)(path[:, k], timestep))
        assert_close(path[:, k + 1], mean + max(float(std), 0.3))
    assert float(family.schedule.step(2, x, x)[1]) == 0


def test_the_learned_std_of_a_gaussian_does_not_shape_the_features():
    family, read = gaussian_family(), encoded(MU, 4)
    read.context[1].requires_grad_()
    action = family.act(read, [Request(observation={}, noise_seed=i) for i in range(4)])
    family.score(read, action.latent)[0].sum().backward()
    assert read.context[1].grad is None and family.std.out.weight.grad.abs().max() > 0


@pytest.mark.parametrize("num_steps", [1, 2, 3, 4])
def test_a_flow_is_lerobot_s_sampler_with_noise_of_a_known_density(num_steps: int):
    # Three rows of which two are executed, two real dims and two padded ones; some decisions explore.
    shape = FlowShape(num_steps=num_steps, chunk_size=3, executed=2, padded_dim=4, action_dim=2)
    family = FlowFamily(SimpleNamespace(shape=shape), FlowSamplerConfig(noise_level=0.3))
    draw = torch.Generator().manual_seed(num_steps)
    x0, eps = (torch.randn(6, 3, 4, generator=draw) for _ in range(2))
    velocity, stock, dt = network(12, MU), x0, -1.0 / num_steps
    for step in range(num_steps):  # LeRobot's loop
        stock = stock + dt * velocity(stock, torch.tensor(1.0 + step * dt).expand(6))
    some = torch.tensor([True, False, False, True, False, True])
    action = family.sample(velocity, x0, eps[:, None], some)
    x = action.latent["path"][:, 1]
    assert torch.equal(x[~some], stock[~some]) and not action.log_prob[~some].any()
    assert torch.equal(action.chunk, x[:, :2, :2])
    assert_close(x[some], (stock + 0.3 * eps)[some])
    expected = -0.5 * eps.square() - math.log(0.3 * math.sqrt(2 * math.pi))
    assert_close(action.log_prob[some], expected[some, :2, :2].sum(2))
    assert_close(family.log_prob(velocity, action.latent)[some], action.log_prob[some])
