# SPDX-License-Identifier: Apache-2.0
"""Deployment shift: moved cameras change the images and nothing else."""

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


def played(of: MetaWorld) -> tuple[np.ndarray, np.ndarray]:
    """MetaWorld's 39 numbers after the reset and each action, and the last frame."""
    frame = of.reset(5, TASK)[IMAGE]
    states = [of.simulator.everything()]
    for action in ACTIONS:
        frame = of.step_chunk(action[None]).observation[IMAGE]
        states.append(of.simulator.everything())
    return np.stack(states), frame


def test_pictures_change_with_the_camera_and_physics_does_not():
    states, frame = played(environment())
    moved = environment(camera=(0.0, 0.1, 0.0))
    others, other = played(moved)
    np.testing.assert_array_equal(others, states)
    assert np.abs(other.astype(int) - frame).mean() > 3
    assert moved.config.nominal() == MetaWorldConfig(task=TASK), "demonstrations show the world without shift"
