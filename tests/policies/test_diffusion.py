# SPDX-License-Identifier: Apache-2.0
"""Diffusion beside the contract: LeRobot's schedulers to the bit, and policies that look back."""

from pathlib import Path

import numpy as np
import pytest
import torch

from accerl_lerobot.envs import SimulatedConfig, make_environment
from accerl_lerobot.experience import TASK, Request, stack_observations
from accerl_lerobot.policies.family import NoiseFamily
from tests.policies.checkpoints import write_diffusion
from tests.policies.tiny import adapter_at, requests
from tests.rounding import assert_close


def ask(count: int, **options: bool) -> list[Request]:
    return requests(count, image=16, **options)


def written(directory: Path, **fields: object) -> Path:
    return write_diffusion(directory / "pretrained_model", **fields)


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
def test_not_exploring_is_lerobot_s_sampler_to_the_bit(
    tmp_path: Path, fields: dict, monkeypatch: pytest.MonkeyPatch
):
    adapter, asked = adapter_at(written(tmp_path, **fields)), ask(6, explore=False)
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
    chunks = np.stack([d.chunk for d in adapter.decide(asked, 0)])
    assert np.array_equal(chunks, stock.numpy())
    noisy = np.stack([d.chunk for d in adapter.decide(ask(6), 0)])
    assert np.abs(noisy - chunks).max() > 1e-2


OBSERVED = 2
STATE = "observation.state"
WORLD = SimulatedConfig(max_steps=13, tolerance=0.05, image_size=40)


@pytest.fixture(scope="module")
def looking(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(
        tmp_path_factory.mktemp("looking"),
        image=40,
        n_obs_steps=OBSERVED,
        noise_scheduler_type="DDIM",
        num_inference_steps=3,
    )


def test_an_episode_is_the_one_that_stock_lerobot_plays(looking: Path):
    """LeRobot sees every env step and keeps its own queues; we look when a decision is due."""
    adapter = adapter_at(looking)
    policy, size = adapter.policy, adapter.family.size
    ours, stock = make_environment(WORLD, OBSERVED), make_environment(WORLD)
    observation, policy_sees = ours.reset(3, "match"), stock.reset(3, "match")
    policy.reset()
    steps = decisions = 0
    ended = False
    while not ended:
        request = Request(observation=observation, noise_seed=decisions, explore=False)
        chunk = adapter.decide([request], 0)[0].chunk
        noise = NoiseFamily.noise([request], size, device=torch.device("cpu"))[0]
        for row in chunk:
            arrays = {k: np.asarray(v)[None] for k, v in policy_sees.items() if k != TASK}
            batch = adapter.processing.prepare(arrays, [str(policy_sees[TASK])])
            action = adapter.processing.unnormalise(policy.select_action(batch, noise=noise))[0]
            assert_close(action, row)
            result = stock.step_chunk(row[None])
            steps += 1
            if result.done:
                break
            assert result.observation is not None
            policy_sees = result.observation
        whole = ours.step_chunk(chunk)
        ended = whole.done
        assert ended == result.done
        if whole.observation is not None:
            observation = whole.observation
            assert np.array_equal(observation[STATE][-1], result.observation[STATE])
        decisions += 1
    assert steps == 13 and decisions == 5
