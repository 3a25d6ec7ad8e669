# SPDX-License-Identifier: Apache-2.0
"""GIPO and PPO: against the oracle, by hand, and what holds for both."""

import math
from dataclasses import replace
from statistics import fmean
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import GIPOConfig, LossInputs, PPOConfig, RatioConfig
from accerl_lerobot.algorithms.objective import LOG_RATIO_CLAMP
from tests.algorithms.inputs import gradient, make_inputs, one

CONFIGS: list[RatioConfig] = [
    GIPOConfig(level="token", sigma=0.5, entropy_coef=0.01),
    GIPOConfig(level="chunk", sigma=math.inf, kl_coef=0.0),
    PPOConfig(level="token", kl_coef=0.2),
    PPOConfig(level="chunk", clip_low=0.1, clip_high=0.4, entropy_coef=0.01),
]
each_config = pytest.mark.parametrize("config", CONFIGS, ids=lambda c: f"{c.type}-{c.level}")
each_algorithm = pytest.mark.parametrize(
    "config", [GIPOConfig(kl_coef=0.0), PPOConfig()], ids=lambda c: c.type
)


Ragged = list[list[float]]
"""One list per decision, with an entry for each of its ratios."""


def grouped(x: np.ndarray, level: str, factors: np.ndarray | None = None) -> Ragged:
    """Sums of (N, L) log-probs over what one ratio covers, without factors that do not exist."""
    found: Ragged = []
    for i in range(len(x)):
        row = [float(x[i, j]) for j in range(x.shape[1]) if factors is None or factors[i, j]]
        found.append([sum(row)] if level == "chunk" else row)
    return found


def logs_of(inputs: LossInputs, level: str) -> Ragged:
    """log of π over μ."""
    factors = None if inputs.factors is None else inputs.factors.numpy()
    return grouped((inputs.log_prob_new.detach() - inputs.log_prob_old).numpy(), level, factors)


def policy_loss_of(inputs: LossInputs, config: RatioConfig) -> float:
    """The papers' formulas, one ratio at a time: −E[ω ρ Â], or −E[min(ρ Â, clip(ρ, 1 − low, 1 + high) Â)]."""
    terms = []
    for row, advantage in zip(logs_of(inputs, config.level), inputs.advantage.tolist(), strict=True):
        for x in row:
            rho = math.exp(x)
            if isinstance(config, GIPOConfig):
                terms.append(math.exp(-0.5 * (x / config.sigma) ** 2) * rho * advantage)
            else:
                assert isinstance(config, PPOConfig)
                clipped = min(max(rho, 1 - config.clip_low), 1 + config.clip_high)
                terms.append(min(rho * advantage, clipped * advantage))
    return -fmean(terms)


def loss_of(inputs: LossInputs, config: RatioConfig) -> float:
    """With ½ E(V − R)² + kl_coef · KL(μ‖π) − entropy_coef · H."""
    error = (inputs.value.detach() - inputs.returns).square().tolist()
    kl = fmean(math.exp(x) - 1 - x for row in logs_of(inputs, config.level) for x in row)
    entropy = fmean(inputs.entropy.detach().tolist())
    shared = 0.5 * fmean(error) + config.kl_coef * kl - config.entropy_coef * entropy
    return policy_loss_of(inputs, config) + shared


def ragged_factors(n: int, width: int) -> torch.Tensor:
    """bool (n, width), decision i has its first 1 + i % width factors."""
    return torch.arange(width) <= torch.arange(n)[:, None] % width


@each_config
def test_equals_the_oracle(config: RatioConfig) -> None:
    inputs = make_inputs()
    output = config.loss(inputs)
    assert output.metrics["policy_loss"].item() == pytest.approx(policy_loss_of(inputs, config), abs=1e-12)
    assert output.loss.item() == pytest.approx(loss_of(inputs, config), abs=1e-12)


@each_config
@pytest.mark.parametrize("level", ["token", "chunk"])
def test_equals_the_oracle_for_tokens_of_which_some_do_not_exist(config: RatioConfig, level: Any) -> None:
    inputs = replace(make_inputs(factors=6), factors=ragged_factors(12, 6))
    config = replace(config, level=level)
    assert config.loss(inputs).loss.item() == pytest.approx(loss_of(inputs, config), abs=1e-12)


