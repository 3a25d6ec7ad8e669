# SPDX-License-Identifier: Apache-2.0
"""An imagined environment, on a world whose every number is known; a world model that learns in a run."""

from collections import deque
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.tensors import copied
from accerl_lerobot.envs import SimulatedConfig, make_environment
from accerl_lerobot.experience import IMAGINED, TASK, Decision, Segment
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.world_model import training
from accerl_lerobot.world_model.config import PixelModelConfig
from accerl_lerobot.world_model.contract import Prediction, WorldModelSpec, episode_of, model_arrays
from accerl_lerobot.world_model.imagined import ImaginedEnvironment, World
from accerl_lerobot.world_model.pixels import PixelWorldModel
from accerl_lerobot.world_model.training import Trainer, draw, starts_of
from tests.rollout.environments import Recorder, explore

CAMERA, K = "observation.images.front", 4
WORLD = SimulatedConfig(max_steps=16, image_size=16, hold=6, tolerance=0.2)
SPEC = WorldModelSpec(cameras=(CAMERA,), image_size=(16, 16), state_dim=4, action_dim=2, chunk=K, fps=80)


def real_episode(seed: int, *, solve_at: int = 99) -> Segment:
    """An episode of random chunks, which are right from decision `solve_at` on."""
    environment: Any = make_environment(WORLD)
    recorder = Recorder([environment], [explore(seed, "match")], RolloutConfig(segment_length=99))
    rng, made, due = np.random.default_rng(seed), 0, recorder.runner.begin_episode(0)
    while due is not None:
        chunk = rng.uniform(-0.2, 0.2, (K, 2)).astype(np.float32)
        if made >= solve_at:
            chunk[:] = environment.solution
        made += 1
        decision = Decision(chunk=chunk, latent={}, log_prob=np.zeros(1, np.float32), version=0)
        due = recorder.runner.advance(0, decision)
    return recorder.segments[0]


class CountingWorld:
    """Each chunk brightens the image by one, and adds the chunk's sum to the robot's first number."""

    def __init__(self, success_at: int = 99) -> None:
        self.model: Any = SimpleNamespace(spec=SPEC)
        self._success_at = success_at

    def begin(self, frames: np.ndarray, robot: np.ndarray, task: str) -> dict[str, torch.Tensor]:
        return {"frames": torch.tensor(frames), "robot": torch.tensor(robot)}

    def step(self, state: dict[str, torch.Tensor], actions: np.ndarray) -> Prediction:
        frames, robot = state["frames"] + 1, state["robot"].clone()
        robot[0] += float(actions.sum())
        return Prediction({"frames": frames, "robot": robot}, frames=frames[None], robot=robot[None])

    def succeeds(self, frames: np.ndarray, task: str) -> bool:
        return int(frames.reshape(-1)[0]) - 7 == self._success_at


def start(value: int) -> tuple[str, dict[str, Any]]:
    """The first observation of an episode, in an image of one brightness."""
    image = np.full((16, 16, 3), value, np.uint8)
    return "match", {CAMERA: image, "observation.state": np.zeros(4, np.float32), TASK: "do it"}


def environment(world: Any, *starts: tuple[str, dict[str, Any]]) -> ImaginedEnvironment:
    return ImaginedEnvironment(world, make_environment(WORLD).spec, deque(starts or [start(7)]))


CHUNK = np.full((K, 2), 0.5, np.float32)


def test_an_episode_begins_at_the_start_that_its_seed_names_and_a_chunk_is_one_prediction():
    made = environment(CountingWorld(), start(9), start(7))
    for seed, value in ((4, 9), (5, 7)):
        first = made.reset(seed, "match")
        assert first[CAMERA].min() == value == first[CAMERA].max() and first[TASK] == "do it"
    result = made.step_chunk(CHUNK)
    assert result.observation[CAMERA].max() == 8 and result.observation["observation.state"][0] == 4.0
    assert result.rewards.tolist() == [0.0] * K and not result.done


