# SPDX-License-Identifier: Apache-2.0
"""Global advantage normalisation: parts of a batch, merged, equal the whole."""

import torch

from accerl_lerobot.algorithms.normalise import moments, normalise
from tests.rounding import assert_close


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


def test_by_hand() -> None:
    x = torch.tensor([1.0, 3.0])
    assert moments(x).tolist() == [4.0, 10.0, 2.0]
    torch.testing.assert_close(normalise(x, moments(x)), torch.tensor([-1.0, 1.0]))


def test_padding_may_be_nan() -> None:
    x, mask = torch.tensor([1.0, torch.nan, 3.0]), torch.tensor([True, False, True])
    assert normalise(x, moments(x, mask), mask).tolist()[1] == 0.0
    assert moments(x, mask).tolist() == [4.0, 10.0, 2.0]


def test_equal_advantages_and_empty_batches_become_zero() -> None:
    x = torch.full((64,), 0.1)
    assert normalise(x, moments(x)).abs().max() == 0
    nothing = torch.zeros(3, dtype=torch.bool)
    assert normalise(torch.ones(3), moments(torch.ones(3), nothing), nothing).abs().max() == 0


def test_a_large_mean_does_not_eat_the_variance() -> None:
    x = 1e4 + torch.tensor([-1.0, 1.0] * 50)
    torch.testing.assert_close(normalise(x, moments(x)).abs(), torch.ones(100), rtol=1e-4, atol=1e-4)
