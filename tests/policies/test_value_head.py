# SPDX-License-Identifier: Apache-2.0
"""The critic: pools real tokens only, starts at zero, can keep its gradient to itself."""

from __future__ import annotations

import re

import pytest
import torch

from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import ValueHeadConfig
from accerl_lerobot.policies.value_head import ValueHead, two_hot
from tests.rounding import assert_close


def head(**options: object) -> ValueHead:
    """With weights of ordinary size, as after some training."""
    torch.manual_seed(0)
    module = ValueHead(6, ValueHeadConfig(**options))
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.normal_()
    return module


def inputs() -> tuple[torch.Tensor, torch.Tensor]:
    features = torch.randn(2, 4, 6, generator=torch.Generator().manual_seed(1))
    return features, torch.tensor([[True, True, True, False], [True, True, False, False]])


def test_a_new_critic_says_zero():
    assert torch.equal(ValueHead(6, ValueHeadConfig())(*inputs()).mean, torch.zeros(2))


def test_initial_weights_depend_on_the_seed_alone_and_not_on_what_was_drawn_before():
    heads = []
    for seed, draws in ((3, 0), (3, 1000), (4, 0)):
        torch.manual_seed(seed)
        torch.randn(draws)
        heads.append(ValueHead(6, ValueHeadConfig()).hidden.weight.detach())
    assert torch.equal(heads[0], heads[1]) and not torch.equal(heads[0], heads[2])
    assert heads[0].abs().max() <= 6**-0.5 and heads[0].std() == pytest.approx(6**-0.5 / 3**0.5, rel=0.1)


@pytest.mark.parametrize("pooling", ["attention", "mean"])
def test_padding_is_not_read(pooling: str):
    critic, (features, mask) = head(pooling=pooling), inputs()
    value = critic(features, mask).mean
    assert value.shape == (2,) and value.std() > 0
    other = torch.where(mask[..., None], features, 100.0)
    assert torch.equal(critic(other, mask).mean, value)
    alone = critic(features[1:, :2], mask[1:, :2]).mean
    assert_close(alone, value[1:])


def test_mean_pooling_by_hand_and_attention_that_differs():
    (features, mask), mean, attention = inputs(), head(pooling="mean"), head(pooling="attention")
    pooled = torch.stack([features[0, :3].mean(0), features[1, :2].mean(0)])
    expected = mean.out(torch.relu(mean.hidden(mean.norm(pooled))))[:, 0]
    assert_close(mean(features, mask).mean, expected)
    assert attention.query is not None
    scores = features[1, :2] @ attention.query / 6**0.5
    pooled = (torch.softmax(scores, 0)[:, None] * features[1, :2]).sum(0)
    expected = attention.out(torch.relu(attention.hidden(attention.norm(pooled))))[0]
    assert_close(attention(features, mask).mean[1], expected)


@pytest.mark.parametrize("detach", [True, False])
def test_detach(detach: bool):
    features, mask = inputs()
    features.requires_grad_()
    critic = head(detach=detach)
    critic(features, mask).mean.sum().backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in critic.parameters())
    assert (features.grad is None) == detach


def test_half_precision_features_are_read_in_full():
    features, mask = inputs()
    assert head()(features.bfloat16(), mask).mean.dtype == torch.float32


@pytest.mark.parametrize(
    ("name", "value"), [("pooling", "max"), ("hidden", 0), ("bins", 1), ("value_range", (1.0, 1.0))]
)
def test_bad_options_name_their_field(name: str, value: object):
    with pytest.raises(InputError, match=rf"^policy\.value_head\.{name}={re.escape(repr(value))}: use"):
        ValueHeadConfig(**{name: value})


def test_two_hot_by_hand():
    support = torch.linspace(-1.0, 1.0, 5)
    rows = two_hot(torch.tensor([-1.0, -0.625, 0.0, 1.0, 7.0, -9.0]), support)
    ends = [[1.0, 0, 0, 0, 0], [0, 0, 0, 0, 1.0]]
    assert_close(rows, [ends[0], [0.25, 0.75, 0, 0, 0], [0, 0, 1.0, 0, 0], ends[1], ends[1], ends[0]])
    x = torch.rand(100, generator=torch.Generator().manual_seed(0)) * 2 - 1
    assert_close(two_hot(x, support) @ support, x)  # the mean is kept


def test_a_distribution_over_returns_by_hand():
    critic, (features, mask) = head(bins=3, value_range=(-2.0, 4.0)), inputs()
    value = critic(features, mask)
    assert value.logits is not None and value.logits.shape == (2, 3)
    p = torch.softmax(value.logits, -1)
    assert_close(value.mean, -2 * p[:, 0] + 1 * p[:, 1] + 4 * p[:, 2])
    error = value.error(torch.tensor([0.0, 4.0]))  # 0 lies two thirds of the way from −2 to 1
    expected = torch.stack([-(p[0, 0].log() / 3 + 2 * p[0, 1].log() / 3), -p[1, 2].log()])
    assert_close(error, expected)


def test_the_distribution_is_learnt_and_its_mean_with_it():
    critic, (features, mask) = ValueHead(6, ValueHeadConfig(bins=11)), inputs()
    wanted = torch.tensor([0.33, -0.71])
    optimizer = torch.optim.Adam(critic.parameters(), lr=0.01)
    for _ in range(400):
        optimizer.zero_grad()
        critic(features, mask).error(wanted).mean().backward()
        optimizer.step()
    assert torch.allclose(critic(features, mask).mean, wanted, atol=0.02)


def test_the_scalar_s_error_is_squared():
    value = head()(*inputs())
    returns = torch.tensor([1.0, -2.0])
    assert torch.equal(value.error(returns), (value.mean - returns) ** 2)
