# SPDX-License-Identifier: Apache-2.0
"""The two KL penalties against closed forms: value, gradient, bounds."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import GIPOConfig
from accerl_lerobot.algorithms.ratio import (
    KL_LINEAR_ABOVE,
    LOG_RATIO_CLAMP,
    kl_from_behaviour,
    kl_to_reference,
)
from tests.algorithms.inputs import make_inputs


def normal(mean: float | torch.Tensor, std: float) -> torch.distributions.Normal:
    return torch.distributions.Normal(torch.as_tensor(mean, dtype=torch.float64), std)


def test_kl_estimates_behaviour_to_policy_in_value_and_gradient() -> None:
    """μ = N(0, 1), π = N(m, s): samples of μ, KL(μ‖π) = log s + (1 + m²)/(2s²) − ½ and its slope m/s² in
    m."""
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


def test_kl_to_the_reference_is_estimated_from_samples_of_neither() -> None:
    """μ = N(0, 1), π = N(m, 0.8), π_ref = N(0.7, 0.9): KL(π‖π_ref) and its slope in m, from samples of μ."""
    noise = torch.randn(400_000, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    mean = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    policy, reference = normal(mean, 0.8), normal(0.7, 0.9)
    logs = policy.log_prob(noise) - normal(0.0, 1.0).log_prob(noise)
    apart = policy.log_prob(noise) - reference.log_prob(noise)
    kl = kl_to_reference(logs, apart).mean()
    exact = torch.distributions.kl_divergence(policy, reference)
    assert kl.item() == pytest.approx(exact.item(), rel=0.01)
    (slope,) = torch.autograd.grad(kl, mean)
    assert slope.item() == pytest.approx((0.3 - 0.7) / 0.9**2, rel=0.01)
    # Differentiating k3 alone would give the slope of KL(π_ref‖π), (m − 0.7)/0.8², and ignoring that the
    # samples are of μ another one still.
    assert abs((0.3 - 0.7) / 0.8**2 - slope.item()) > 0.1


def test_kl_to_the_reference_by_hand() -> None:
    # ρ = 2, y = log π/π_ref = log 3: 2·(1/3 − 1 + 1.098612) = 0.863891, and the slope is 2·1.098612
    logs = torch.tensor([math.log(2.0)], dtype=torch.float64)
    apart = torch.tensor([math.log(3.0)], dtype=torch.float64, requires_grad=True)
    kl = kl_to_reference(logs, apart)
    assert kl.item() == pytest.approx(0.863891, abs=1e-6)
    (slope,) = torch.autograd.grad(kl, apart)
    assert slope.item() == pytest.approx(2.197225, abs=1e-6)


def test_kl_to_the_reference_pulls_back_from_both_sides_with_a_bounded_slope() -> None:
    logs = torch.tensor([0.0, 0.0, 0.0, 50.0, 50.0, -50.0], dtype=torch.float64)
    far = [-50.0, 0.0, 50.0, 2.0, -2.0, 2.0]
    apart = torch.tensor(far, dtype=torch.float64, requires_grad=True)
    kl = kl_to_reference(logs, apart)
    (slope,) = torch.autograd.grad(kl.sum(), apart)
    edge = math.exp(KL_LINEAR_ABOVE)
    expected = [-LOG_RATIO_CLAMP, 0.0, LOG_RATIO_CLAMP, 2 * edge, -2 * edge, 2 * math.exp(-LOG_RATIO_CLAMP)]
    np.testing.assert_allclose(slope.numpy(), expected, rtol=1e-12)
    assert (kl.detach() >= 0).all() and kl.isfinite().all()


def test_the_logged_kl_to_the_reference_has_no_jump_and_is_never_negative() -> None:
    logs = torch.linspace(-8, 8, 161, dtype=torch.float64)[:, None]
    apart = torch.linspace(-30, 30, 6001, dtype=torch.float64)[None].expand(161, -1)
    kl = kl_to_reference(logs, apart)
    assert (kl >= -1e-12).all()
    steps = kl.diff(dim=1).abs()
    assert steps.max() <= 2 * math.exp(KL_LINEAR_ABOVE) * 0.01 + 1e-9


def test_the_reference_needs_its_log_probs() -> None:
    with pytest.raises(ValueError, match="log_prob_reference is needed"):
        GIPOConfig(reference_coef=0.1).loss(make_inputs(log_prob_reference=None))
    assert GIPOConfig().loss(make_inputs(log_prob_reference=None)).loss.isfinite()


def test_an_unused_reference_changes_nothing() -> None:
    expected = GIPOConfig().loss(make_inputs(log_prob_reference=None))
    assert torch.equal(GIPOConfig().loss(make_inputs()).loss, expected.loss)