@pytest.mark.parametrize(("success_at", "chunks"), [(2, 2), (99, 16 // K)])
def test_success_ends_it_and_pays_once_or_the_time_limit_ends_it(success_at: int, chunks: int):
    made = environment(CountingWorld(success_at))
    made.reset(0, "match")
    *others, last = [made.step_chunk(CHUNK) for _ in range(chunks)]
    succeeds = success_at == chunks
    assert not any(result.done for result in others)
    assert (last.terminated, last.success, last.truncated) == (succeeds, succeeds, not succeeds)
    assert last.rewards.tolist() == [0.0] * (K - 1) + [float(succeeds)]


def world() -> World:
    torch.manual_seed(0)
    return World(PixelWorldModel(SPEC, PixelModelConfig(channels=(8, 8))))


def test_a_batch_of_one_is_what_the_models_say():
    given = world().eval()
    made = environment(given, start(100))
    made.reset(0, "match")
    result = made.step_chunk(CHUNK)
    state = given.begin(np.full((1, 16, 16, 3), 100, np.uint8), np.zeros(4, np.float32), "do it")
    prediction = given.model.step(state, torch.from_numpy(CHUNK[None]))
    assert np.array_equal(result.observation[CAMERA], prediction.frames[0, 0].numpy())
    np.testing.assert_allclose(result.observation["observation.state"], prediction.robot[0].numpy())


def learner(steps_per_episode: float = 2.0) -> Trainer:
    return Trainer(world(), [], 3e-4, steps_per_episode=steps_per_episode)


def episodes(*outcomes: bool) -> list[Segment]:
    return [real_episode(seed, solve_at=2 if success else 99) for seed, success in enumerate(outcomes)]


def test_a_segment_is_an_episode():
    segment = real_episode(1, solve_at=2)
    episode = episode_of(segment, SPEC)
    frames, robot = model_arrays(segment.observations, SPEC)
    assert segment.steps.tolist() == [4, 4, 4, 1] and episode.times.tolist() == [0, 4, 8, 12, 13]
    assert np.array_equal(episode.frames, frames) and np.array_equal(episode.state, robot)
    assert np.array_equal(episode.actions[:12], segment.actions[:3].reshape(12, 2))
    assert len(episode.actions) == 13 and episode.success
    assert not episode_of(real_episode(1), SPEC).success


@pytest.mark.parametrize(("each", "count", "due"), [(2.0, 20, 2.0 * training.MOST_PENDING), (0.05, 21, 1.0)])
def test_steps_are_due_for_each_whole_real_episode_up_to_a_limit(each: float, count: int, due: float):
    made = learner(each)
    for segment in episodes(*[False] * count):
        begun = segment.origin._replace(decision=1)
        for change in ({"source": IMAGINED}, {"terminated": False}, {"origin": begun}):
            made.add(replace(segment, **change))  # type: ignore[arg-type]
        made.add(segment)
        made.add(segment)  # as one that is drawn twice
    assert len(made.played) == count and made.pending_steps == pytest.approx(due)


def test_it_learns_and_leaves_the_given_world_alone():
    given = world()
    made = Trainer(given, [], 3e-4, steps_per_episode=2.0)
    before, was = copied(made.serving), copied(given)
    segments = episodes(False, False, True, False)
    made.add(segments[0])
    assert "success" not in made.step(), "there is no success yet"
    for segment in segments[1:]:
        made.add(segment)
    while made.pending_steps >= 1:
        metrics = made.step()
    assert made.serving.version == 8 and {"image", "state", "success"} <= set(metrics)
    assert any(not torch.equal(value, before[name]) for name, value in copied(made.serving).items())
    assert all(torch.equal(value, was[name]) for name, value in copied(given).items())


def test_half_of_every_batch_is_from_the_episodes_it_began_with():
    recorded = starts_of([episode_of(segment, SPEC) for segment in episodes(False)])
    played = starts_of([episode_of(segment, SPEC) for segment in episodes(*[False] * 4)])
    drawn = draw([recorded, played], 400)
    assert sum(start.episode is recorded[0].episode for start in drawn) == 200 == len(drawn) - 200
    assert len({(start.episode.key, start.frame) for start in drawn}) == len(recorded) + len(played) - 4
    assert len(draw([recorded, []], 10)) == 10


def test_it_goes_on_from_its_state_and_a_world_takes_its_weights_over(tmp_path: Path):
    one = learner()
    for segment in episodes(False, True):
        one.add(segment)
    one.step()
    snapshot.save(tmp_path / "learner", one.state())
    other, taken = learner(), world()
    other.restore(snapshot.load(tmp_path / "learner"))
    assert other.pending_steps == one.pending_steps == 3
    made = []
    for each in (one, other):
        torch.manual_seed(5)
        made.append(each.step())
    assert made[0] == made[1]
    taken.load(other.serving.version, copied(other.serving))
    assert taken.version == 2
    ours, theirs = copied(one.serving), copied(taken)
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