def test_gipo_by_hand() -> None:
    # ρ = 2: log ρ = 0.693147, ω = exp(−½·0.480453) = 0.786450, −ω·ρ·Â = −0.786450·2·3
    loss = GIPOConfig(sigma=1.0, kl_coef=0.0).loss(one(math.log(2.0), 3.0)).loss
    assert loss.item() == pytest.approx(-4.718699, abs=1e-6)
    # σ = 0.5: ω = exp(−½·(1.386294)²) = 0.382546
    config = GIPOConfig(sigma=0.5, kl_coef=0.0)
    assert config.loss(one(math.log(2.0), -3.0)).loss.item() == pytest.approx(2.295277, abs=1e-6)


@pytest.mark.parametrize(
    ("rho", "advantage", "expected", "moves"),
    [
        (2.0, 1.0, -1.28, False),  # clipped above
        (2.0, -1.0, 2.0, True),  # a bad action that became likelier is never clipped
        (0.5, -1.0, 0.8, False),  # clipped below
        (0.5, 1.0, -0.5, True),
        (1.1, 1.0, -1.1, True),
    ],
)
def test_ppo_by_hand(rho: float, advantage: float, expected: float, moves: bool) -> None:
    inputs = one(math.log(rho), advantage)
    output = PPOConfig().loss(inputs)
    assert output.loss.item() == pytest.approx(expected, abs=1e-12)
    assert (gradient(inputs, output.loss).abs().item() > 0) is moves
    assert output.metrics["low_weight"].item() == float(not moves)


@pytest.mark.parametrize("level", ["token", "chunk"])
def test_gipo_gradient_is_that_of_importance_sampling_with_the_weight_held_still(level: Any) -> None:
    """−E[ω ρ Â ∇log π], with ω a constant."""
    inputs = make_inputs(spread=0.6)
    config = GIPOConfig(level=level, sigma=0.7, kl_coef=0.0)
    got = gradient(inputs, config.loss(inputs).loss)
    advantage = inputs.advantage.numpy()[:, None]
    new = inputs.log_prob_new.detach().numpy()
    logs = np.array(grouped(new - inputs.log_prob_old.numpy(), level))
    weight = np.exp(-0.5 * (logs / 0.7) ** 2)
    formula = np.broadcast_to(-weight * np.exp(logs) * advantage / logs.size, new.shape)
    np.testing.assert_allclose(got.numpy(), formula, atol=1e-12)


@each_algorithm
@pytest.mark.parametrize("level", ["token", "chunk"])
def test_on_policy_all_are_the_plain_policy_gradient(config: RatioConfig, level: Any) -> None:
    """At ρ = 1 the gradient is −E[Â ∇log π]: of the chunk, or of its factors one by one (1/L of it)."""
    inputs = make_inputs(spread=0.0)
    config = replace(config, level=level, kl_coef=0.3)  # the KL has no gradient there
    terms = inputs.log_prob_new.mean(1) if level == "token" else inputs.log_prob_new.sum(1)
    expected = gradient(inputs, -(terms * inputs.advantage).mean())
    torch.testing.assert_close(gradient(inputs, config.loss(inputs).loss), expected)


@each_config
def test_only_the_value_term_moves_the_critic(config: RatioConfig) -> None:
    inputs = make_inputs()
    loss = config.loss(inputs).loss
    (slope,) = torch.autograd.grad(loss, inputs.value)
    torch.testing.assert_close(slope, (inputs.value - inputs.returns).detach() / 12)


def test_an_unused_entropy_may_be_undefined() -> None:
    inputs = make_inputs(entropy=torch.full((12,), torch.nan, dtype=torch.float64))
    assert GIPOConfig().loss(inputs).loss.isfinite()


@each_config
def test_absurd_ratios_stay_finite_in_float32(config: RatioConfig) -> None:
    new = torch.tensor([[300.0], [-300.0], [LOG_RATIO_CLAMP], [0.0]], requires_grad=True)
    ones = torch.ones(4)
    inputs = LossInputs(
        log_prob_new=new,
        log_prob_old=torch.zeros(4, 1),
        advantage=torch.tensor([1.0, -1.0, 1.0, 1.0]),
        value=ones,
        returns=ones,
        entropy=ones,
    )
    output = config.loss(inputs)
    assert output.loss.isfinite() and all(m.isfinite() for m in output.metrics.values())
    assert gradient(inputs, output.loss).isfinite().all()


def test_metrics_are_detached_scalars_under_the_same_names() -> None:
    outputs = [config.loss(make_inputs()) for config in CONFIGS]
    assert len({tuple(sorted(o.metrics)) for o in outputs}) == 1
    for output in outputs:
        assert output.loss.requires_grad
        for metric in output.metrics.values():
            assert metric.shape == () and metric.is_floating_point() and not metric.requires_grad
