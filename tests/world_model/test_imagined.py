# SPDX-License-Identifier: Apache-2.0
"""An imagined environment, on a world whose every number is known."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.envs import make_environment
from accerl_lerobot.experience import IMAGINED, REAL, TASK
from accerl_lerobot.rollout.runner import EpisodePlans, RolloutConfig, RolloutRunner
from accerl_lerobot.world_model.config import PixelModelConfig
from accerl_lerobot.world_model.contract import Prediction
from accerl_lerobot.world_model.imagined import ImaginedEnvironment, World
from accerl_lerobot.world_model.pixels import PixelWorldModel
from tests.world_model.real_segments import SPEC, WORLD, K, decided

CAMERA = "observation.images.front"


class CountingWorld:
    """Each chunk brightens the image by one, and adds the chunk's sum to the robot's first number."""

    def __init__(self, success_at: int = 99) -> None:
        self.model: Any = SimpleNamespace(spec=SPEC)
        self._success_at = success_at
        self.seeds: list[int] = []

    def begin(self, frames: np.ndarray, robot: np.ndarray, task: str) -> dict[str, torch.Tensor]:
        return {"frames": torch.tensor(frames), "robot": torch.tensor(robot)}

    def step(self, state: dict[str, torch.Tensor], actions: np.ndarray, seed: int) -> Prediction:
        self.seeds.append(seed)
        frames = state["frames"] + 1
        robot = state["robot"].clone()
        robot[0] += float(actions.sum())
        following = {"frames": frames, "robot": robot}
        return Prediction(state=following, frames=frames[None], robot=robot[None])

    def succeeds(self, frames: np.ndarray, task: str) -> bool:
        return int(frames.reshape(-1)[0]) - 7 == self._success_at


def start(value: int) -> tuple[str, dict[str, Any]]:
    """The first observation of an episode, in an image of one brightness."""
    image = np.full((16, 16, 3), value, np.uint8)
    return "match", {CAMERA: image, "observation.state": np.zeros(4, np.float32), TASK: "do it"}


def environment(world: Any, *starts: tuple[str, dict[str, Any]]) -> ImaginedEnvironment:
    return ImaginedEnvironment(world, make_environment(WORLD).spec, deque(starts or [start(7)]))


CHUNK = np.full((K, 2), 0.5, np.float32)


def test_an_episode_begins_at_the_start_that_its_seed_names():
    made = environment(CountingWorld(), start(7), start(9))
    for seed, value in ((4, 7), (5, 9)):
        first = made.reset(seed, "match")
        assert first[CAMERA].min() == value == first[CAMERA].max() and first[TASK] == "do it"


def test_a_chunk_is_one_prediction():
    world = CountingWorld()
    made = environment(world)
    made.reset(0, "match")
    result = made.step_chunk(CHUNK)
    assert result.observation[CAMERA].max() == 8 and result.observation["observation.state"][0] == 4.0
    assert result.rewards.tolist() == [0.0] * K and not result.done
    made.step_chunk(CHUNK)
    first = list(world.seeds)
    made.reset(0, "match")
    made.step_chunk(CHUNK)
    assert world.seeds[2] == first[0] != first[1], "equal seeds give equal randomness, of each chunk its own"


def test_success_ends_it_and_pays_once():
    made = environment(CountingWorld(success_at=2))
    made.reset(0, "match")
    assert not made.step_chunk(CHUNK).done
    last = made.step_chunk(CHUNK)
    assert last.terminated and last.success and last.rewards.tolist() == [0.0] * (K - 1) + [1.0]
    with pytest.raises(RuntimeError, match="the episode is over"):
        made.step_chunk(CHUNK)


def test_the_time_limit_ends_it_as_a_failure():
    made = environment(CountingWorld())
    made.reset(0, "match")
    results = [made.step_chunk(CHUNK) for _ in range(16 // K)]
    assert [result.done for result in results] == [False, False, False, True]
    assert results[-1].truncated and not results[-1].success


def test_an_episode_under_way_goes_on_from_its_state():
    made, other = environment(CountingWorld()), environment(CountingWorld())
    made.reset(3, "match")
    made.step_chunk(CHUNK)
    other.restore(made.state())
    one, two = made.step_chunk(CHUNK), other.step_chunk(CHUNK)
    assert np.array_equal(one.observation[CAMERA], two.observation[CAMERA])
    assert np.array_equal(one.observation["observation.state"], two.observation["observation.state"])


def test_the_runner_counts_imagined_episodes_apart_and_none_begins_before_a_real_one():
    plans = EpisodePlans(("match",), seed=0, budget=1)
    segments: list[Any] = []
    results: list[Any] = []
    real = make_environment(WORLD)
    runner = RolloutRunner(
        [real],
        lambda source: plans.next(True) if source == REAL else plans.next_imagined(True, runner.starts),
        RolloutConfig(),
        "w",
        segments.append,
        results.append,
    )
    runner.environments = [real, ImaginedEnvironment(CountingWorld(success_at=2), real.spec, runner.starts)]  # type: ignore[arg-type]
    runner._episodes = [None, None]
    assert runner.start(1) is None, "there is no start yet"
    assert runner.start(0) is not None and runner.start(1) is not None
    while runner.request(0) is not None:
        runner.advance(0, decided(np.zeros((K, 2))))
    assert not runner.exploring and plans.spent
    for _ in range(4):
        runner.advance(1, decided(CHUNK))
    counters = runner.counters
    assert (counters.episodes, counters.decisions, counters.env_steps) == (1, 4, 16)
    assert counters.imagined_decisions == 4 and counters.imagined_episodes >= 1
    assert {segment.source for segment in segments} == {REAL, IMAGINED}
    assert [result.plan.source for result in results].count(REAL) == 1


def test_a_batch_of_one_is_what_the_models_say():
    """The environment's own calls, against the model's."""
    torch.manual_seed(0)
    world = World(PixelWorldModel(SPEC, PixelModelConfig(channels=(8, 8)))).eval()
    made = environment(world, start(100))
    made.reset(0, "match")
    result = made.step_chunk(CHUNK)
    frames = np.full((1, 16, 16, 3), 100, np.uint8)
    state = world.begin(frames, np.zeros(4, np.float32), "do it")
    with torch.no_grad():
        prediction = world.model.step(state, torch.from_numpy(CHUNK[None]), [0])
    assert np.array_equal(result.observation[CAMERA], prediction.frames[0, 0].numpy())
    np.testing.assert_allclose(result.observation["observation.state"], prediction.robot[0].numpy())
