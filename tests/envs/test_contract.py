# SPDX-License-Identifier: Apache-2.0
"""The contract of every world; a new world is one more row of `CASES`."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from accerl_lerobot.envs import (
    EnvConfig,
    LeRobotEnvConfig,
    LiberoConfig,
    MetaWorldConfig,
    SimulatedConfig,
    World,
    make_world,
)
from accerl_lerobot.errors import InputError
from tests.envs.libero_assets import ASSETS, needs_assets

CASES: dict[str, EnvConfig] = {
    "metaworld": MetaWorldConfig(task="drawer-open-v3", max_steps=25),
    "simulated": SimulatedConfig(max_steps=25, reward="dense", hold=7),
    "pusht": LeRobotEnvConfig(name="pusht", max_steps=25, reward="env", task="Push the T onto its mark"),
}
if importlib.util.find_spec("libero"):
    CASES["libero"] = LiberoConfig(
        task="libero_object/0", max_steps=25, image_size=64, rendering="fast", assets=ASSETS
    )


@dataclass
class Case:
    world: World
    config: EnvConfig

    @property
    def task(self) -> str:
        return self.world.spec.tasks[0]

    def actions(self, count: int, seed: int = 0) -> np.ndarray:
        spec = self.world.spec
        draw = np.random.default_rng(seed).uniform(0.2, 0.8, (count, spec.action_dim))
        return (spec.action_low + draw * (spec.action_high - spec.action_low)).astype(np.float32)


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=[needs_assets] if name == "libero" else []) for name in CASES],
)
def case(request: pytest.FixtureRequest) -> Iterator[Case]:
    pytest.importorskip({"metaworld": "metaworld", "pusht": "gym_pusht"}.get(request.param, "numpy"))
    world = make_world(CASES[request.param])
    yield Case(world, CASES[request.param])
    world.close()
    world.close()


def assert_equal(one: dict, other: dict) -> None:
    assert one.keys() == other.keys()
    for key, value in one.items():
        assert np.array_equal(value, other[key]), key


def test_observation_fits_the_spec(case: Case):
    observation, spec = case.world.reset(0, case.task), case.world.spec
    assert observation.keys() == {*spec.images, "observation.state", "task"}
    for key, shape in spec.images.items():
        assert observation[key].shape == shape and observation[key].dtype == np.uint8
        assert observation[key].std() > 5, "an empty picture"
    assert observation["observation.state"].shape == (spec.state_dim,)
    assert observation["observation.state"].dtype == np.float32
    assert isinstance(observation["task"], str) and observation["task"]
    assert spec.action_low.shape == spec.action_high.shape == (spec.action_dim,)


def test_a_chunk_is_its_actions_one_by_one(case: Case):
    actions = case.actions(12)
    case.world.reset(3, case.task)
    whole = [case.world.step_chunk(part) for part in (actions[:7], actions[7:])]
    case.world.reset(3, case.task)
    single = [case.world.step_chunk(action[None]) for action in actions]
    assert_equal(whole[0].observation, single[6].observation)
    assert_equal(whole[1].observation, single[11].observation)
    assert np.array_equal(
        np.concatenate([r.rewards for r in whole]), np.concatenate([r.rewards for r in single])
    )
    assert all(np.isfinite(r.rewards).all() and r.rewards.dtype == np.float32 for r in single)
    assert (whole[1].success, whole[1].terminated) == (single[-1].success, single[-1].terminated)


def test_reset_is_reproducible_whatever_came_before(case: Case):
    first = case.world.reset(5, case.task)
    played = case.world.step_chunk(case.actions(6))
    other = case.world.reset(2_000_000_007, case.task)
    assert not np.array_equal(first["observation.state"], other["observation.state"]) or any(
        not np.array_equal(first[key], other[key]) for key in case.world.spec.images
    )
    case.world.step_chunk(case.actions(4, seed=1))
    assert_equal(first, case.world.reset(5, case.task))
    again = case.world.step_chunk(case.actions(6))
    assert_equal(played.observation, again.observation)
    assert np.array_equal(played.rewards, again.rewards)


def test_the_limit_truncates_and_cuts_the_chunk(case: Case):
    case.world.reset(1, case.task)
    idle = np.repeat((case.world.spec.action_low + case.world.spec.action_high)[None] / 2, 10, 0)
    steps = [case.world.step_chunk(idle) for _ in range(3)]
    assert [r.steps for r in steps] == [10, 10, 5]
    assert [r.truncated for r in steps] == [False, False, True]
    assert not steps[-1].terminated and not steps[-1].success
    assert steps[-1].observation is not None, "a truncated episode is bootstrapped from"
    with pytest.raises(RuntimeError, match="reset"):
        case.world.step_chunk(idle)


def test_actions_are_clipped_to_the_bounds(case: Case):
    spec = case.world.spec
    case.world.reset(1, case.task)
    clipped = case.world.step_chunk(np.repeat(spec.action_high[None], 3, 0)).observation
    case.world.reset(1, case.task)
    beyond = np.repeat((spec.action_high * 3 + 1)[None], 3, 0)
    assert_equal(clipped, case.world.step_chunk(beyond).observation)


@pytest.mark.parametrize("wrong", ["one dimension", "too wide", "empty", "nan"])
def test_a_wrong_chunk_is_refused_and_changes_nothing(case: Case, wrong: str):
    good = case.actions(3)
    bad = {
        "one dimension": good[0],
        "too wide": np.concatenate([good, good], 1),
        "empty": good[:0],
        "nan": np.full_like(good, np.nan),
    }[wrong]
    case.world.reset(4, case.task)
    with pytest.raises(ValueError, match="actions"):
        case.world.step_chunk(bad)
    after = case.world.step_chunk(good)
    case.world.reset(4, case.task)
    assert_equal(after.observation, case.world.step_chunk(good).observation)


def test_an_unknown_task_says_what_there_is(case: Case):
    with pytest.raises(InputError, match=case.task):
        case.world.reset(0, "no-such-task")


def test_render_has_the_size_asked_for_and_changes_nothing(case: Case):
    case.world.reset(6, case.task)
    plain = case.world.step_chunk(case.actions(4))
    case.world.reset(6, case.task)
    frame = case.world.render(48, 80)
    assert frame.shape == (48, 80, 3) and frame.dtype == np.uint8 and frame.std() > 5
    assert_equal(plain.observation, case.world.step_chunk(case.actions(4)).observation)


def test_stepping_before_a_reset_is_refused(case: Case):
    fresh = type(case.world)(case.config)  # type: ignore[call-arg]
    with pytest.raises(RuntimeError, match="reset"):
        fresh.step_chunk(case.actions(1))
    fresh.close()
