# SPDX-License-Identifier: Apache-2.0
"""World models that a run can imagine with."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.envs import SimulatedWorld, World, make_world
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Segment
from accerl_lerobot.world_model.config import (
    ImaginationConfig,
    NetworkConfig,
    PixelModelConfig,
)
from accerl_lerobot.world_model.contract import (
    Context,
    Reset,
    State,
    WorldModel,
)
from accerl_lerobot.world_model.data import model_arrays
from accerl_lerobot.world_model.learners import new_success_model
from accerl_lerobot.world_model.pixels import PixelWorldModel
from accerl_lerobot.world_model.registry import CopyModel, OracleModel, ShuffledModel, make_models
from accerl_lerobot.world_model.rollouts import Start, StartPool
from accerl_lerobot.world_model.store import save_world_model
from tests.world_model import real_segments as real
from tests.world_model.real_segments import SPEC, WORLD, real_episode


def begun(model: WorldModel, starts: list[Start]) -> State:
    resets = [Reset(*start.origin[:2]) for start in starts]
    return model.begin(StartPool(SPEC, 1).context(starts), [start.task for start in starts], resets)


def starts_of(*seeds: int, solve_at: int = 99) -> tuple[list[Start], dict[int, Segment]]:
    pool = StartPool(SPEC, 100)
    segments = {seed: real_episode(seed, solve_at=solve_at)[0] for seed in seeds}
    for segment in segments.values():
        pool.add(segment)
    return pool.draw(12, np.random.default_rng(0)), segments


def test_starts_are_the_resets_of_the_newest_episodes():
    pool = StartPool(SPEC, 2)
    first, second = real_episode(5, length=2)
    pool.add(second)
    assert not len(pool), "its beginning is in another segment"
    for segment in (real_episode(3)[0], real_episode(4)[0], first):
        pool.add(segment)
    starts = pool.draw(50, np.random.default_rng(0))
    assert len(pool) == 2 and {start.origin for start in starts} == {("match", 4, 0), ("match", 5, 0)}
    [start] = [start for start in pool.held if start.origin.seed == 5]
    frames, robot = model_arrays(first.observations, SPEC)
    assert np.array_equal(start.frames, frames[0]) and np.array_equal(start.robot, robot[0])
    context = pool.context([start])
    assert (context.frames.numpy() == frames[0]).all() and context.frames.shape[1] == SPEC.context
    assert not context.actions.any() and not context.commanded_sum.any()
    assert np.array_equal(context.initial_state[0], robot[0])


@pytest.mark.parametrize("simulators", [1, 3, 12])
def test_the_oracle_repeats_what_happened(simulators: int):
    made: list[World] = []

    def make() -> World:
        made.append(make_world(WORLD))
        return made[-1]

    oracle = OracleModel(SPEC, make, simulators)
    assert oracle.spec.provides == {"pixels", "state", "success"}
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
    assert 1 <= len(made) <= simulators
    oracle.close()


def test_a_simulator_that_is_there_goes_on(monkeypatch: pytest.MonkeyPatch):
    resets: list[int] = []
    reset = SimulatedWorld.reset
    monkeypatch.setattr(SimulatedWorld, "reset", lambda *a: resets.append(1) or reset(*a))
    oracle = OracleModel(SPEC, lambda: make_world(WORLD), 4)
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


def test_a_copy_never_changes():
    starts, _ = starts_of(1, 2)
    copy = CopyModel(SPEC)
    state = begun(copy, starts)
    for _ in range(2):
        rollout = copy.step(state, torch.randn(12, 4, 2), [0] * 12)
        assert np.array_equal(rollout.frames.numpy(), np.stack([s.frames for s in starts]))
        assert np.array_equal(rollout.robot.numpy(), np.stack([s.robot for s in starts]))
        assert rollout.uncertainty.isnan().all() and rollout.success is None
        state = rollout.state


def test_shuffled_actions_are_those_of_the_row_before():
    starts, _ = starts_of(1, 2)
    oracle = OracleModel(SPEC, lambda: make_world(WORLD), 12)
    shuffled = ShuffledModel(oracle)
    actions = torch.rand(12, 4, 2) / 5
    got = shuffled.step(begun(shuffled, starts), actions, [0] * 12)
    wanted = oracle.step(begun(oracle, starts), actions[[11, *range(11)]], [0] * 12)
    assert torch.equal(got.robot, wanted.robot) and shuffled.spec == oracle.spec


@pytest.mark.parametrize(
    ("name", "made"),
    [("learned", PixelWorldModel), ("shuffled", ShuffledModel), ("copy", CopyModel), ("oracle", OracleModel)],
)
def test_what_a_run_can_imagine_with(name: Any, made: type, tmp_path: Path):
    world, path = make_world(real.WORLD), None
    if name != "oracle":
        network = NetworkConfig(channels=(8, 8), condition=8, planes=2)
        saved = PixelWorldModel(real.SPEC, PixelModelConfig(network=network))
        save_world_model(tmp_path / "world", saved, new_success_model(real.K))
        path = str(tmp_path / "world")
    config = ImaginationConfig(share=0.5, model=name, path=path)
    model, success = make_models(config, real.WORLD, world.spec, real.K, "cpu")
    assert type(model) is made and (success is None) is ("success" in model.spec.provides)
    learnt = model.model if isinstance(model, ShuffledModel) else model
    assert isinstance(learnt, PixelWorldModel) is config.learns
    frames = torch.zeros(1, real.SPEC.context, 1, 16, 16, 3, dtype=torch.uint8)
    robot, actions = torch.zeros(1, real.SPEC.context, 4), torch.zeros(1, real.SPEC.context - 1, real.K, 2)
    context = Context(frames, robot, actions, commanded_sum=torch.zeros(1, 2), initial_state=robot[:, 0])
    with pytest.raises(ValueError, match="reset of every") if name == "oracle" else nullcontext():
        model.begin(context, ["match"])
    if name == "shuffled":
        with pytest.raises(ValueError, match="single rollout"):
            model.step({}, torch.zeros(1, real.K, 2), [0])
    world.close()


def test_rollouts_with_other_actions_are_never_alone():
    ImaginationConfig(share=0.5, path="x", model="shuffled", rollouts=2)
    with pytest.raises(InputError, match=r"^imagination\.rollouts=1: use at least 2: shuffled needs them"):
        ImaginationConfig(share=0.5, path="x", model="shuffled", rollouts=1)
