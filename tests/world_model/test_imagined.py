# SPDX-License-Identifier: Apache-2.0
"""An imagined environment, on a world whose every number is known; a world model that learns in a run."""

from collections import deque
from collections.abc import Sequence
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
from accerl_lerobot.rollout.runner import ActiveEpisode, EpisodePlan
from accerl_lerobot.world_model import online
from accerl_lerobot.world_model.config import OnlineLearnConfig, PixelModelConfig
from accerl_lerobot.world_model.contract import Episode, Prediction, WorldModelSpec, model_arrays
from accerl_lerobot.world_model.imagined import ImaginedEnvironment, World
from accerl_lerobot.world_model.online import OnlineLearner, episode_from_segments
from accerl_lerobot.world_model.pixels import PixelWorldModel

CAMERA, K = "observation.images.front", 4
WORLD = SimulatedConfig(max_steps=16, image_size=16, hold=6, tolerance=0.2)
SPEC = WorldModelSpec(
    cameras=(CAMERA,), image_size=(16, 16), state_dim=4, action_dim=2, chunk=K, context=2, fps=80
)


def real_episode(seed: int, *, length: int = 8, solve_at: int = 99) -> list[Segment]:
    """An episode of random chunks, which are right from decision `solve_at` on."""
    environment = make_environment(WORLD)
    rng = np.random.default_rng(seed)
    plan = EpisodePlan(task="match", seed=seed, explore=True)
    episode = ActiveEpisode(plan, environment.spec.max_steps, [environment.reset(seed, "match")])
    segments: list[Segment] = []
    for t in range(99):
        chunk = rng.uniform(-0.2, 0.2, (K, 2)).astype(np.float32)
        if t >= solve_at:
            chunk = np.repeat(environment.solution[None].astype(np.float32), K, 0)  # type: ignore[attr-defined]
        result = environment.step_chunk(chunk)
        reward = float(result.rewards.sum()) - 0.01
        zero = np.zeros(1, np.float32)
        decision = Decision(chunk=chunk, latent={"x": chunk.ravel()}, log_prob=zero, version=0)
        episode.add(decision, chunk, reward, result.steps, result.observation)
        if result.done or len(episode.taken) == length:
            key = f"{seed}.{len(segments)}"
            segments.append(episode.cut(key, result.done, result.success))
        if result.done:
            break
    return segments


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


def world() -> World:
    torch.manual_seed(0)
    return World(PixelWorldModel(SPEC, PixelModelConfig(channels=(8, 8))))


def learner(steps_per_episode: float = 2.0, offline: Sequence[Episode] = ()) -> OnlineLearner:
    return OnlineLearner(world(), OnlineLearnConfig(steps_per_episode=steps_per_episode), offline)


def episodes(*outcomes: bool) -> list[Segment]:
    return [real_episode(seed, solve_at=2 if success else 99)[0] for seed, success in enumerate(outcomes)]


def test_a_segment_is_a_stretch_of_experience():
    [segment] = real_episode(1, solve_at=2)
    episode = episode_from_segments([segment], SPEC)
    frames, robot = model_arrays(segment.observations, SPEC)
    assert segment.steps.tolist() == [4, 4, 4, 1] and episode.times.tolist() == [0, 4, 8, 12, 13]
    assert np.array_equal(episode.frames, frames) and np.array_equal(episode.state, robot)
    assert np.array_equal(episode.actions[:12], segment.actions[:3].reshape(12, 2))
    assert len(episode) == 13 and episode.success_at == 12
    assert not episode_from_segments(real_episode(1), SPEC).success


def test_steps_are_pending_for_each_real_episode_up_to_a_limit():
    made = learner()
    for segment in episodes(*[False] * 20):
        made.add(segment)
        made.add(segment)  # as one that is drawn twice
        made.add(replace(segment, source=IMAGINED, origin=segment.origin._replace(task="imagined")))
    assert len(made._own) == 20 and made.pending_steps == 2 * online.MOST_PENDING


def test_a_step_for_every_twentieth_episode_is_made(monkeypatch: pytest.MonkeyPatch):
    made = learner()
    monkeypatch.setattr(made, "config", replace(made.config, steps_per_episode=0.05))
    for segment in episodes(*[False] * 21):
        made.add(segment)
    assert made.pending_steps >= 1


def test_episodes_are_put_together_from_their_segments():
    made, parts = learner(), {seed: real_episode(seed, length=1) for seed in (1, 2)}
    assert [len(p) for p in parts.values()] == [4, 4]
    for order in ([0, 2, 1], [3, 0, 1]):
        for seed in (1, 2):
            made.add(parts[seed][order.pop(0)])
    assert not made._own and made.pending_steps == 0, "neither is complete"
    for i in range(4):
        for seed in (1, 2):
            made.add(parts[seed][i])
    assert len(made._own) == 2 and made.pending_steps == 4
    whole = episode_from_segments(real_episode(1), SPEC)
    for name in ("frames", "times", "state", "actions"):
        assert np.array_equal(getattr(made._own[0], name), getattr(whole, name))


def test_what_never_ends_is_forgotten(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(online, "MOST_UNFINISHED", 2)
    made = learner()
    first, second, third = (real_episode(seed, length=2) for seed in (1, 2, 3))
    for segment in (first[0], second[0], third[0], first[1], third[1]):
        made.add(segment)
    assert len(made._own) == 1, "the third"


def test_it_learns_and_leaves_the_given_world_alone():
    given = world()
    made = OnlineLearner(given, OnlineLearnConfig(steps_per_episode=2.0))
    before, was = copied(made.world), copied(given)
    made.add(episodes(False)[0])
    assert "success" not in made.step(), "there is no success yet"
    for segment in episodes(False, False, True, False)[1:]:
        made.add(segment)
    while made.pending_steps >= 1:
        metrics = made.step()
    assert made.version == 8 and {"image", "state", "success"} <= set(metrics)
    assert any(not torch.equal(value, before[name]) for name, value in copied(made.world).items())
    assert all(torch.equal(value, was[name]) for name, value in copied(given).items())


def test_half_of_every_batch_is_from_the_dataset_it_began_with(monkeypatch: pytest.MonkeyPatch):
    offline = [episode_from_segments([segment], SPEC) for segment in episodes(False, True)]
    made = learner(offline=offline)
    for segment in episodes(*[False] * 4):
        made.add(segment)
    weights: list[np.ndarray] = []
    monkeypatch.setattr(made._trainer, "step", lambda of, drawn: weights.append(drawn) or {})
    made.step()
    assert len(weights[0]) == 2 + 4 and weights[0][:2].sum() == pytest.approx(0.5)
    assert made.learnt == {episode.key for episode in made._own}


def test_it_goes_on_from_its_state_and_a_world_takes_its_weights_over(tmp_path: Path):
    one = learner()
    for segment in episodes(False, True):
        one.add(segment)
    one.step()
    snapshot.save(tmp_path / "learner", one.state())
    other = learner()
    other.restore(snapshot.load(tmp_path / "learner"))
    assert other.pending_steps == one.pending_steps == 3 and other.version == 1
    assert one.step() == other.step()
    taken = world()
    taken.load(other.version, copied(other.world))
    assert taken.version == 2
    ours, theirs = copied(one.world), copied(taken)
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
