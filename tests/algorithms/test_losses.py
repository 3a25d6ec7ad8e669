# SPDX-License-Identifier: Apache-2.0
"""GIPO and PPO: against the oracle, by hand, and what holds for both; the KL and logged numbers by hand."""

import math
from dataclasses import replace
from statistics import fmean
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import GIPOConfig, LossInputs, LossOutput, PPOConfig, RatioConfig
from accerl_lerobot.algorithms.objective import (
    KL_LINEAR_ABOVE,
    LOG_RATIO_CLAMP,
    kl_from_behaviour,
    lag_metrics,
    sample_metrics,
)

CONFIGS: list[RatioConfig] = [
    GIPOConfig(level="token", sigma=0.5, entropy_coef=0.01),
    GIPOConfig(level="chunk", sigma=math.inf, kl_coef=0.0),
    PPOConfig(level="token", kl_coef=0.2),
    PPOConfig(level="chunk", clip_low=0.1, clip_high=0.4, entropy_coef=0.01),
]
each_config = pytest.mark.parametrize("config", CONFIGS, ids=lambda c: f"{c.type}-{c.level}")


def make_inputs(n: int = 12, factors: int = 3, spread: float = 0.4, **replace: Any) -> LossInputs:
    """Random float64 batch; `spread` is the standard deviation of log ρ per factor."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    old = normal(n, factors)
    fields: dict[str, Any] = {
        "log_prob_old": old,
        "log_prob_new": (old + spread * normal(n, factors)).requires_grad_(),
        "advantage": normal(n),
        "value": normal(n).requires_grad_(),
        "returns": normal(n),
        "entropy": normal(n).abs().requires_grad_(),
        "factors": torch.ones(n, factors, dtype=torch.bool),
    }
    return LossInputs(**{**fields, **replace})


def gradient(inputs: LossInputs, loss: torch.Tensor) -> torch.Tensor:
    """∂ loss / ∂ log π, (N, L)."""
    (result,) = torch.autograd.grad(loss, inputs.log_prob_new, retain_graph=True)
    return result


def measured(output: LossOutput) -> dict[str, torch.Tensor]:
    return output.means | sample_metrics(output.samples)


def logs_of(inputs: LossInputs, level: str) -> list[list[float]]:
    """For each decision the log of π over μ of each of its ratios, without factors that do not exist."""
    logs = inputs.log_prob_new.detach() - inputs.log_prob_old
    rows = [row[exist].tolist() for row, exist in zip(logs, inputs.factors, strict=True)]
    return [[sum(row)] for row in rows] if level == "chunk" else rows


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


@each_config
@pytest.mark.parametrize("existing", [1, 6], ids=["some do not exist", "all"])
def test_equals_the_oracle(config: RatioConfig, existing: int) -> None:
    factors = torch.arange(6) < existing + torch.arange(12)[:, None] % 6
    inputs = replace(make_inputs(factors=6), factors=factors)
    output = config.loss(inputs)
    assert measured(output)["policy_loss"].item() == pytest.approx(policy_loss_of(inputs, config), abs=1e-12)
    assert output.loss.item() == pytest.approx(loss_of(inputs, config), abs=1e-12)


def test_ppo_by_hand() -> None:
    """A bad action that became likelier is never clipped."""
    rho, advantage = torch.tensor(
        [[2.0, 2.0, 0.5, 0.5, 1.1], [1.0, -1.0, -1.0, 1.0, 1.0]], dtype=torch.float64
    )
    terms, clipped = [1.28, -2.0, -0.8, 0.5, 1.1], torch.tensor([True, False, True, False, False])
    new = rho.log()[:, None].requires_grad_()
    inputs = make_inputs(
        5, 1, log_prob_old=torch.zeros(5, 1, dtype=torch.float64), log_prob_new=new, advantage=advantage
    )
    output = PPOConfig().loss(inputs)
    assert measured(output)["policy_loss"].item() == pytest.approx(-fmean(terms), abs=1e-12)
    slope = (-rho * advantage / 5).masked_fill(clipped, 0.0)
    torch.testing.assert_close(gradient(inputs, output.loss)[:, 0], slope)
    assert measured(output)["low_weight"].item() == pytest.approx(0.4)


@pytest.mark.parametrize("level", ["token", "chunk"])
def test_gipo_gradient_is_that_of_importance_sampling_with_the_weight_held_still(level: Any) -> None:
    """−E[ω ρ Â ∇log π], with ω a constant."""
    inputs = make_inputs(spread=0.6)
    config = GIPOConfig(level=level, sigma=0.7, kl_coef=0.0)
    got = gradient(inputs, config.loss(inputs).loss).numpy()
    logs = np.array(logs_of(inputs, level))
    weight = np.exp(-0.5 * (logs / 0.7) ** 2)
    formula = -weight * np.exp(logs) * inputs.advantage.numpy()[:, None] / logs.size
    np.testing.assert_allclose(got, np.broadcast_to(formula, got.shape), atol=1e-12)


@pytest.mark.parametrize("config", [GIPOConfig(), PPOConfig()], ids=lambda c: c.type)
@pytest.mark.parametrize("level", ["token", "chunk"])
def test_on_policy_all_are_the_plain_policy_gradient(config: RatioConfig, level: Any) -> None:
    """At ρ = 1 the gradient is −E[Â ∇log π]: of the chunk, or of its factors one by one (1/L of it)."""
    inputs = make_inputs(spread=0.0)
    config = replace(config, level=level, kl_coef=0.3)  # the KL has no gradient there
    terms = inputs.log_prob_new.mean(1) if level == "token" else inputs.log_prob_new.sum(1)
    expected = gradient(inputs, -(terms * inputs.advantage).mean())
    output = config.loss(inputs)
    torch.testing.assert_close(gradient(inputs, output.loss), expected)
    metrics = {name: metric.item() for name, metric in measured(output).items()}
    for name in ("approx_kl", "kl", "clip_fraction", "low_weight", "ratio_max_dev"):
        assert metrics[name] == 0.0, name
    assert metrics["ess"] == pytest.approx(1.0)


def test_an_unused_entropy_may_be_undefined() -> None:
    inputs = make_inputs(entropy=torch.full((12,), torch.nan, dtype=torch.float64))
    assert GIPOConfig().loss(inputs).loss.isfinite()


@each_config
def test_absurd_ratios_stay_finite_in_float32(config: RatioConfig) -> None:
    new = torch.tensor([[300.0], [-300.0], [LOG_RATIO_CLAMP], [0.0]], requires_grad=True)
    advantage = torch.tensor([1.0, -1.0, 1.0, 1.0])
    inputs = make_inputs(4, 1, log_prob_new=new, log_prob_old=torch.zeros(4, 1), advantage=advantage)
    output = config.loss(inputs)
    assert output.loss.isfinite() and all(m.isfinite() for m in measured(output).values())
    assert gradient(inputs, output.loss).isfinite().all()


@each_config
def test_what_does_not_exist_is_never_looked_at(config: RatioConfig) -> None:
    """NaN there changes neither loss nor metrics nor gradient."""
    factors = torch.arange(4) < torch.tensor([4, 2, 3, 1, 4, 2, 3])[:, None]
    clean = replace(make_inputs(n=7, factors=4), factors=factors)
    names = ("log_prob_new", "log_prob_old")
    holes = {n: getattr(clean, n).masked_fill(~factors, torch.nan) for n in names}
    dirty = replace(clean, **holes)
    expected, got = config.loss(clean), config.loss(dirty)
    torch.testing.assert_close(got.loss, expected.loss)
    for name, metric in measured(expected).items():
        torch.testing.assert_close(measured(got)[name], metric, msg=name)
    slope = gradient(dirty, got.loss)
    torch.testing.assert_close(slope, gradient(clean, expected.loss))
    assert (slope[~factors] == 0).all() and (slope[factors] != 0).any()


def test_kl_pulls_back_from_both_sides_with_a_bounded_slope() -> None:
    far = [-50.0, -1.0, 0.0, 1.0, KL_LINEAR_ABOVE, 50.0]
    logs = torch.tensor(far, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(kl_from_behaviour(logs).sum(), logs)
    edge = math.expm1(KL_LINEAR_ABOVE)
    expected = [-1.0, math.expm1(-1.0), 0.0, math.expm1(1.0), edge, edge]
    np.testing.assert_allclose(slope.numpy(), expected, atol=1e-12)


def metrics_of(**given: list[Any]) -> dict[str, float]:
    """Metrics of four decisions with a ratio each."""
    columns = {"log_ratio": [0.0] * 4, "weight": [1.0] * 4, "keep": [True] * 4}
    columns |= {"value": [0.0] * 4, "returns": [1.0] * 4} | given
    samples = torch.tensor(list(columns.values()), dtype=torch.float64).T
    return {name: metric.item() for name, metric in sample_metrics(samples).items()}


@pytest.mark.parametrize(
    ("weight", "expected"),
    [([1.0] * 4, 1.0), ([1.0, 0, 0, 0], 0.25), ([3.0, 1, 3, 1], 16 / 20), ([0.0] * 4, 0.0)],
)
def test_effective_sample_size(weight: list[float], expected: float) -> None:
    assert metrics_of(weight=weight)["ess"] == pytest.approx(expected)


def test_shares_are_of_the_ratios_that_exist_and_lag_is_of_decisions() -> None:
    logs = [math.log(rho) for rho in (0.7, 0.9, 1.1, 1.4)]
    found = metrics_of(log_ratio=logs, weight=[0.0, 0.05, 1.0, 1.0], keep=[True, True, True, False])
    assert (found["clip_fraction"], found["low_weight"]) == pytest.approx((1 / 3, 2 / 3))
    assert found["approx_kl"] == pytest.approx(np.mean([math.exp(x) - 1 - x for x in logs[:3]]), abs=1e-6)
    assert lag_metrics(np.array([10, 9, 7]), 12) == pytest.approx({"lag_mean": 10 / 3, "lag_max": 5.0})


@pytest.mark.parametrize(
    ("value", "expected"), [([0.0, 1, 2, 3], 1.0), ([5.0, 6, 7, 8], 1.0), ([0.0, -1, -2, -3], -3.0)]
)
def test_explained_variance(value: list[float], expected: float) -> None:
    """A constant offset is not variance."""
    assert metrics_of(value=value, returns=[0.0, 1, 2, 3])["explained_variance"] == expected
    assert metrics_of(value=value)["explained_variance"] == 0.0
