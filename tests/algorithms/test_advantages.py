# SPDX-License-Identifier: Apache-2.0
"""GAE against a slow oracle and by hand; terminated is not truncated; padding does not matter."""

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms.ratio_update import decision_mask, gae, moments, normalise
from tests.rounding import assert_close

Batch = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


def slow_gae(rewards, values, bootstrap, terminated, lengths, gamma, lam):
    """Â_t = Σ_k (γλ)^k δ_{t+k}, summed forwards for every t (the fast version recurses backwards)."""
    advantages, returns = np.zeros_like(rewards), np.zeros_like(rewards)
    for s in range(len(lengths)):
        n = int(lengths[s])
        v = [float(values[s, t]) for t in range(n)]
        v.append(0.0 if terminated[s] else float(bootstrap[s]))
        delta = [float(rewards[s, t]) + gamma * v[t + 1] - v[t] for t in range(n)]
        for t in range(n):
            advantages[s, t] = sum((gamma * lam) ** k * delta[t + k] for k in range(n - t))
            returns[s, t] = advantages[s, t] + v[t]
    return advantages, returns


def batch() -> Batch:
    s, t = 6, 7
    generator = torch.Generator().manual_seed(0)
    rewards = torch.randn(s, t, generator=generator, dtype=torch.float64)
    values = torch.randn(s, t, generator=generator, dtype=torch.float64)
    bootstrap = torch.randn(s, generator=generator, dtype=torch.float64)
    terminated = torch.arange(s) % 2 == 0
    bootstrap[terminated] = torch.nan  # is not looked at
    lengths = torch.randint(1, t + 1, (s,), generator=generator)
    lengths[0] = t
    return rewards, values, bootstrap, terminated, lengths


@pytest.mark.parametrize(("gamma", "lam"), [(0.99, 0.95), (1.0, 1.0), (0.9, 0.0), (0.0, 0.5)])
def test_equals_the_oracle(gamma: float, lam: float) -> None:
    inputs = batch()
    rewards, values, bootstrap, terminated, lengths = (x.numpy() for x in inputs)
    expected = slow_gae(rewards, values, bootstrap, terminated, lengths, gamma, lam)
    for got, want in zip(gae(*inputs, gamma=gamma, lam=lam), expected, strict=True):
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
def test_termination_and_truncation_by_hand(
    terminated: bool, advantages: list[float], returns: list[float]
) -> None:
    reward, value = torch.tensor([[0.0, 1.0]]), torch.tensor([[0.5, 0.25]])
    ends = torch.tensor([2.0]), torch.tensor([terminated]), torch.tensor([2])
    found = gae(reward, value, *ends, gamma=0.5, lam=0.5)
    assert [row[0].tolist() for row in found] == [advantages, returns]


def test_padding_is_never_looked_at() -> None:
    rewards, values, bootstrap, terminated, lengths = batch()
    expected = gae(rewards, values, bootstrap, terminated, lengths, gamma=0.99, lam=0.95)
    padding = ~decision_mask(lengths, 10)
    tail = torch.zeros(6, 3, dtype=torch.float64)
    rewards, values = (torch.cat([x, tail], 1).masked_fill(padding, torch.nan) for x in (rewards, values))
    padded = gae(rewards, values, bootstrap, terminated, lengths, gamma=0.99, lam=0.95)
    for got, want in zip(padded, expected, strict=True):
        assert torch.equal(got[:, :7], want)
        assert (got[padding] == 0).all()


def test_parts_of_different_size_equal_the_whole() -> None:
    x = torch.randn(5, 8, generator=torch.Generator().manual_seed(0)) * 3 + 7
    mask = torch.rand(5, 8, generator=torch.Generator().manual_seed(1)) < 0.7
    total = moments(x[:1], mask[:1]) + moments(x[1:], mask[1:])
    torch.testing.assert_close(total, moments(x, mask))
    got = torch.cat([normalise(x[:1], total, mask[:1]), normalise(x[1:], total, mask[1:])])
    valid = x[mask].double()
    expected = (valid - valid.mean()) / valid.std(correction=0)
    assert_close(got[mask], expected)
    assert (got[~mask] == 0).all() and got.dtype == x.dtype


def test_padding_that_is_normalised_may_be_nan() -> None:
    x, mask = torch.tensor([1.0, torch.nan, 3.0]), torch.tensor([True, False, True])
    assert normalise(x, moments(x, mask), mask).tolist()[1] == 0.0
    assert moments(x, mask).tolist() == [4.0, 10.0, 2.0]


def test_equal_advantages_and_empty_batches_become_zero() -> None:
    x, mask = torch.full((64,), 0.1), torch.ones(64, dtype=torch.bool)
    assert normalise(x, moments(x, mask), mask).abs().max() == 0
    nothing = torch.zeros(3, dtype=torch.bool)
    assert normalise(torch.ones(3), moments(torch.ones(3), nothing), nothing).abs().max() == 0


def test_a_large_mean_does_not_eat_the_variance() -> None:
    x = 1e4 + torch.tensor([-1.0, 1.0] * 50)
    mask = torch.ones(100, dtype=torch.bool)
    scaled = normalise(x, moments(x, mask), mask)
    torch.testing.assert_close(scaled.abs(), torch.ones(100), rtol=1e-4, atol=1e-4)
