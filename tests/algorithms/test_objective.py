# SPDX-License-Identifier: Apache-2.0
"""Factors that do not exist, the KL, and each logged number by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import AlgorithmConfig, GIPOConfig, PPOConfig, RatioConfig
from accerl_lerobot.algorithms.objective import (
    KL_LINEAR_ABOVE,
    kl_from_behaviour,
    lag_metrics,
    sample_metrics,
)
from tests.algorithms.inputs import gradient, make_inputs
from tests.runs import ALGORITHMS

each_level = pytest.mark.parametrize("level", ["token", "chunk"])
each_algorithm = pytest.mark.parametrize(
    "config", [AlgorithmConfig.get_choice_class(name)() for name in ALGORITHMS], ids=str
)


@each_algorithm
@each_level
def test_what_does_not_exist_is_never_looked_at(config: RatioConfig, level: Any) -> None:
    """NaN there changes neither loss nor metrics nor gradient."""
    config = replace(config, level=level)
    factors = torch.arange(4) < torch.tensor([4, 2, 3, 1, 4, 2, 3])[:, None]
    clean = replace(make_inputs(n=7, factors=4), factors=factors)
    names = ("log_prob_new", "log_prob_old")
    holes = {n: getattr(clean, n).detach().masked_fill(~factors, torch.nan) for n in names}
    holes["log_prob_new"].requires_grad_()
    dirty = replace(clean, **holes)
    expected, got = config.loss(clean), config.loss(dirty)
    torch.testing.assert_close(got.loss, expected.loss)
    for name, metric in expected.metrics.items():
        torch.testing.assert_close(got.metrics[name], metric, msg=name)
    slope = gradient(dirty, got.loss)
    torch.testing.assert_close(slope, gradient(clean, expected.loss))
    assert (slope[~factors] == 0).all() and (slope[factors] != 0).any()


def test_kl_estimates_behaviour_to_policy_in_value_and_gradient() -> None:
    """μ = N(0, 1), π = N(m, s): samples, KL(μ‖π) = log s + (1 + m²)/(2s²) − ½ and its slope m/s² in m."""
    noise = torch.randn(200_000, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    mean = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    s = 1.2
    policy = torch.distributions.Normal(mean, s)
    logs = policy.log_prob(noise) - torch.distributions.Normal(0.0, 1.0).log_prob(noise)
    kl = kl_from_behaviour(logs).mean()
    assert kl.item() == pytest.approx(math.log(s) + (1 + 0.09) / (2 * s * s) - 0.5, rel=0.02)
    (slope,) = torch.autograd.grad(kl, mean)
    assert slope.item() == pytest.approx(0.3 / (s * s), rel=0.02)


def test_kl_pulls_back_from_both_sides_with_a_bounded_slope() -> None:
    far = [-50.0, -1.0, 0.0, 1.0, KL_LINEAR_ABOVE, 50.0]
    logs = torch.tensor(far, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(kl_from_behaviour(logs).sum(), logs)
    edge = math.expm1(KL_LINEAR_ABOVE)
    expected = [-1.0, math.expm1(-1.0), 0.0, math.expm1(1.0), edge, edge]
    np.testing.assert_allclose(slope.numpy(), expected, atol=1e-12)


def metrics_of(
    log_ratio: list[float] = [0.0] * 4,
    weight: list[float] = [1.0] * 4,
    value: list[float] = [0.0] * 4,
    returns: list[float] = [1.0] * 4,
    keep: list[bool] = [True] * 4,
    clip: tuple[float, float] = (0.2, 0.28),
) -> dict[str, float]:
    """Metrics of four decisions with a ratio each."""
    samples = torch.tensor([log_ratio, weight, keep, value, returns], dtype=torch.float64).T
    return {name: metric.item() for name, metric in sample_metrics(samples, clip).items()}


@pytest.mark.parametrize(
    ("weight", "expected"),
    [([1.0] * 4, 1.0), ([1.0, 0, 0, 0], 0.25), ([3.0, 1, 3, 1], 16 / 20), ([0.0] * 4, 0.0)],
)
def test_effective_sample_size(weight: list[float], expected: float) -> None:
    assert metrics_of(weight=weight)["ess"] == pytest.approx(expected)


def test_shares_and_quantiles_are_of_the_ratios_that_exist() -> None:
    logs = [math.log(rho) for rho in (0.7, 0.9, 1.2, 1.4)]
    found = metrics_of(logs, weight=[0.0, 0.05, 1.0, 1.0])
    assert (found["clip_fraction"], found["low_weight"]) == (0.5, 0.5)
    assert found["log_ratio_p05"] == pytest.approx(np.quantile(logs, 0.05))
    found = metrics_of(logs, weight=[0.0, 0.05, 1.0, 1.0], keep=[True, True, True, False])
    assert (found["clip_fraction"], found["low_weight"]) == pytest.approx((1 / 3, 2 / 3))
    assert found["log_ratio_p95"] == pytest.approx(np.quantile(logs[:3], 0.95))
    assert found["approx_kl"] == pytest.approx(np.mean([math.exp(x) - 1 - x for x in logs[:3]]), abs=1e-6)


@pytest.mark.parametrize(
    ("value", "expected"),
    # A constant offset is not variance.
    [([0.0, 1, 2, 3], 1.0), ([5.0, 6, 7, 8], 1.0), ([0.0] * 4, 0.0), ([0.0, -1, -2, -3], -3.0)],
)
def test_explained_variance(value: list[float], expected: float) -> None:
    assert metrics_of(value=value, returns=[0.0, 1, 2, 3])["explained_variance"] == expected
    assert metrics_of(value=value)["explained_variance"] == 0.0


def test_lag() -> None:
    lag = lag_metrics(torch.tensor([10, 9, 7]), 12)
    assert lag["lag_mean"] == pytest.approx((2 + 3 + 5) / 3) and lag["lag_max"] == 5.0
    assert lag["lag_p95"] == pytest.approx(4.8)
    assert lag_metrics(torch.tensor([3, 3]), 3)["lag_max"] == 0.0


@pytest.mark.parametrize("config", [GIPOConfig(), PPOConfig()], ids=["gipo", "ppo"])
def test_on_policy_batches_look_on_policy(config: GIPOConfig | PPOConfig) -> None:
    metrics = {k: v.item() for k, v in config.loss(make_inputs(spread=0.0)).metrics.items()}
    for name in ("approx_kl", "kl", "clip_fraction", "low_weight", "ratio_max_dev", "log_ratio_p50"):
        assert metrics[name] == 0.0, name
    assert metrics["ess"] == pytest.approx(1.0)
