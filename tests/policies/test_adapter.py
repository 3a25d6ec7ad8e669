# SPDX-License-Identifier: Apache-2.0
"""Around the network: LeRobot's own scaling, tokens and names; and the critic on its features."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from accerl_lerobot.experience import stack_observations
from accerl_lerobot.policies.adapter import ValueHead
from accerl_lerobot.policies.config import GaussianSamplerConfig
from tests.policies.tiny import adapter_at, requests
from tests.rounding import assert_close


def test_images_are_scaled_and_states_normalised(tiny_checkpoint: Path):
    raw, tasks = stack_observations(requests(3))
    batch = adapter_at(tiny_checkpoint).processing.prepare(raw, tasks)
    image = batch["observation.images.front"]
    assert image.shape == (3, 3, 32, 32) and image.dtype == torch.float32
    assert np.array_equal(
        image[1, 2, 5, 7].numpy(), np.float32(raw["observation.images.front"][1, 5, 7, 2]) / 255
    )
    assert np.allclose(batch["observation.state"], raw["observation.state"] / 0.5, rtol=1e-6)


def test_act_s_std_starts_where_it_is_configured_and_stays_within_bounds(written: Callable[[str], Path]):
    # The checkpoint's action std is 0.5, so that is the factor from normalised to executed.
    adapter = adapter_at(written("act"), GaussianSamplerConfig(std=0.24))
    asked, still = (requests(200, image=16, explore=explore) for explore in (True, False))

    def added() -> np.ndarray:
        noisy, stock = (np.stack([d.chunk for d in adapter.decide(some, 0)]) for some in (asked, still))
        return (noisy - stock) / 0.5

    assert abs(added().mean()) < 0.03 and added().std() == pytest.approx(0.24, rel=0.05)
    with torch.no_grad():
        adapter.family.std.out.bias.copy_(torch.tensor([50.0, -50.0]))
    assert added().std((0, 1)) == pytest.approx([0.6, 0.06], rel=0.06)


def head() -> ValueHead:
    """With weights of ordinary size, as after some training."""
    torch.manual_seed(0)
    module = ValueHead(6)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.normal_()
    return module


def inputs() -> tuple[torch.Tensor, torch.Tensor]:
    features = torch.randn(2, 4, 6, generator=torch.Generator().manual_seed(1))
    return features, torch.tensor([[True, True, True, False], [True, True, False, False]])


def test_initial_weights_depend_on_the_seed_alone_and_not_on_what_was_drawn_before():
    assert torch.equal(ValueHead(6)(*inputs()), torch.zeros(2)), "a new critic says 0"
    heads = []
    for seed, draws in ((3, 0), (3, 1000), (4, 0)):
        torch.manual_seed(seed)
        torch.randn(draws)
        heads.append(ValueHead(6).hidden.weight.detach())
    assert torch.equal(heads[0], heads[1]) and not torch.equal(heads[0], heads[2])
    assert heads[0].abs().max() <= 6**-0.5 and heads[0].std() == pytest.approx(6**-0.5 / 3**0.5, rel=0.1)


def test_attention_by_hand():
    (features, mask), critic = inputs(), head()
    scores = features[1, :2] @ critic.query / 6**0.5
    pooled = (torch.softmax(scores, 0)[:, None] * features[1, :2]).sum(0)
    expected = critic.out(torch.relu(critic.hidden(critic.norm(pooled))))[0]
    assert_close(critic(features, mask)[1], expected)


def test_its_gradient_stops_at_the_features():
    features, mask = inputs()
    features.requires_grad_()
    critic = head()
    critic(features, mask).sum().backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in critic.parameters())
    assert features.grad is None
