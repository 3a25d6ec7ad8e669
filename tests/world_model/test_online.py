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
from accerl_lerobot.world_model.imagined import ImaginedWorld
from accerl_lerobot.world_model.learners import new_success_model
from accerl_lerobot.world_model.online import OnlineLearner, episode_from_segments, episode_weights
from accerl_lerobot.world_model.pixels import PixelWorldModel
from tests.world_model.real_segments import SPEC, K, real_episode


def learner(steps_per_episode: float = 2.0, offline: Sequence[Episode] = ()) -> OnlineLearner:
    torch.manual_seed(0)
    model = PixelWorldModel(SPEC, PixelModelConfig(channels=(8, 8)))
    world = ImaginedWorld(model, new_success_model(K))
    made = OnlineLearner(world, OnlineLearnConfig(steps_per_episode=steps_per_episode), offline, seed=0)
    made.given = model  # type: ignore[attr-defined]
    return made


def episodes(*outcomes: bool) -> list[Segment]:
    return [real_episode(seed, solve_at=2 if success else 99)[0] for seed, success in enumerate(outcomes)]


def test_a_segment_is_a_stretch_of_experience():
    [segment] = real_episode(1, solve_at=2)
    episode = episode_from_segments([segment], SPEC)
    frames, robot = model_arrays(segment.observations, SPEC)
    assert segment.steps.tolist() == [4, 4, 4, 1] and episode.times.tolist() == [0, 4, 8, 12, 13]
    assert np.array_equal(episode.frames, frames) and np.array_equal(episode.state, robot)
    assert np.array_equal(episode.actions[:12], segment.actions[:3].reshape(12, 2))
    assert (
        len(episode) == 13 and episode.success_at == 12 and episode.achieved.tolist() == [False] * 4 + [True]
    )
    failure = episode_from_segments(real_episode(1), SPEC)
    assert not failure.success and failure.own


def test_steps_are_pending_for_each_episode_up_to_a_limit():
    made = learner()
    for segment in episodes(*[False] * 20):
        made.add(segment)
        made.add(segment)  # as one that is drawn twice
    assert len(made._learnt) == 20 and made.pending_steps == 2 * online.MOST_PENDING


def test_episodes_are_put_together_from_their_segments():
    made, parts = learner(), {seed: real_episode(seed, length=1) for seed in (1, 2)}
    assert [len(p) for p in parts.values()] == [4, 4]
    for order in ([0, 2, 1], [3, 0, 1]):
        for seed in (1, 2):
            made.add(parts[seed][order.pop(0)])
    assert not made._learnt and made.pending_steps == 0, "neither is complete"
    for i in range(4):
        for seed in (1, 2):
            made.add(parts[seed][i])
    assert len(made._learnt) == 2 and made.pending_steps == 4
    whole = episode_from_segments(real_episode(1), SPEC)
    for name in ("frames", "times", "state", "actions"):
        assert np.array_equal(getattr(made._learnt[0], name), getattr(whole, name))


def test_imagined_segments_are_left_out():
    [segment] = real_episode(1)
    made = learner()
    made.add(replace(segment, source=IMAGINED))
    assert not made._learnt


def test_less_than_a_step_an_episode_is_made_later():
    made = learner(steps_per_episode=0.05)
    for segment in episodes(*[False] * 4):
        made.add(segment)
    assert made.pending_steps == pytest.approx(0.2)


def test_what_never_ends_is_forgotten(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(online, "MOST_UNFINISHED", 2)
    made = learner()
    first, second, third = (real_episode(seed, length=2) for seed in (1, 2, 3))
    for segment in (first[0], second[0], third[0], first[1], third[1]):
        made.add(segment)
    assert len(made._learnt) == 1, "the third"


def test_it_learns_from_real_windows_and_leaves_what_serves_alone():
    made = learner()
    given = made.given  # type: ignore[attr-defined]
    was = {k: v.clone() for k, v in given.state_dict().items()}
    for segment in episodes(False, False, True, False):
        made.add(segment)
    before = {k: v.clone() for k, v in made._learner.serving.state_dict().items()}
    while made.pending_steps >= 1:
        metrics = made.step()
    assert made.version == 8 and made.pending_steps < 1
    assert {"image", "state", "success_loss"} <= set(metrics)
    assert any(not torch.equal(v, before[k]) for k, v in made._learner.serving.state_dict().items())
    assert all(torch.equal(v, was[k]) for k, v in given.state_dict().items())


def test_without_a_success_only_the_world_is_learnt():
    made = learner()
    made.add(episodes(False)[0])
    assert "image" in (metrics := made.step()) and not any(k.startswith("success") for k in metrics)


def test_a_share_of_every_batch_is_from_the_dataset_it_began_with():
    offline = [episode_from_segments([s], SPEC) for s in episodes(False, True)]
    made = learner(offline=offline)
    for segment in episodes(*[False] * 4):
        made.add(segment)
    for _ in range(20):
        drawn = [p.episode for p in made._draw()]
        assert sum(e < 2 for e in drawn) == 8 and max(drawn) < 2 + 4


def test_new_and_failed_episodes_are_drawn_more_often():
    weights = episode_weights([True, False] * 4)
    assert weights.sum() == pytest.approx(1) and len(weights) == 8
    assert weights[1::2].sum() == pytest.approx(0.6)
    assert weights[6:].sum() == pytest.approx(0.7), "the newest quarter"
    assert weights[0] == pytest.approx(0.4 * 0.3 / 3) and weights[6] == pytest.approx(0.4 * 0.7)
    assert episode_weights([False] * 4).tolist() == pytest.approx([0.1, 0.1, 0.1, 0.7])
    assert episode_weights([True]).tolist() == [1]


def test_it_goes_on_from_its_state(tmp_path: Path):
    one = learner()
    for segment in episodes(False, True):
        one.add(segment)
    one.step()
    snapshot.save(tmp_path / "learner", one.state())
    other = learner()
    other.restore(snapshot.load(tmp_path / "learner"))
    assert other.pending_steps == one.pending_steps == 3 and other.version == 1
    assert one.step() == other.step()
    ours, theirs = copied(one.world), copied(other.world)
    assert all(np.array_equal(ours[name], theirs[name]) for name in ours)


def test_what_it_learned_is_taken_over_by_a_world_that_imagines():
    made = learner()
    for segment in episodes(False, True):
        made.add(segment)
    made.step()
    world = learner().world
    world.load(made.version, copied(made.world))
    assert world.version == 1
    taken = copied(world)
    assert all(np.array_equal(value, taken[name]) for name, value in copied(made.world).items())
