# SPDX-License-Identifier: Apache-2.0
"""Reference models, and what another world model needs: a class and an entry of the table."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.config.help import help_text
from accerl_lerobot.engine.config import RunConfig, parse
from accerl_lerobot.envs import SimulatedWorld, World, make_world
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import IMAGINED, Segment
from accerl_lerobot.world_model.config import (
    MODELS,
    ImaginationConfig,
    ModelKind,
    NetworkConfig,
    PixelModelConfig,
)
from accerl_lerobot.world_model.contract import (
    BuildInputs,
    Context,
    Prediction,
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
from tests.test_imagination import imagining, run_locally
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


class Snow(WorldModel):
    """All that a newcomer writes: everything is white after the first chunk, and nothing ever succeeds."""

    def __init__(self, means: BuildInputs) -> None:
        self.spec = replace(means.spec, provides=means.spec.provides | {"success"})

    def begin(self, context: Context, tasks: Sequence[str], resets: Sequence[Reset] | None = None) -> State:
        return {"robot": context.robot[:, -1]}

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        count = len(actions)
        size = (count, len(self.spec.cameras), *self.spec.image_size, 3)
        return Prediction(
            state=state,
            frames=torch.full(size, 255, dtype=torch.uint8),
            robot=state["robot"],
            uncertainty=torch.full((count,), torch.nan),
            success=torch.zeros(count),
        )


SNOW = ModelKind(make=f"{__name__}:Snow", what="a blizzard.", needs_path=False)


@pytest.fixture
def snow(monkeypatch: pytest.MonkeyPatch) -> None:
    """The line of the table."""
    monkeypatch.setitem(MODELS, "snow", SNOW)


@pytest.mark.usefixtures("snow")
def test_a_policy_learns_from_a_new_kind_of_imagination(tiny_checkpoint: Path):
    _, batches, engine = run_locally(imagining(tiny_checkpoint, model="snow"))
    assert engine._imagination is not None and isinstance(engine._imagination.models.model, Snow)
    imagined = [s for batch in batches for s in batch if s.source == IMAGINED]
    assert len(batches) == 12 and imagined and not any(s.success for s in imagined)
    following = 0
    for segment in imagined:
        first, *later = segment.observations["observation.images.front"]
        assert first.min() < 255, "it begins at what is real"
        assert all((frame == 255).all() for frame in later)
        following += len(later)
    assert following


@pytest.mark.usefixtures("snow")
def test_what_is_asked_of_a_config_replaces_the_table(monkeypatch: pytest.MonkeyPatch):
    def told(**line: Any) -> None:
        monkeypatch.setitem(MODELS, "snow", replace(SNOW, **line))

    with pytest.raises(InputError, match="use learned, shuffled, copy, oracle or snow$"):
        parse(RunConfig, ["--imagination.model=magic"])
    config = ImaginationConfig(share=0.5, model="snow")
    assert not config.learns
    told(needs_path=True)
    with pytest.raises(InputError, match=r"^imagination\.path=None"):
        replace(config)
    told(needs_path=True, learns=True)
    assert replace(config, path="x").learns and not replace(config, path="x", share=0.0).learns
    told(min_rollouts=3)
    with pytest.raises(InputError, match=r"^imagination\.rollouts=2: use at least 3: snow needs them"):
        replace(config, rollouts=2)


def test_the_table_is_read_without_torch():
    code = "import sys, accerl_lerobot.world_model.config; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.usefixtures("snow")
def test_help_names_them_all():
    shown = " ".join(help_text("train", RunConfig, "trains", "all").split())
    for name, kind in MODELS.items():
        assert f" {name}: {kind.what} " in shown


@pytest.mark.parametrize(
    ("name", "made"),
    [("learned", PixelWorldModel), ("shuffled", ShuffledModel), ("copy", CopyModel), ("oracle", OracleModel)],
)
def test_entries_of_the_table_are_true(name: str, made: type, tmp_path: Path):
    world, kind, path = make_world(real.WORLD), MODELS[name], None
    if kind.needs_path:
        network = NetworkConfig(channels=(8, 8), condition=8, planes=2)
        saved = PixelWorldModel(real.SPEC, PixelModelConfig(network=network))
        save_world_model(tmp_path / "world", saved, new_success_model(real.K))
        path = str(tmp_path / "world")
    config = ImaginationConfig(share=0.5, model=name, path=path)
    model, success = make_models(config, real.WORLD, world.spec, real.K, "cpu")
    assert type(model) is made and (success is None) is ("success" in model.spec.provides)
    learnt = model.model if isinstance(model, ShuffledModel) else model
    assert isinstance(learnt, PixelWorldModel) is kind.learns is config.learns
    frames = torch.zeros(1, real.SPEC.context, 1, 16, 16, 3, dtype=torch.uint8)
    robot, actions = torch.zeros(1, real.SPEC.context, 4), torch.zeros(1, real.SPEC.context - 1, real.K, 2)
    context = Context(frames, robot, actions, commanded_sum=torch.zeros(1, 2), initial_state=robot[:, 0])
    with pytest.raises(ValueError, match="reset of every") if name == "oracle" else nullcontext():
        model.begin(context, ["match"])
    if kind.min_rollouts > 1:
        with pytest.raises(ValueError, match="single rollout"):
            model.step({}, torch.zeros(kind.min_rollouts - 1, real.K, 2), [0])
    world.close()


def test_rollouts_with_other_actions_are_never_alone():
    ImaginationConfig(share=0.5, path="x", model="shuffled", rollouts=2)
    with pytest.raises(InputError, match=r"^imagination\.rollouts=1: use at least 2: shuffled needs them"):
        ImaginationConfig(share=0.5, path="x", model="shuffled", rollouts=1)
