# SPDX-License-Identifier: Apache-2.0
"""Around the network: LeRobot's own scaling, tokens and names; and the critic on its features."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from accerl_lerobot.policies.adapter import LeRobotAdapter, ValueHead, stack_observations
from tests.policies.checkpoints import write_act
from tests.policies.tiny import TEXTS, adapter_at, requests
from tests.rounding import assert_close


def prepared(adapter: LeRobotAdapter, count: int = 3) -> tuple[dict, dict]:
    observations, tasks = stack_observations(requests(count))
    return observations, adapter.processing.prepare(observations, tasks)


def test_images_are_scaled_and_states_normalised(tiny_checkpoint: Path):
    raw, batch = prepared(adapter_at(tiny_checkpoint))
    image = batch["observation.images.front"]
    assert image.shape == (3, 3, 32, 32) and image.dtype == torch.float32
    assert np.array_equal(
        image[1, 2, 5, 7].numpy(), np.float32(raw["observation.images.front"][1, 5, 7, 2]) / 255
    )
    assert np.allclose(batch["observation.state"], raw["observation.state"] / 0.5, rtol=1e-6)


def test_a_lone_camera_may_be_called_as_in_lerobot_s_pusht(tmp_path: Path):
    # What `env.camera=""` names it, and what policies trained on LeRobot's PushT dataset expect.
    adapter = adapter_at(write_act(tmp_path / "one", camera="observation.image"))  # compared with LeRobot's
    request = requests(1, image=16)[0]
    image = request.observation["observation.images.front"]
    observations = {"observation.image": image[None], "observation.state": np.zeros((1, 4), np.float32)}
    batch = adapter.processing.prepare(observations, ["Push"])
    assert batch["observation.image"].shape == (1, 3, 16, 16)
    assert np.array_equal(batch["observation.image"][0, 2, 5, 7].numpy(), np.float32(image[5, 7, 2]) / 255)


def test_instructions_get_lerobot_s_newline_and_padding(tiny_checkpoint: Path):
    adapter = adapter_at(tiny_checkpoint)
    _, batch = prepared(adapter)
    tokenizer = adapter.policy.model.vlm_with_expert.processor.tokenizer
    tokens, mask = batch["observation.language.tokens"], batch["observation.language.attention_mask"]
    assert len({int(row.sum()) for row in mask}) == 3, "the batch is padded"
    for text, row, real in zip(TEXTS, tokens, mask, strict=True):
        assert tokenizer.decode(row[real]) == text + "\n"


# ---- the critic


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


def test_a_new_critic_says_zero():
    assert torch.equal(ValueHead(6)(*inputs()), torch.zeros(2))


def test_initial_weights_depend_on_the_seed_alone_and_not_on_what_was_drawn_before():
    heads = []
    for seed, draws in ((3, 0), (3, 1000), (4, 0)):
        torch.manual_seed(seed)
        torch.randn(draws)
        heads.append(ValueHead(6).hidden.weight.detach())
    assert torch.equal(heads[0], heads[1]) and not torch.equal(heads[0], heads[2])
    assert heads[0].abs().max() <= 6**-0.5 and heads[0].std() == pytest.approx(6**-0.5 / 3**0.5, rel=0.1)


def test_padding_is_not_read():
    critic, (features, mask) = head(), inputs()
    value = critic(features, mask)
    assert value.shape == (2,) and value.std() > 0
    other = torch.where(mask[..., None], features, 100.0)
    assert torch.equal(critic(other, mask), value)
    alone = critic(features[1:, :2], mask[1:, :2])
    assert_close(alone, value[1:])


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


def test_half_precision_features_are_read_in_full():
    features, mask = inputs()
    assert head()(features.bfloat16(), mask).dtype == torch.float32
