# SPDX-License-Identifier: Apache-2.0
"""The simulated environment is solvable."""

from __future__ import annotations

import numpy as np
import pytest

from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.envs.simulated import SimulatedEnvironment


def held(environment: SimulatedEnvironment, count: int = 10) -> np.ndarray:
    return np.repeat(environment.solution[None], count, 0)


@pytest.mark.parametrize("task", ["match", "mirror"])
def test_holding_the_solution_succeeds_at_once(task: str):
    environment = SimulatedEnvironment(SimulatedConfig(task="match,mirror", hold=4))
    state = environment.reset(0, task)["observation.state"]
    assert np.array_equal(environment.solution, state[:2] if task == "match" else -state[:2])
    result = environment.step_chunk(held(environment))
    assert result.terminated and result.success and result.steps == 4
    assert result.rewards.tolist() == [0, 0, 0, 1]
    assert np.array_equal(result.observation["observation.state"][2:4], environment.solution)


def test_with_dense_rewards_no_success_ends_the_episode():
    environment = SimulatedEnvironment(SimulatedConfig(reward="dense", max_steps=20))
    environment.reset(0, "match")
    results = [environment.step_chunk(held(environment)) for _ in range(2)]
    assert results[-1].truncated and results[-1].success and results[-1].rewards.min() > 0.99
