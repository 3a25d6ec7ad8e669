# SPDX-License-Identifier: Apache-2.0
"""The bookkeeping of one episode."""

from __future__ import annotations

import numpy as np
import pytest

from accerl_lerobot.experience import TASK, Decision, Observation, Origin, Segment
from accerl_lerobot.rollout.segments import SegmentBuilder


def observation(step: int) -> Observation:
    return {"observation.state": np.array([step], np.float32), TASK: "push"}


def decision(step: int, version: int = 0) -> Decision:
    return Decision(
        chunk=np.zeros((2, 1), np.float32),
        latent={"x": np.array([step, -step], np.float32)},
        log_prob=np.array([step / 10], np.float64),
        version=version,
    )


def collected(count: int) -> SegmentBuilder:
    builder = SegmentBuilder(observation(0), 4, Origin("push-v3", seed=7, decision=0))
    for step in range(count):
        add(builder, step, float(step), step + 1)
    return builder


def add(builder: SegmentBuilder, step: int, reward: float, steps: int) -> None:
    actions = np.full((2, 1), step / 10, np.float32)
    builder.add(decision(step, version=step), actions, reward, steps, following=observation(step + 1))


def states(segment: Segment) -> list[float]:
    return segment.observations["observation.state"][:, 0].tolist()


def test_everything_about_a_decision_stays_together():
    segment = collected(3).cut("k")
    assert len(segment) == 3 and states(segment) == [0, 1, 2, 3]
    assert segment.latent["x"].tolist() == [[0, 0], [1, -1], [2, -2]]
    np.testing.assert_allclose(segment.log_prob[:, 0], [0, 0.1, 0.2], rtol=1e-6)
    np.testing.assert_allclose(segment.actions[:, 0, 0], [0, 0.1, 0.2], rtol=1e-6)
    assert segment.reward.tolist() == [0, 1, 2] and segment.origin == ("push-v3", 7, 0)
    assert segment.version.tolist() == [0, 1, 2] and segment.steps.tolist() == [1, 2, 3]
    assert segment.log_prob.dtype == segment.reward.dtype == np.float32
    assert segment.version.dtype == segment.steps.dtype == np.int64
    assert segment.task == "push" and TASK not in segment.observations


def test_the_next_segment_begins_where_this_one_was_cut():
    builder = collected(3)
    builder.cut("k1")
    add(builder, 3, reward=0.0, steps=1)
    segment = builder.cut("k2")
    assert states(segment) == [3, 4] and segment.origin == ("push-v3", 7, 3)


def test_full_at_its_length():
    assert not collected(3).full and collected(4).full


@pytest.mark.parametrize("terminated", [False, True])
def test_how_it_ended_is_kept(terminated: bool):
    segment = collected(2).cut("k", terminated, success=terminated, episode={"return": 3.0})
    assert segment.terminated == segment.success == terminated and states(segment) == [0, 1, 2]
    assert segment.episode == {"return": 3.0} and segment.source == "real" and segment.key == "k"
