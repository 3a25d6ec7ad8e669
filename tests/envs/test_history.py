# SPDX-License-Identifier: Apache-2.0
"""An environment that looks back, against the same one stepped one action at a time."""

import numpy as np
import pytest

from accerl_lerobot.envs import SimulatedConfig, make_environment
from accerl_lerobot.envs.base import ChunkResult
from accerl_lerobot.experience import TASK, Observation

STATE, IMAGE = "observation.state", "observation.images.front"
WORLD = SimulatedConfig(max_steps=11, tolerance=0.4, reward="dense", image_size=8)


def one_by_one(config: SimulatedConfig, actions: np.ndarray) -> tuple[list[Observation], list[ChunkResult]]:
    """Every observation of an episode, and every result."""
    environment = make_environment(config)
    seen, results = [environment.reset(5, "match")], []
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
    played = np.random.default_rng(0).uniform(-1, 1, (12, rows, 2)).astype(np.float32)
    seen, results = one_by_one(WORLD, np.concatenate(played))
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
    seen, results = one_by_one(config, np.zeros((5, 2), np.float32))
    assert 1 <= len(results) < 5
    environment = make_environment(config, 2)
    environment.reset(5, "match")
    result = environment.step_chunk(np.zeros((5, 2), np.float32))
    assert result.terminated and result.success and result.steps == len(results)
    same(result.observation, seen[-2:])
