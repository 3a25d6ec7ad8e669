# SPDX-License-Identifier: Apache-2.0
"""Each logged number against a hand-computed one."""

import math

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import GIPOConfig, PPOConfig
from accerl_lerobot.algorithms.diagnostics import (
    approx_kl,
    clip_fraction,
    ess_share,
    explained_variance,
    lag_metrics,
    quantiles,
    share_below,
)
from tests.algorithms.inputs import make_inputs


def test_effective_sample_size() -> None:
    assert ess_share(torch.ones(4, 1)).item() == 1.0
    assert ess_share(torch.tensor([[1.0], [0.0], [0.0], [0.0]])).item() == 0.25
    assert ess_share(torch.tensor([[3.0], [1.0]])).item() == pytest.approx(16 / 20)
    assert ess_share(torch.zeros(4, 1)).item() == 0.0
    mask = torch.tensor([[True], [True], [False]])
    assert ess_share(torch.tensor([[3.0], [1.0], [9.0]]), mask).item() == pytest.approx(16 / 20)


def test_approx_kl_is_zero_only_on_policy() -> None:
    assert approx_kl(torch.zeros(3, 2)).item() == 0.0
    assert approx_kl(torch.tensor([[math.log(2.0)]])).item() == pytest.approx(1 - math.log(2.0))


def test_shares() -> None:
    rho = torch.tensor([[0.7], [0.9], [1.2], [1.4]])
    assert clip_fraction(rho, 0.2, 0.28).item() == 0.5
    assert share_below(rho, 1.0).item() == 0.5
    exists = torch.tensor([[True], [True], [True], [False]])
    assert share_below(rho, 1.0, exists).item() == pytest.approx(2 / 3)


def test_explained_variance() -> None:
    returns = torch.tensor([0.0, 1.0, 2.0, 3.0])
    assert explained_variance(returns, returns).item() == 1.0
    assert explained_variance(returns + 5.0, returns).item() == 1.0  # a constant offset is not variance
    assert explained_variance(torch.zeros(4), returns).item() == 0.0
    assert explained_variance(-returns, returns).item() == -3.0
    assert explained_variance(returns, torch.ones(4)).item() == 0.0


def test_quantiles_skip_what_does_not_exist() -> None:
    x = torch.randn(9, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    mask = (torch.arange(9) < 6)[:, None].expand(9, 4)
    got = quantiles(x, {"q": 0.3}, mask)["q"].item()
    assert got == pytest.approx(np.quantile(x[:6].numpy(), 0.3))


def test_lag() -> None:
    lag = {k: v.item() for k, v in lag_metrics(torch.tensor([10, 9, 7]), 12).items()}
    assert lag["lag_mean"] == pytest.approx((2 + 3 + 5) / 3) and lag["lag_max"] == 5.0
    assert lag["lag_p95"] == pytest.approx(4.8)
    assert lag_metrics(torch.tensor([3, 3]), 3)["lag_max"].item() == 0.0


@pytest.mark.parametrize("config", [GIPOConfig(), PPOConfig()], ids=["gipo", "ppo"])
def test_on_policy_batches_look_on_policy(config: GIPOConfig | PPOConfig) -> None:
    metrics = {k: v.item() for k, v in config.loss(make_inputs(spread=0.0)).metrics.items()}
    for name in ("approx_kl", "kl", "clip_fraction", "low_weight", "ratio_max_dev", "log_ratio_p50"):
        assert metrics[name] == 0.0, name
    assert metrics["ess"] == pytest.approx(1.0) and metrics["decisions"] == 12.0


def test_gipo_keeps_more_effective_samples_than_plain_importance_sampling() -> None:
    inputs = make_inputs(n=4000, factors=1, spread=1.5)
    wide, narrow = GIPOConfig(sigma=math.inf), GIPOConfig(sigma=0.5)
    ess = [c.loss(inputs).metrics["ess"].item() for c in (wide, narrow)]
    assert ess[1] > 2 * ess[0]
