# SPDX-License-Identifier: Apache-2.0
"""GAE against a slow oracle and by hand; terminated is not truncated; normalised advantages."""

from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms.ratio_update import gae, moments, normalise

LENGTHS = (7, 1, 3, 6, 2, 4)


def slow_gae(rewards, values, bootstrap, terminated, lengths, gamma, lam):
    """Â_t = Σ_k (γλ)^k δ_{t+k}, summed forwards for every t (the fast version recurses backwards)."""
    advantages, returns, start = [], [], 0
    for s, n in enumerate(lengths):
        r = rewards[start : start + n]
        v = [*values[start : start + n], 0.0 if terminated[s] else bootstrap[s]]
        delta = [r[t] + gamma * v[t + 1] - v[t] for t in range(n)]
        for t in range(n):
            advantages.append(sum((gamma * lam) ** k * delta[t + k] for k in range(n - t)))
            returns.append(advantages[-1] + v[t])
        start += n
    return advantages, returns


@pytest.mark.parametrize(("gamma", "lam"), [(0.99, 0.95), (1.0, 1.0), (0.9, 0.0), (0.0, 0.5)])
def test_equals_the_oracle(gamma: float, lam: float) -> None:
    generator = torch.Generator().manual_seed(0)
    rewards, values = torch.randn(2, sum(LENGTHS), generator=generator, dtype=torch.float64)
    bootstrap = torch.randn(len(LENGTHS), generator=generator, dtype=torch.float64)
    terminated = torch.arange(len(LENGTHS)) % 2 == 0
    bootstrap[terminated] = torch.nan  # is not looked at
    inputs = rewards, values, bootstrap, terminated
    expected = slow_gae(*(x.tolist() for x in inputs), LENGTHS, gamma, lam)
    for got, want in zip(gae(*inputs, LENGTHS, gamma=gamma, lam=lam), expected, strict=True):
        np.testing.assert_allclose(got.numpy(), want, atol=1e-12)


@pytest.mark.parametrize(
    ("terminated", "advantages", "returns"),
    [
        # δ_1 = 1 + 0 − 0.25 = 0.75; δ_0 = 0 + 0.5·0.25 − 0.5 = −0.375; Â_0 = −0.375 + 0.25·0.75 = −0.1875
        (True, [-0.1875, 0.75], [0.3125, 1.0]),
        # δ_1 = 1 + 0.5·2 − 0.25 = 1.75; Â_0 = −0.375 + 0.25·1.75 = 0.0625
        (False, [0.0625, 1.75], [0.5625, 2.0]),
    ],
)
def test_termination_and_truncation_by_hand(terminated: bool, advantages: Any, returns: Any) -> None:
    reward, value = torch.tensor([0.0, 1.0]), torch.tensor([0.5, 0.25])
    found = gae(reward, value, torch.tensor([2.0]), torch.tensor([terminated]), [2], gamma=0.5, lam=0.5)
    assert [row.tolist() for row in found] == [advantages, returns]


def test_equal_advantages_become_zero_and_a_large_mean_does_not_eat_the_variance() -> None:
    x = torch.full((64,), 0.1)
    assert normalise(x, moments(x)).abs().max() == 0
    x = 1e4 + torch.tensor([-1.0, 1.0] * 50)
    torch.testing.assert_close(normalise(x, moments(x)).abs(), torch.ones(100), rtol=1e-4, atol=1e-4)
