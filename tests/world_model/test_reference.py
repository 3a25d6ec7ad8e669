# SPDX-License-Identifier: Apache-2.0
"""World models that a run can imagine with."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from accerl_lerobot.envs import Environment, make_environment
from accerl_lerobot.envs.simulated import SimulatedEnvironment
from accerl_lerobot.experience import Segment
from accerl_lerobot.world_model.contract import Reset, State, WorldModel
from accerl_lerobot.world_model.data import model_arrays
from accerl_lerobot.world_model.reference import OracleModel, ShuffledModel
from accerl_lerobot.world_model.rollouts import Start, context_at, start_of
from tests.world_model.real_segments import SPEC, WORLD, K, real_episode

WORLD_SPEC = make_environment(WORLD).spec


def begun(model: WorldModel, starts: list[Start]) -> State:
    resets = [Reset(*start.origin[:2]) for start in starts]
    return model.begin(context_at(starts, SPEC), [start.task for start in starts], resets)


def starts_of(*seeds: int, solve_at: int = 99) -> tuple[list[Start], dict[int, Segment]]:
    segments = {seed: real_episode(seed, solve_at=solve_at)[0] for seed in seeds}
    starts = [start_of(segment, SPEC) for segment in segments.values()]
    return [starts[i % len(starts)] for i in range(12)], segments


def test_a_start_is_the_reset_of_an_episode():
    [segment] = real_episode(5)
    start = start_of(segment, SPEC)
    frames, robot = model_arrays(segment.observations, SPEC)
    assert start.origin == ("match", 5, 0) and start.task == segment.task
    assert np.array_equal(start.frames, frames[0]) and np.array_equal(start.robot, robot[0])
    context = context_at([start], SPEC)
    assert (context.frames.numpy() == frames[0]).all() and context.frames.shape[1] == SPEC.context
    assert not context.actions.any() and not context.commanded_sum.any()
    assert np.array_equal(context.initial_state[0], robot[0])


def test_the_oracle_repeats_what_happened():
    made: list[Environment] = []

    def make() -> Environment:
        made.append(make_environment(WORLD))
        return made[-1]

    oracle = OracleModel(WORLD_SPEC, K, make)
    starts, segments = starts_of(1, 2, solve_at=2)
    state = begun(oracle, starts)
    for depth in range(2):
        of = [segments[s.origin.seed] for s in starts]
        actions = np.stack([segment.actions[depth] for segment in of])
        rollout = oracle.step(state, torch.from_numpy(actions), list(range(len(starts))))
        for i, segment in enumerate(of):
            frames, robot = model_arrays(segment.observations, SPEC)
            assert np.array_equal(rollout.frames[i].numpy(), frames[depth + 1])
            assert np.array_equal(rollout.robot[i].numpy(), robot[depth + 1])
            assert bool(rollout.success[i]) is (depth + 1 == len(segment) and segment.success)
        state = rollout.state
    assert len(made) == len(starts), "each goes on"
    oracle.close()


def test_a_simulator_that_is_there_goes_on(monkeypatch: pytest.MonkeyPatch):
    resets: list[int] = []
    reset = SimulatedEnvironment.reset
    monkeypatch.setattr(SimulatedEnvironment, "reset", lambda *a: resets.append(1) or reset(*a))
    oracle = OracleModel(WORLD_SPEC, K, lambda: make_environment(WORLD))
    starts, _ = starts_of(1)
    start = starts[0]
    resets.clear()
    state = begun(oracle, [start])
    actions = torch.zeros(1, 4, 2)
    first = oracle.step(state, actions, [0])
    oracle.step(first.state, actions, [0])
    assert len(resets) == 1
    again = oracle.step(state, actions, [0])  # the state of before is still good
    assert len(resets) == 2 and torch.equal(again.frames, first.frames)


def test_shuffled_actions_are_those_of_the_row_before():
    starts, _ = starts_of(1, 2)
    oracle = OracleModel(WORLD_SPEC, K, lambda: make_environment(WORLD))
    shuffled = ShuffledModel(oracle)
    actions = torch.rand(12, 4, 2) / 5
    got = shuffled.step(begun(shuffled, starts), actions, [0] * 12)
    wanted = oracle.step(begun(oracle, starts), actions[[11, *range(11)]], [0] * 12)
    assert torch.equal(got.robot, wanted.robot) and shuffled.spec == oracle.spec
