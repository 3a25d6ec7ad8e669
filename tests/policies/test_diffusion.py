# SPDX-License-Identifier: Apache-2.0
"""Diffusion beside the contract: LeRobot's schedulers to the bit, and policies that look back."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.envs import SimulatedConfig, make_environment
from accerl_lerobot.experience import Request, stack_observations
from accerl_lerobot.policies.family import NoiseFamily
from tests.policies.checkpoints import write_diffusion
from tests.policies.tiny import adapter_at, requests
from tests.rounding import assert_close

SCHEDULES = [
    {},
    {"prediction_type": "sample"},
    {"clip_sample": False, "beta_schedule": "linear", "beta_end": 0.3},
    {"noise_scheduler_type": "DDIM"},
    {"noise_scheduler_type": "DDIM", "prediction_type": "sample", "clip_sample_range": 0.7},
    {"num_inference_steps": 3},  # 20 training steps are no multiple of it
    {"num_inference_steps": None, "num_train_timesteps": 6},
]


@pytest.mark.parametrize("fields", SCHEDULES, ids=lambda f: "-".join(str(v) for v in f.values()) or "ddpm")
def test_not_exploring_is_lerobot_s_sampler_to_the_bit(tmp_path: Path, fields: dict, monkeypatch: Any):
    adapter = adapter_at(write_diffusion(tmp_path / "policy", **fields))
    asked = requests(6, explore=False, image=16)
    observations, tasks = stack_observations(asked)
    assert adapter.self_check(observations, tasks) == 0.0
    sizes = (8, 2), (len(adapter.family.schedule), 8, 2)
    noise, each = NoiseFamily.noise(asked, *sizes, device=torch.device("cpu"))
    steps = list(each.transpose(0, 1))
    for scheduler in ("ddpm", "ddim"):
        monkeypatch.setattr(
            f"diffusers.schedulers.scheduling_{scheduler}.randn_tensor",
            lambda shape, generator, device, dtype: steps.pop(0),
        )
    batch = adapter.processing.prepare(observations, tasks)
    batch["observation.state"] = batch["observation.state"][:, None]
    stock = adapter.processing.unnormalise(adapter.policy.predict_action_chunk(batch, noise=noise))
    assert len(steps) == (1 if adapter.family.schedule.scheduler == "DDPM" else len(adapter.family.schedule))
    assert np.array_equal([d.chunk for d in adapter.decide(asked, 0)], stock.numpy())


def test_an_episode_is_the_one_that_stock_lerobot_plays(tmp_path: Path):
    """LeRobot sees every env step and keeps its own queues; we look when a decision is due."""
    fields = {"noise_scheduler_type": "DDIM", "num_inference_steps": 3}
    adapter = adapter_at(write_diffusion(tmp_path / "policy", image=40, n_obs_steps=2, **fields))
    world = SimulatedConfig(max_steps=13, tolerance=0.05, image_size=40)
    ours, stock = make_environment(world, 2), make_environment(world)
    observation, seen = ours.reset(3, "match"), stock.reset(3, "match")
    adapter.policy.reset()
    played = []
    for decision in range(5):
        request = Request(observation=observation, noise_seed=decision, explore=False)
        chunk = adapter.decide([request], 0)[0].chunk
        noise = NoiseFamily.noise([request], adapter.family.size, device=torch.device("cpu"))[0]
        whole = ours.step_chunk(chunk)
        for row in chunk[: whole.steps]:
            batch = adapter.processing.prepare(*stack_observations([replace(request, observation=seen)]))
            action = adapter.policy.select_action(batch, noise=noise)
            assert_close(adapter.processing.unnormalise(action)[0], row)
            result = stock.step_chunk(row[None])
            seen = result.observation
            played.append(result.done)
        observation = whole.observation
        assert result.done == whole.done
        assert np.array_equal(observation["observation.state"][-1], seen["observation.state"])
    assert played == [False] * 12 + [True]
