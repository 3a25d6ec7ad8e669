# SPDX-License-Identifier: Apache-2.0
"""The contract of every environment; a new environment is one more row of `CASES`."""

import importlib.util
from collections.abc import Iterator

import numpy as np
import pytest

from accerl_lerobot.envs import (
    EnvConfig,
    Environment,
    LeRobotEnvConfig,
    LiberoConfig,
    MetaWorldConfig,
    SimulatedConfig,
    make_environment,
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


def task_of(world: Environment) -> str:
    return world.spec.tasks[0]


def some_actions(world: Environment, count: int, seed: int = 0) -> np.ndarray:
    spec = world.spec
    draw = np.random.default_rng(seed).uniform(0.2, 0.8, (count, spec.action_dim))
    return (spec.action_low + draw * (spec.action_high - spec.action_low)).astype(np.float32)


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=[needs_assets] if name == "libero" else []) for name in CASES],
)
def world(request: pytest.FixtureRequest) -> Iterator[Environment]:
    pytest.importorskip({"metaworld": "metaworld", "pusht": "gym_pusht"}.get(request.param, "numpy"))
    environment = make_environment(CASES[request.param])
    yield environment
    environment.close()
    environment.close()


def test_observation_fits_the_spec(world: Environment):
    observation, spec = world.reset(0, task_of(world)), world.spec
    assert observation.keys() == {*spec.images, "observation.state", "task"}
    for key, shape in spec.images.items():
        assert observation[key].shape == shape and observation[key].dtype == np.uint8
        assert observation[key].std() > 5, "an empty picture"
    assert observation["observation.state"].shape == (spec.state_dim,)
    assert observation["observation.state"].dtype == np.float32
    assert isinstance(observation["task"], str) and observation["task"]
    assert spec.action_low.shape == spec.action_high.shape == (spec.action_dim,)


def test_a_chunk_is_its_actions_one_by_one(world: Environment):
    actions = some_actions(world, 12)
    world.reset(3, task_of(world))
    whole = [world.step_chunk(part) for part in (actions[:7], actions[7:])]
    world.reset(3, task_of(world))
    single = [world.step_chunk(action[None]) for action in actions]
    np.testing.assert_equal(whole[0].observation, single[6].observation)
    np.testing.assert_equal(whole[1].observation, single[11].observation)
    earned = [np.concatenate([result.rewards for result in results]) for results in (whole, single)]
    assert np.array_equal(*earned) and np.isfinite(earned).all() and earned[0].dtype == np.float32
    assert (whole[1].success, whole[1].terminated) == (single[-1].success, single[-1].terminated)


def test_reset_is_reproducible_whatever_came_before(world: Environment):
    first = world.reset(5, task_of(world))
    played = world.step_chunk(some_actions(world, 6))
    other = world.reset(2_000_000_007, task_of(world))
    assert any(not np.array_equal(first[key], other[key]) for key in first), "the seed matters"
    world.step_chunk(some_actions(world, 4, seed=1))
    np.testing.assert_equal(first, world.reset(5, task_of(world)))
    again = world.step_chunk(some_actions(world, 6))
    np.testing.assert_equal(played.observation, again.observation)
    assert np.array_equal(played.rewards, again.rewards)


def test_the_limit_truncates_and_cuts_the_chunk(world: Environment):
    world.reset(1, task_of(world))
    idle = np.tile((world.spec.action_low + world.spec.action_high) / 2, (10, 1))
    steps = [world.step_chunk(idle) for _ in range(3)]
    assert [r.steps for r in steps] == [10, 10, 5]
    assert [r.truncated for r in steps] == [False, False, True]
    assert not steps[-1].terminated and not steps[-1].success
    with pytest.raises(RuntimeError, match="reset"):
        world.step_chunk(idle)


def test_actions_are_clipped_to_the_bounds_and_wrong_ones_refused(world: Environment):
    spec = world.spec
    world.reset(1, task_of(world))
    clipped = world.step_chunk(np.repeat(spec.action_high[None], 3, 0)).observation
    world.reset(1, task_of(world))
    good = some_actions(world, 3)
    for bad in (good[0], np.concatenate([good, good], 1), good[:0], np.full_like(good, np.nan)):
        with pytest.raises(ValueError, match="actions"):  # which changes nothing
            world.step_chunk(bad)
    beyond = np.repeat((spec.action_high * 3 + 1)[None], 3, 0)
    np.testing.assert_equal(clipped, world.step_chunk(beyond).observation)
    with pytest.raises(InputError, match=task_of(world)):
        world.reset(0, "no-such-task")


def test_render_has_the_size_asked_for_and_changes_nothing(world: Environment):
    world.reset(6, task_of(world))
    plain = world.step_chunk(some_actions(world, 4))
    world.reset(6, task_of(world))
    frame = world.render(48, 80)
    assert frame.shape == (48, 80, 3) and frame.dtype == np.uint8 and frame.std() > 5
    np.testing.assert_equal(plain.observation, world.step_chunk(some_actions(world, 4)).observation)
