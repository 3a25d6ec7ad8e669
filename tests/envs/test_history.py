# SPDX-License-Identifier: Apache-2.0
"""The simulated environment, and one that looks back, against the same one stepped one action at a time."""

import numpy as np
import pytest

from accerl_lerobot.envs import Environment, SimulatedConfig, make_environment
from accerl_lerobot.envs.base import ChunkResult
from accerl_lerobot.envs.simulated import SimulatedEnvironment
from accerl_lerobot.experience import TASK, Observation

STATE, IMAGE = "observation.state", "observation.images.front"
WORLD = SimulatedConfig(max_steps=11, tolerance=0.4, reward="dense", image_size=8)


def chunks(count: int, rows: int, dims: int = 2, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.uniform(-1, 1, (rows, dims)).astype(np.float32) for _ in range(count)]


def one_by_one(
    environment: Environment, task: str, actions: np.ndarray
) -> tuple[list[Observation], list[ChunkResult]]:
    """Every observation of an episode, and every result."""
    seen, results = [environment.reset(5, task)], []
    for action in actions:
        results.append(environment.step_chunk(action[None]))
        seen.append(results[-1].observation)
        if results[-1].done:
            break
    return seen, results


def same(observation: Observation, states: list[Observation]) -> None:
    """True if it holds these states, oldest first."""
    for key, value in observation.items():
        if key == TASK:
            assert value == states[-1][key]
        else:
            assert np.array_equal(value, np.stack([s[key] for s in states])), key


@pytest.mark.parametrize("length", [2, 3])
@pytest.mark.parametrize("rows", [1, 2, 4])
def test_the_last_states_are_seen_and_nothing_else_changes(rows: int, length: int):
    played = chunks(12, rows)
    seen, results = one_by_one(make_environment(WORLD), "match", np.concatenate(played))
    environment, steps = make_environment(WORLD, length), 0
    same(environment.reset(5, "match"), [seen[0]] * length)
    for actions in played:
        result = environment.step_chunk(actions)
        expected = results[steps : steps + result.steps]
        steps += result.steps
        assert np.array_equal(result.rewards, np.concatenate([r.rewards for r in expected]))
        assert (result.done, result.truncated) == (expected[-1].done, expected[-1].truncated)
        assert result.success == expected[-1].success
        assert result.observation is not None
        padded = [seen[0]] * (length - 1) + seen
        same(result.observation, padded[steps : steps + length])
        if result.done:
            break
    assert steps == 11 and result.truncated
    with pytest.raises(RuntimeError, match="reset"):
        environment.step_chunk(played[0])
    same(environment.reset(5, "match"), [seen[0]] * length)
    environment.close()


def test_a_termination_inside_a_chunk_ends_it():
    config = SimulatedConfig(max_steps=50, tolerance=3.0, image_size=8)
    seen, results = one_by_one(make_environment(config), "match", np.zeros((5, 2), np.float32))
    assert 1 <= len(results) < 5
    environment = make_environment(config, 2)
    environment.reset(5, "match")
    result = environment.step_chunk(np.zeros((5, 2), np.float32))
    assert result.terminated and result.success and result.steps == len(results)
    same(result.observation, seen[-2:])


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
