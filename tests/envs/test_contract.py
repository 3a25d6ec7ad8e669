# SPDX-License-Identifier: Apache-2.0
"""The contract of every environment; a new environment is one more row of `CASES`."""

import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass

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


@dataclass
class Case:
    environment: Environment
    config: EnvConfig

    @property
    def task(self) -> str:
        return self.environment.spec.tasks[0]

    def actions(self, count: int, seed: int = 0) -> np.ndarray:
        spec = self.environment.spec
        draw = np.random.default_rng(seed).uniform(0.2, 0.8, (count, spec.action_dim))
        return (spec.action_low + draw * (spec.action_high - spec.action_low)).astype(np.float32)


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=[needs_assets] if name == "libero" else []) for name in CASES],
)
def case(request: pytest.FixtureRequest) -> Iterator[Case]:
    pytest.importorskip({"metaworld": "metaworld", "pusht": "gym_pusht"}.get(request.param, "numpy"))
    environment = make_environment(CASES[request.param])
    yield Case(environment, CASES[request.param])
    environment.close()
    environment.close()


def assert_equal(one: dict, other: dict) -> None:
    assert one.keys() == other.keys()
    for key, value in one.items():
        assert np.array_equal(value, other[key]), key


def test_observation_fits_the_spec(case: Case):
    observation, spec = case.environment.reset(0, case.task), case.environment.spec
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
    case.environment.reset(3, case.task)
    whole = [case.environment.step_chunk(part) for part in (actions[:7], actions[7:])]
    case.environment.reset(3, case.task)
    single = [case.environment.step_chunk(action[None]) for action in actions]
    assert_equal(whole[0].observation, single[6].observation)
    assert_equal(whole[1].observation, single[11].observation)
    assert np.array_equal(
        np.concatenate([r.rewards for r in whole]), np.concatenate([r.rewards for r in single])
    )
    assert all(np.isfinite(r.rewards).all() and r.rewards.dtype == np.float32 for r in single)
    assert (whole[1].success, whole[1].terminated) == (single[-1].success, single[-1].terminated)


def test_reset_is_reproducible_whatever_came_before(case: Case):
    first = case.environment.reset(5, case.task)
    played = case.environment.step_chunk(case.actions(6))
    other = case.environment.reset(2_000_000_007, case.task)
    assert not np.array_equal(first["observation.state"], other["observation.state"]) or any(
        not np.array_equal(first[key], other[key]) for key in case.environment.spec.images
    )
    case.environment.step_chunk(case.actions(4, seed=1))
    assert_equal(first, case.environment.reset(5, case.task))
    again = case.environment.step_chunk(case.actions(6))
    assert_equal(played.observation, again.observation)
    assert np.array_equal(played.rewards, again.rewards)


def test_the_limit_truncates_and_cuts_the_chunk(case: Case):
    case.environment.reset(1, case.task)
    idle = np.repeat((case.environment.spec.action_low + case.environment.spec.action_high)[None] / 2, 10, 0)
    steps = [case.environment.step_chunk(idle) for _ in range(3)]
    assert [r.steps for r in steps] == [10, 10, 5]
    assert [r.truncated for r in steps] == [False, False, True]
    assert not steps[-1].terminated and not steps[-1].success
    assert steps[-1].observation is not None, "a truncated episode is bootstrapped from"
    with pytest.raises(RuntimeError, match="reset"):
        case.environment.step_chunk(idle)


def test_actions_are_clipped_to_the_bounds_and_wrong_ones_refused(case: Case):
    spec = case.environment.spec
    case.environment.reset(1, case.task)
    clipped = case.environment.step_chunk(np.repeat(spec.action_high[None], 3, 0)).observation
    case.environment.reset(1, case.task)
    good = case.actions(3)
    for bad in (good[0], np.concatenate([good, good], 1), good[:0], np.full_like(good, np.nan)):
        with pytest.raises(ValueError, match="actions"):  # which changes nothing
            case.environment.step_chunk(bad)
    beyond = np.repeat((spec.action_high * 3 + 1)[None], 3, 0)
    assert_equal(clipped, case.environment.step_chunk(beyond).observation)
    with pytest.raises(InputError, match=case.task):
        case.environment.reset(0, "no-such-task")


def test_render_has_the_size_asked_for_and_changes_nothing(case: Case):
    case.environment.reset(6, case.task)
    plain = case.environment.step_chunk(case.actions(4))
    case.environment.reset(6, case.task)
    frame = case.environment.render(48, 80)
    assert frame.shape == (48, 80, 3) and frame.dtype == np.uint8 and frame.std() > 5
    assert_equal(plain.observation, case.environment.step_chunk(case.actions(4)).observation)
