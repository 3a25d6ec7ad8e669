# SPDX-License-Identifier: Apache-2.0
"""The std of a denoising step as something that is learnt: bounded, exact, saved, with a gradient."""

from __future__ import annotations

import copy
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.errors import InputError
from accerl_lerobot.policies import flow
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.base import stack_observations
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.family import Encoded
from accerl_lerobot.policies.loading import save_pretrained
from accerl_lerobot.policies.samplers import FlowSamplerConfig
from tests.conftest import write_smolvla
from tests.policies import test_importance as importance
from tests.policies.tiny import adapter_at, check_ratio_one, log_ratio, perturb, requests, stored
from tests.rounding import assert_close

SAMPLERS = [
    FlowSamplerConfig(stochastic=s, noise="learned", noise_level=0.2, padded=p)
    for s, p in (("last", "joint"), ("all", "joint"), ("all", "analytic"), ("one", "joint"))
]


def name(config: FlowSamplerConfig) -> str:
    return f"{config.stochastic}-{config.padded}"


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("smolvla") / "pretrained_model"
    return write_smolvla(directory, chunk=5, executed=3, padded_dim=4, action_dim=2, num_steps=3)


@pytest.fixture(scope="module")
def loaded(path: Path) -> dict[str, LeRobotAdapter]:
    return {name(config): adapter_at(path, config) for config in SAMPLERS}


@pytest.fixture(params=SAMPLERS, ids=name)
def adapter(loaded: dict[str, LeRobotAdapter], request: pytest.FixtureRequest) -> LeRobotAdapter:
    return copy.deepcopy(loaded[name(request.param)])


def widths(adapter: LeRobotAdapter, count: int = 4) -> Tensor:
    """(steps, count, D)."""
    with torch.no_grad():
        encoded = adapter.encode(*stack_observations(requests(count)))
        std = adapter.family._std(encoded)
        return torch.stack([std(torch.full((count,), flow.step_time(k, 3)))[:, 0] for k in range(3)])


def test_it_starts_at_the_level_and_stays_within_its_bounds(adapter: LeRobotAdapter):
    new = widths(adapter)
    assert_close(new, torch.full_like(new, 0.2))
    with torch.no_grad():
        adapter.family.noise.out.weight.normal_(0, 2)
    moved = widths(adapter)
    assert 0.0799 < moved.min() < 0.1 and 0.35 < moved.max() < 0.4001
    assert moved.std(0).max() > 0.01 and moved.std(1).max() > 0.01, "steps and observations differ"


def test_equal_weights_give_ratio_one(adapter: LeRobotAdapter):
    perturb(adapter, 0.3)
    asked = requests(24)
    together = adapter.decide(asked, 0)
    alone = [adapter.decide([request], 0)[0] for request in asked[:6]]
    for decisions in (together, alone + together[6:]):
        check_ratio_one(adapter, asked, decisions)


def test_the_noise_head_has_a_gradient_that_is_right(adapter: LeRobotAdapter):
    perturb(adapter, 0.2)
    asked = requests(8)
    decisions = adapter.decide(asked, 0)
    latent, _ = stored(decisions)
    evaluation = adapter.evaluate(*stack_observations(asked), latent)
    evaluation.log_prob.sum().backward()
    assert adapter.family.noise is not None
    weight, step = adapter.family.noise.out.weight, 3e-3
    assert weight.grad is not None
    gradient, norm, home = weight.grad.clone(), float(weight.grad.norm()), weight.detach().clone()
    scores = []
    for sign in (1, -1):
        with torch.no_grad():
            weight.copy_(home + sign * step * gradient / norm)
        scores.append(float(log_ratio(adapter, asked, decisions).sum()))
    assert (scores[0] - scores[1]) / (2 * step) == pytest.approx(norm, rel=0.02)


