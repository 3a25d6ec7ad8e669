# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.tensors import copied
from accerl_lerobot.experience import IMAGINED, Segment
from accerl_lerobot.world_model import online
from accerl_lerobot.world_model.config import OnlineLearnConfig, PixelModelConfig
from accerl_lerobot.world_model.data import Episode, model_arrays
from accerl_lerobot.world_model.imagined import World
from accerl_lerobot.world_model.online import OnlineLearner, episode_from_segments
from accerl_lerobot.world_model.pixels import PixelWorldModel
from tests.world_model.real_segments import SPEC, real_episode


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


def test_steps_are_pending_for_each_episode_up_to_a_limit():
    made = learner()
    for segment in episodes(*[False] * 20):
        made.add(segment)
        made.add(segment)  # as one that is drawn twice
    assert len(made._own) == 20 and made.pending_steps == 2 * online.MOST_PENDING


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


def test_imagined_segments_are_left_out():
    [segment] = real_episode(1)
    made = learner()
    made.add(replace(segment, source=IMAGINED))
    assert not made._own


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
