# SPDX-License-Identifier: Apache-2.0
"""A diffusion policy that looks back (LeRobot's default), exact in numbers and in a world."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from accerl_lerobot.console import Console
from accerl_lerobot.engine import run
from accerl_lerobot.engine.config import LaunchConfig, RunConfig
from accerl_lerobot.envs import SimulatedConfig, make_world
from accerl_lerobot.evaluation.config import EvaluationConfig
from accerl_lerobot.experience import TASK, Request
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.family import normal
from accerl_lerobot.policies.samplers import DiffusionSamplerConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.rollout.worker import RolloutWorker
from accerl_lerobot.trainer.config import TrainerConfig
from tests.policies.checkpoints import write_diffusion
from tests.policies.contract import PolicyContract
from tests.policies.tiny import adapter_at, looking_back, requests
from tests.rounding import assert_close
from tests.runs import tiny_run
from tests.transport.played import played

OBSERVED = 2
STATE = "observation.state"
WORLD = SimulatedConfig(max_steps=13, tolerance=0.05, image_size=40)


def write(directory: Path) -> Path:
    return write_diffusion(
        directory, image=40, n_obs_steps=OBSERVED, noise_scheduler_type="DDIM", num_inference_steps=3
    )


class TestContract(PolicyContract):
    samplers = [DiffusionSamplerConfig(std_min=0.5, last_steps=n) for n in (None, 1)]
    parts = ("rgb_encoder", "down_modules", "mid_modules", "up_modules", "final_conv")
    one_token = True
    image = 40
    slack = 0.06

    @staticmethod
    def write(directory: Path) -> Path:
        return write(directory)

    def ask(self, count: int, **options: bool) -> list[Request]:
        return looking_back(count, image=40, **options)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("diffusion") / "pretrained_model")


def test_both_observations_matter(path: Path):
    adapter = adapter_at(path)
    first = looking_back(1, image=40)[0]
    chunk = adapter.decide([first], 0)[0].chunk
    for place in range(OBSERVED):
        for key in (STATE, "observation.images.front"):
            changed = first.observation[key].copy()
            changed[place] = 0
            other = Request(observation=first.observation | {key: changed}, noise_seed=first.noise_seed)
            assert np.abs(adapter.decide([other], 0)[0].chunk - chunk).max() > 1e-3, (place, key)


def test_an_episode_is_the_one_that_stock_lerobot_plays(path: Path):
    """LeRobot sees every env step and keeps its own queues; we look when a decision is due."""
    adapter = adapter_at(path)
    policy, size = adapter.policy, (adapter.family.shape.horizon, adapter.family.shape.action_dim)
    ours, stock = make_world(WORLD, OBSERVED), make_world(WORLD)
    observation, policy_sees = ours.reset(3, "match"), stock.reset(3, "match")
    policy.reset()
    steps = decisions = 0
    ended = False
    while not ended:
        request = Request(observation=observation, noise_seed=decisions, explore=False)
        chunk = adapter.decide([request], 0)[0].chunk
        noise = normal([request], size, device=torch.device("cpu"))[0]
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


def config_for(path: Path, output_dir: Path, **rooms: object) -> RunConfig:
    defaults = {
        "env": WORLD,
        "policy": PolicyConfig(path=str(path), device="cpu", sampler=DiffusionSamplerConfig(std_min=0.3)),
        "trainer": TrainerConfig(updates=3, batch_decisions=16),
        "launch": LaunchConfig(engine="local"),
        "evaluation": EvaluationConfig(episodes=4, videos=0, before=False),
        "output_dir": str(output_dir),
    }
    return tiny_run(path, **(defaults | rooms))


def test_a_run_asks_the_policy_how_far_it_looks_back(path: Path, tmp_path: Path):
    config = config_for(path, tmp_path / "run")
    summary = run.train(config, run.make_output_dir(config), Console())
    assert summary["updates"] == 3 and summary["n_after"] == 4 and summary["ratio_max_dev"] < 1


def test_a_world_without_a_history_is_refused_in_words(path: Path):
    request = requests(1, image=40)[0]
    with pytest.raises(ValueError, match="but the policy reads 2 env steps at a time: make worlds"):
        adapter_at(path).decide([request], 0)


def test_a_rollout_process_asks_with_the_history():
    worker = RolloutWorker(WORLD, RolloutConfig(worlds=1), ("match",), 0, 0, 0, (8, 2), OBSERVED)
    asked: list[Request] = []

    def decide(due: list[Request]) -> list[Request]:
        asked.extend(due)
        raise InterruptedError

    worker.report(True, [])
    with pytest.raises(InterruptedError):
        worker.run(played(decide), played(lambda segments: True))
    assert asked[0].observation[STATE].shape == (OBSERVED, 4)
    assert asked[0].observation["observation.images.front"].shape == (OBSERVED, 40, 40, 3)