def test_entropy_grows_with_the_noise(adapter: LeRobotAdapter):
    asked = requests(3)
    latent, _ = stored(adapter.decide(asked, 0))
    arguments = (*stack_observations(asked), latent)
    before = adapter.evaluate(*arguments).entropy
    assert before.requires_grad
    counted = {
        "last": 3 * 2,
        "all": (5 * 4 if adapter.family.sampler.padded == "joint" else 5 * 2) * 2 + 3 * 2,
    }
    if adapter.family.sampler.stochastic in counted:
        each = math.log(0.2) + 0.5 * math.log(2 * math.pi * math.e)
        expected = counted[adapter.family.sampler.stochastic] * each
        assert_close(before, torch.full((3,), expected))
    with torch.no_grad():
        adapter.family.noise.out.bias += 1.0
    assert (adapter.evaluate(*arguments).entropy > before).all()


def test_it_is_saved_and_published(adapter: LeRobotAdapter, path: Path, tmp_path: Path):
    perturb(adapter, 0.3)
    config = PolicyConfig(path=str(path), device="cpu", sampler=adapter.family.sampler)
    save_pretrained(adapter, tmp_path / "saved", config)
    again = adapter_at(tmp_path / "saved", adapter.family.sampler)
    assert torch.equal(widths(again), widths(adapter))
    published = {
        k.removeprefix("family.noise.") for k in adapter.export_trainable() if k.startswith("family.")
    }
    assert published == {"norm.weight", "norm.bias", "out.weight", "out.bias"}
    asked = requests(4)
    assert np.array_equal(
        [d.log_prob for d in again.decide(asked, 0)], [d.log_prob for d in adapter.decide(asked, 0)]
    )


@pytest.mark.parametrize(("stochastic", "padded"), [("last", "joint"), ("all", "joint"), ("all", "analytic")])
def test_weighted_samples_of_mu_are_samples_of_pi(stochastic: str, padded: str):
    config = FlowSamplerConfig(
        stochastic=stochastic, noise="learned", noise_level=0.4, noise_max=1.0, padded=padded
    )
    shape, n = importance.SHAPE, importance.SAMPLES
    encoded = Encoded(features=torch.ones(n, 1, 2), mask=torch.ones(n, 1).bool(), context=None)

    def std(shift: float) -> flow.Std:
        head = flow.NoiseHead(2, shape, config)
        with torch.no_grad():
            head.out.bias += shift * torch.linspace(0.5, 1.5, len(head.out.bias))
            return head(encoded)

    def act(velocity: flow.Velocity, noise: flow.Std, seed: int) -> tuple[Tensor, dict[str, Tensor], Tensor]:
        generator = torch.Generator().manual_seed(seed)
        size = (shape.chunk_size, shape.padded_dim)
        x0 = torch.randn(n, *size, generator=generator)
        eps = torch.randn(n, shape.num_steps, *size, generator=generator)
        everywhere = torch.ones(n, dtype=torch.bool)
        x, latent, log_prob = flow.sample(
            velocity, x0, eps, torch.zeros(n).long(), everywhere, shape, config, noise
        )
        return x[:, 0, 0], latent, log_prob.sum(1)

    action, latent, behaviour = act(importance.MU, std(0.0), 11)
    new = flow.log_prob(importance.PI, latent, shape, config, std(0.5)).sum(1)
    product = (new - behaviour).exp() * importance.payoff(action)
    wanted = importance.payoff(act(importance.PI, std(0.5), 12)[0])
    unchanged = importance.payoff(act(importance.PI, std(0.0), 13)[0])
    assert importance.deviation(product, wanted) < importance.EXACT
    assert importance.deviation(wanted, importance.payoff(action)) > importance.WRONG
    if stochastic == "all":
        assert importance.deviation(wanted, unchanged) > importance.EXACT, "the std must matter"


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"noise_level": 0.05}, "policy.sampler.noise_min=0.08"),
        ({"noise_level": 0.5}, "policy.sampler.noise_max=0.4"),
        ({"noise_min": 0.0}, "policy.sampler.noise_min=0.0"),
        ({"noise_max": 3.0}, "policy.sampler.noise_max=3.0"),
    ],
)
def test_bounds_that_do_not_hold_the_level(values: dict[str, float], said: str):
    with pytest.raises(InputError, match=f"^{said}: use a "):
        FlowSamplerConfig(noise="learned", **{"noise_level": 0.2, **values})
