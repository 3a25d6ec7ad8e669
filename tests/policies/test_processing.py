# SPDX-License-Identifier: Apache-2.0
"""Around the network: LeRobot's own scaling, tokens and names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from accerl_lerobot.policies.adapter import LeRobotAdapter, stack_observations
from tests.policies.checkpoints import write_act
from tests.policies.tiny import TEXTS, adapter_at, requests


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


def test_actions_come_back_in_the_world_s_units(tiny_checkpoint: Path):
    adapter = adapter_at(tiny_checkpoint)
    chunk = torch.randn(2, 4, 2, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(adapter.processing.unnormalise(chunk), 0.5 * chunk)
