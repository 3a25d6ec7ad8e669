# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.world_model import rollouts as starts_module
from accerl_lerobot.world_model.config import ImaginationConfig
from accerl_lerobot.world_model.contract import WorldModelSpec
from accerl_lerobot.world_model.data import model_arrays
from accerl_lerobot.world_model.rollouts import StartPool
from tests.rounding import assert_close
from tests.runs import adjusted
from tests.world_model.real_segments import SPEC, K, real_episode


def pool(spec: WorldModelSpec = SPEC, memory: int = 1000, **options: Any) -> StartPool:
    """Starts anywhere; an oracle's need their history."""
    return StartPool(spec, adjusted(ImaginationConfig, memory=memory)(**options))


def test_a_start_is_a_real_observation_with_what_led_there():
    [segment] = real_episode(3)
    held = pool()
    held.add(segment)
    frames, robot = model_arrays(segment.observations, SPEC)
    assert len(segment) == len(held) == 4
    for start in held.draw(50, np.random.default_rng(0)):
        t = start.origin.decision
        assert start.origin[:2] == ("match", 3) and start.task == segment.task
        assert np.array_equal(start.frames, frames[[max(0, t - 1), t]])
        assert np.array_equal(start.robot, robot[[max(0, t - 1), t]])
        assert np.array_equal(start.actions[0], segment.actions[t - 1] if t else np.zeros((K, 2)))
        assert start.history is not None and start.history[:2] == ("match", 3)
        assert_close(start.commanded_sum, segment.actions[:t].sum((0, 1)))
        assert np.array_equal(start.initial_state, robot[0])
        assert np.array_equal(start.history.actions, segment.actions[:t].reshape(-1, 2))


def test_where_a_segment_was_cut_the_outcome_or_the_history_is_not_known():
    first, second = real_episode(5, length=2)
    assert len(first) == len(second) == 2
    held = pool()
    held.add(first)
    assert {s.origin.decision for s in held.draw(100, np.random.default_rng(0))} == {0, 1}
    held.add(second)
    starts = {s.origin.decision: s for s in held.draw(200, np.random.default_rng(0))}
    # What the third decision's frame before showed is in a segment that may be gone.
    assert set(starts) == {0, 1, 3}
    assert starts[3].history is None and starts[3].achieved is False
    assert np.array_equal(starts[3].actions[0], second.actions[0])
    told = first.actions.sum((0, 1)) + second.actions[0].sum(0)
    assert_close(starts[3].commanded_sum, told)  # since the episode began
    assert np.array_equal(starts[3].initial_state, first.observations["observation.state"][0])
    alone = pool()
    alone.add(second)
    [start] = alone.draw(1, np.random.default_rng(0))
    assert_close(start.commanded_sum, second.actions[0].sum(0))  # since it is known
    assert np.array_equal(start.initial_state, second.observations["observation.state"][0])
    whole = pool(model="oracle")
    for segment in (first, second):
        whole.add(segment)
    assert len(whole) == 2


def test_what_led_to_a_segment_is_kept_over_several_and_when_a_pool_is_left(monkeypatch: pytest.MonkeyPatch):
    parts, [whole] = real_episode(5, length=1), real_episode(5)
    assert len(parts) == len(whole) == 4
    one, other = replace(SPEC, context=1), real_episode(6, length=1)
    held = pool(one, memory=1)
    for t, part in enumerate(parts):
        held.add(part)
        [start] = held.draw(1, np.random.default_rng(0))
        assert start.origin.decision == t
        assert_close(start.commanded_sum, whole.actions[:t].sum((0, 1)))
        assert np.array_equal(start.initial_state, whole.observations["observation.state"][0])
        again = pool(one, memory=1)
        again.restore(held.state())
        assert np.array_equal(again.draw(1, np.random.default_rng(0))[0].commanded_sum, start.commanded_sum)
        held = again
    assert not held._leads, "the episode has ended"
    monkeypatch.setattr(starts_module, "MAX_UNFINISHED", 1)
    held.add(parts[0])
    held.add(other[0])
    assert list(held._leads) == [("match", 6)]
    held.add(other[2])  # the one between was lost
    [start] = held.draw(1, np.random.default_rng(0))
    assert not start.commanded_sum.any() and start.origin.decision == 2


def test_some_begin_where_episodes_began():
    held = pool(start_at_reset_prob=0.5)
    for seed in range(3):
        held.add(real_episode(seed)[0])
    held.add(real_episode(9, length=2)[1])  # a later part
    starts = held.draw(4000, np.random.default_rng(0))
    first = Counter(s.origin.seed for s in starts if not s.origin.decision)
    # Of 13 decisions that may be chosen, three are the first of an episode.
    assert set(first) == {0, 1, 2} and sum(first.values()) == pytest.approx(
        4000 * (0.5 + 0.5 * 3 / 13), abs=150
    )
    only = pool(start_at_reset_prob=1.0)
    for seed in range(3):
        only.add(real_episode(seed)[0])
    assert {s.origin.decision for s in only.draw(100, np.random.default_rng(0))} == {0}
    assert not any(
        s.commanded_sum.any() or (s.initial_state != s.robot[-1]).any()
        for s in only.draw(9, np.random.default_rng(0))
    )


def test_to_the_end_it_is_how_the_episode_ended_that_counts():
    first, second = real_episode(5, length=2)
    [failure], [success] = real_episode(6), real_episode(7, solve_at=2)
    held = pool()
    for segment in (first, failure, success):
        held.add(segment)

    def found(of: StartPool) -> set[tuple[int, bool | None]]:
        return {(s.origin.seed, s.achieved) for s in of.draw(200, np.random.default_rng(0))}

    assert found(held) == {(5, None), (6, False), (7, True)}
    held.add(replace(second, success=True, terminated=True, truncated=False))
    assert found(held) == {(5, True), (6, False), (7, True)}
    # What is known of an episode goes when the last of it does.
    short = pool(memory=1)
    for segment in (first, second, failure):
        short.add(segment)
    assert found(short) == {(6, False)} and set(short._outcomes) == {("match", 6)}


def test_the_newest_are_kept():
    held = pool(memory=9)
    for seed in range(6):
        held.add(real_episode(seed)[0])
    assert 9 <= len(held) < 13
    assert {s.origin.seed for s in held.draw(300, np.random.default_rng(0))} == {3, 4, 5}
    with pytest.raises(ValueError, match="no real experience"):
        pool().draw(1, np.random.default_rng(0))


def test_pictures_have_the_model_s_size():
    [segment] = real_episode(3)
    frames, robot = model_arrays(segment.observations, replace(SPEC, image_size=(8, 8), state_dim=0))
    assert frames.shape == (5, 1, 8, 8, 3) and frames.dtype == np.uint8 and robot.shape == (5, 0)
    full, _ = model_arrays(segment.observations, SPEC)
    assert abs(frames.astype(float).mean() - full.mean()) < 2
    assert full.shape == (5, 1, 16, 16, 3) and K == 4
