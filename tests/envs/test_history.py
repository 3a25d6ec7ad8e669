# SPDX-License-Identifier: Apache-2.0
"""An environment that looks back, against the same one stepped one action at a time."""

import numpy as np
import pytest

from accerl_lerobot.envs import SimulatedConfig, make_environment
from accerl_lerobot.experience import TASK, Observation

TRUNCATED = SimulatedConfig(max_steps=11, tolerance=0.4, reward="dense", image_size=8)
TERMINATED = SimulatedConfig(max_steps=11, tolerance=3.0, image_size=8)  # after four steps


def same(observation: Observation, states: list[Observation]) -> None:
    """True if it holds these states, oldest first."""
    stacked = {key: np.stack([state[key] for state in states]) for key in states[0].keys() - {TASK}}
    np.testing.assert_equal(observation, stacked | {TASK: states[-1][TASK]})


@pytest.mark.parametrize(("world", "scale", "end"), [(TRUNCATED, 1.0, 11), (TERMINATED, 0.0, 4)])
@pytest.mark.parametrize("length", [2, 3])
@pytest.mark.parametrize("rows", [1, 2, 5])
def test_the_last_states_are_seen_and_nothing_else_changes(
    rows: int, length: int, world: SimulatedConfig, scale: float, end: int
):
    played = scale * np.random.default_rng(0).uniform(-1, 1, (12, rows, 2)).astype(np.float32)
    environment = make_environment(world)
    seen, results = [environment.reset(5, "match")], []
    while not results or not results[-1].done:
        results.append(environment.step_chunk(np.concatenate(played)[len(results), None]))
        seen.append(results[-1].observation)
    environment, steps = make_environment(world, length), 0
    same(environment.reset(5, "match"), [seen[0]] * length)
    for actions in played:
        result = environment.step_chunk(actions)
        expected = results[steps : steps + result.steps]
        steps += result.steps
        assert np.array_equal(result.rewards, np.concatenate([r.rewards for r in expected]))
        assert (result.terminated, result.truncated) == (expected[-1].terminated, expected[-1].truncated)
        assert result.success == expected[-1].success
        padded = [seen[0]] * (length - 1) + seen
        same(result.observation, padded[steps : steps + length])
        if result.done:
            break
    assert steps == end == len(results)
    with pytest.raises(RuntimeError, match="reset"):
        environment.step_chunk(played[0])
    same(environment.reset(5, "match"), [seen[0]] * length)
