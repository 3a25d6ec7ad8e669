# SPDX-License-Identifier: Apache-2.0
"""Deployment shift: each field changes what it names and nothing else."""

from typing import Any

import numpy as np
import pytest

from accerl_lerobot.envs import MetaWorldConfig
from accerl_lerobot.envs.metaworld import MetaWorld, ShiftConfig

pytest.importorskip("metaworld")
TASK = "push-v3"
IMAGE = "observation.images.corner2"
ACTIONS = np.random.default_rng(0).uniform(-1, 1, (30, 4)).astype(np.float32)


def environment(**shift: Any) -> MetaWorld:
    return MetaWorld(MetaWorldConfig(task=TASK, shift=ShiftConfig(**shift)))


def played(of: MetaWorld, actions: np.ndarray = ACTIONS, seed: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """MetaWorld's 39 numbers after the reset and each action, and the last frame."""
    frame = of.reset(seed, TASK)[IMAGE]
    states = [of.simulator.everything()]
    for action in actions:
        frame = of.step_chunk(action[None]).observation[IMAGE]
        states.append(of.simulator.everything())
    return np.stack(states), frame


def test_pictures_change_with_camera_and_light_and_physics_does_not():
    states, frame = played(environment())
    for shift in ({"camera": (0.0, 0.1, 0.0)}, {"light": 0.5}):
        others, other = played(environment(**shift))
        np.testing.assert_array_equal(others, states)
        assert np.abs(other.astype(int) - frame).mean() > 3
    dark = environment(light=0.5)
    assert played(dark)[1].mean() < 0.8 * frame.mean() < frame.mean()
    assert dark.config.nominal() == MetaWorldConfig(task=TASK), "demonstrations show the world without shift"


def test_friction_scales_that_of_every_surface():
    nominal, slippery = environment(), environment(friction=0.25)
    for each in (nominal, slippery):
        each.reset(0, TASK)
    a, b = (each.simulator.env.model.geom_friction for each in (nominal, slippery))
    np.testing.assert_allclose(b[:, 0], 0.25 * a[:, 0])
    np.testing.assert_array_equal(b[:, 1:], a[:, 1:])


def test_an_action_comes_so_many_steps_late_in_every_episode():
    late = environment(action_delay=3)
    first = np.concatenate([np.zeros((3, 4), np.float32), ACTIONS[:-3]])
    expected, _ = played(environment(), first)
    for _ in range(2):  # nothing is left over from the episode before
        np.testing.assert_array_equal(played(late)[0], expected)


def test_starts_come_from_wider_ranges():
    nominal, wide = environment(), environment(start_range=2.0)
    seen: dict[str, list[np.ndarray]] = {"nominal": [], "wide": []}
    for seed in range(40):
        for name, each in (("nominal", nominal), ("wide", wide)):
            each.reset(seed, TASK)
            seen[name].append(each.simulator.env._last_rand_vec)
    space = nominal.simulator.env._random_reset_space
    half = (space.high - space.low) / 2
    drawn = np.stack(seen["wide"]) - (space.high + space.low) / 2
    assert (np.abs(drawn) <= 2 * half + 1e-9).all() and (np.abs(drawn) > half + 1e-9).any(0)[:2].all()
    assert (np.abs(np.stack(seen["nominal"]) - (space.high + space.low) / 2) <= half + 1e-9).all()
