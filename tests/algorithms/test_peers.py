# SPDX-License-Identifier: Apache-2.0
"""Decoupled PPO, SAPO, importance sampling and AWR by hand: value, gradient weight, what is masked."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import (
    AlgorithmConfig,
    AWRConfig,
    DecoupledConfig,
    GIPOConfig,
    ImportanceConfig,
    PPOConfig,
    SAPOConfig,
)
from tests.algorithms.inputs import gradient, make_inputs, one

RATIOS = [0.01, 0.5, 0.9, 1.0, 1.1, 2.0, 8.0]


def pull(config: AlgorithmConfig, rho: float, advantage: float = 1.0, proximal: float | None = None) -> float:
    """−∂L/∂log π of one decision, at π/μ = `rho` and π_prox/μ = `proximal`."""
    inputs = one(math.log(rho), advantage, None if proximal is None else math.log(proximal))
    return -gradient(inputs, config.loss(inputs).loss).item()


# ---- decoupled PPO


@pytest.mark.parametrize(
    ("rho", "proximal", "advantage", "expected", "kept"),
    [
        # r = π/π_prox, w = π_prox/μ, clip range 0.8 to 1.28
        (1.5, 1.5, 2.0, -3.0, True),  # r = 1: −1.5·2
        (1.5, 1.25, 2.0, -3.0, True),  # r = 1.2: −1.25·1.2·2
        (1.5, 1.0, 2.0, -2.56, False),  # r = 1.5 is clipped: −1.28·2
        (1.5, 1.0, -2.0, 3.0, True),  # but not when the sample was bad
        (0.5, 1.0, -2.0, 1.6, False),  # r = 0.5 is clipped: 0.8·2
        (2.4, 2.0, 1.0, -2.4, True),  # w = 2 is not above the cap
        (2.4, 2.1, 1.0, 0.0, False),  # w = 2.1 is masked
        (0.3, 0.3, 1.0, -0.3, True),  # stale, and still a sample: PPO's range knows nothing of w
    ],
)
def test_decoupled_by_hand(
    rho: float, proximal: float, advantage: float, expected: float, kept: bool
) -> None:
    inputs = one(math.log(rho), advantage, math.log(proximal))
    output = DecoupledConfig().loss(inputs)
    assert output.loss.item() == pytest.approx(expected, abs=1e-12)
    # What is kept has the gradient of importance sampling.
    assert pull(DecoupledConfig(), rho, advantage, proximal) == pytest.approx(rho * advantage * kept)
    assert output.metrics["low_weight"].item() == float(not kept)


def test_decoupled_with_its_own_proximal_weights_is_the_weighted_policy_gradient() -> None:
    """−E[w Â ∇log π]: what `proximal_every` 1 comes to."""
    inputs = make_inputs(spread=0.5)
    inputs = make_inputs(spread=0.5, log_prob_proximal=inputs.log_prob_new.detach())
    w = (inputs.log_prob_new - inputs.log_prob_old).detach().exp()
    w = torch.where(w > 2.0, 0.0, w)
    assert (w == 0.0).any()
    expected = gradient(inputs, -(w * inputs.log_prob_new * inputs.advantage[:, None]).mean())
    torch.testing.assert_close(gradient(inputs, DecoupledConfig().loss(inputs).loss), expected)


def test_decoupled_from_the_behaviour_policy_is_ppo() -> None:
    inputs = make_inputs(spread=0.5)
    inputs = make_inputs(spread=0.5, log_prob_proximal=inputs.log_prob_old)
    expected, got = PPOConfig().loss(inputs), DecoupledConfig().loss(inputs)
    assert got.metrics["clip_fraction"] > 0
    for name, metric in expected.metrics.items():
        torch.testing.assert_close(got.metrics[name], metric, msg=name)


def test_the_proximal_policy_gets_no_gradient() -> None:
    inputs = make_inputs()
    assert inputs.log_prob_proximal is not None
    proximal = inputs.log_prob_proximal.clone().requires_grad_()
    DecoupledConfig().loss(make_inputs(log_prob_proximal=proximal)).loss.backward()
    assert proximal.grad is None


def test_the_clip_fraction_of_decoupled_ppo_is_of_what_it_clips() -> None:
    near = DecoupledConfig().loss(one(math.log(1.9), 1.0, math.log(1.8))).metrics
    far = DecoupledConfig().loss(one(math.log(1.9), 1.0, 0.0)).metrics
    assert near["clip_fraction"].item() == 0.0 and far["clip_fraction"].item() == 1.0
    assert near["ratio_max_dev"].item() == pytest.approx(0.9)  # the ratio to μ, in both
    assert far["ratio_max_dev"].item() == pytest.approx(0.9)


def test_decoupled_needs_proximal_log_probs() -> None:
    with pytest.raises(ValueError, match="log_prob_proximal is needed"):
        DecoupledConfig().loss(make_inputs(log_prob_proximal=None))


def test_only_decoupled_asks_for_proximal_weights() -> None:
    assert DecoupledConfig(proximal_every=7).proximal_updates == 7
    others = (GIPOConfig, PPOConfig, SAPOConfig, ImportanceConfig, AWRConfig)
    assert {config().proximal_updates for config in others} == {0}


# ---- SAPO


def test_sapo_by_hand() -> None:
    # ρ = 2, τ = 1: 4·σ(1) = 4·0.731059; times Â = 3
    assert SAPOConfig().loss(one(math.log(2.0), 3.0)).loss.item() == pytest.approx(-8.772703, abs=1e-6)
    # τ₋ = 2: (4/2)·σ(2) = 2·0.880797; times Â = −3
    config = SAPOConfig(tau_negative=2.0)
    assert config.loss(one(math.log(2.0), -3.0)).loss.item() == pytest.approx(5.284782, abs=1e-6)


@pytest.mark.parametrize("tau", [0.5, 1.0, 4.0])
@pytest.mark.parametrize("advantage", [2.0, -2.0])
def test_sapo_gradient_weight(tau: float, advantage: float) -> None:
    """4p(1 − p)·ρ, which is ρ at ρ = 1 whatever the temperature."""
    config = SAPOConfig(tau_positive=tau, tau_negative=tau)
    for rho in RATIOS:
        p = 1 / (1 + math.exp(-tau * (rho - 1)))
        assert pull(config, rho, advantage) == pytest.approx(4 * p * (1 - p) * rho * advantage, rel=1e-12)
    assert pull(config, 1.0, advantage) == pytest.approx(advantage)


def test_sapo_measures_its_gate() -> None:
    metrics = SAPOConfig(tau_positive=1.0).loss(one(math.log(5.0), 1.0)).metrics
    assert metrics["low_weight"].item() == 1.0  # 4·σ(4)·σ(−4) = 0.07
    assert SAPOConfig().loss(one(math.log(4.0), 1.0)).metrics["low_weight"].item() == 0.0  # 0.18


# ---- importance sampling


def test_importance_by_hand() -> None:
    assert ImportanceConfig().loss(one(math.log(4.0), 3.0)).loss.item() == pytest.approx(-12.0)
    assert ImportanceConfig(cap=1.5).loss(one(math.log(4.0), 3.0)).loss.item() == pytest.approx(-4.5)


@pytest.mark.parametrize("cap", [None, 1.0, 2.0])
@pytest.mark.parametrize("advantage", [2.0, -2.0])
def test_importance_gradient_weight(cap: float | None, advantage: float) -> None:
    """min(ρ, cap): truncated samples keep the cap, in value and in gradient."""
    config = ImportanceConfig(cap=cap)
    for rho in RATIOS:
        expected = min(rho, math.inf if cap is None else cap) * advantage
        assert pull(config, rho, advantage) == pytest.approx(expected, rel=1e-12)
        loss = config.loss(one(math.log(rho), advantage)).loss.item()
        assert -loss == pytest.approx(expected, rel=1e-12)


def test_a_cap_reaches_samples_beyond_the_clamp() -> None:
    assert pull(ImportanceConfig(cap=2.0), math.exp(40.0)) == pytest.approx(2.0)
    assert pull(ImportanceConfig(), math.exp(40.0)) == 0.0


# ---- AWR


def test_awr_by_hand() -> None:
    # −min(exp(Â/β), cap)·log π, with log π = −0.5: exp(2/1) = 7.389056
    assert AWRConfig().loss(one(-0.5, 2.0)).loss.item() == pytest.approx(3.694528, abs=1e-6)
    assert AWRConfig(beta=0.5).loss(one(-0.5, 2.0)).loss.item() == pytest.approx(10.0)  # e⁴ is above 20
    assert AWRConfig(beta=0.5).loss(one(-0.5, -2.0)).loss.item() == pytest.approx(0.5 * math.exp(-4))


def test_awr_gradient_weight_does_not_depend_on_the_ratio() -> None:
    for advantage in (-3.0, -0.1, 0.0, 1.0, 2.9, 3.1, 1e4):
        expected = min(math.exp(min(advantage, 10.0)), 20.0)
        for rho in RATIOS:
            assert pull(AWRConfig(), rho, advantage) == pytest.approx(expected)


def test_awr_with_an_infinite_temperature_is_behaviour_cloning() -> None:
    inputs = make_inputs()
    for level, terms in (("action", inputs.log_prob_new.mean(1)), ("chunk", inputs.log_prob_new.sum(1))):
        config = AWRConfig(beta=math.inf, level=level)  # type: ignore[arg-type]
        expected = gradient(inputs, -terms.mean())
        torch.testing.assert_close(gradient(inputs, config.loss(inputs).loss), expected)


def test_awr_measures_its_own_weights() -> None:
    advantage = torch.tensor([math.log(3.0), 0.0, -3.0], dtype=torch.float64)
    inputs = make_inputs(n=3, factors=1, advantage=advantage)
    metrics = AWRConfig().loss(inputs).metrics
    weights = np.array([3.0, 1.0, math.exp(-3.0)])
    assert metrics["ess"].item() == pytest.approx(weights.sum() ** 2 / (3 * (weights**2).sum()))
    assert metrics["low_weight"].item() == pytest.approx(1 / 3)
