# SPDX-License-Identifier: Apache-2.0
"""The simulated world is solvable."""

from __future__ import annotations

import numpy as np
import pytest

from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.envs.simulated import SimulatedWorld


def held(world: SimulatedWorld, count: int = 10) -> np.ndarray:
    return np.repeat(world.solution[None], count, 0)


@pytest.mark.parametrize("task", ["match", "mirror"])
def test_holding_the_solution_succeeds_at_once(task: str):
    world = SimulatedWorld(SimulatedConfig(task="match,mirror", hold=4))
    state = world.reset(0, task)["observation.state"]
    assert np.array_equal(world.solution, state[:2] if task == "match" else -state[:2])
    result = world.step_chunk(held(world))
    assert result.terminated and result.success and result.steps == 4
    assert result.rewards.tolist() == [0, 0, 0, 1]
    assert np.array_equal(result.observation["observation.state"][2:4], world.solution)


def test_with_dense_rewards_no_success_ends_the_episode():
    world = SimulatedWorld(SimulatedConfig(reward="dense", max_steps=20))
    world.reset(0, "match")
    results = [world.step_chunk(held(world)) for _ in range(2)]
    assert results[-1].truncated and results[-1].success and results[-1].rewards.min() > 0.99


def test_the_picture_shows_the_target_and_the_actions():
    world = SimulatedWorld(SimulatedConfig(tolerance=0.01))
    pictures = [world.reset(seed, "match")["observation.images.front"] for seed in (0, 1)]
    assert not np.array_equal(*pictures)
    moved = world.step_chunk(np.full((2, 2), 0.9, np.float32)).observation["observation.images.front"]
    assert not np.array_equal(pictures[1], moved)


def test_no_picture_is_drawn_inside_a_chunk(monkeypatch: pytest.MonkeyPatch):
    drawn = []
    render = SimulatedWorld.render
    monkeypatch.setattr(SimulatedWorld, "render", lambda *args: drawn.append(1) or render(*args))
    world = SimulatedWorld(SimulatedConfig())
    world.reset(0, "match")
    world.step_chunk(np.zeros((10, 2), np.float32))
    world.step_chunk(held(world))
    assert len(drawn) == 3
