# SPDX-License-Identifier: Apache-2.0
"""One demonstrated episode: a scripted expert, disturbed on purpose, in a world.

Runs in the recorder's worker processes: NumPy and a simulator, no LeRobot, no torch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from accerl_lerobot.config.parsing import imported
from accerl_lerobot.envs.base import EnvConfig, World
from accerl_lerobot.envs.metaworld import MetaWorld, expert_name, import_mujoco
from accerl_lerobot.envs.simulated import SimulatedWorld
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Observation

Expert = Callable[[], np.ndarray]
"""Gives the next action for the state its world is in."""

_DRIFT_MEMORY = 0.9
_DRIFT_SCALE = 0.5
_DRIFT_FROM = 60


@dataclass(kw_only=True)
class Episode:
    """One recorded episode; every array has one row per env step."""

    observations: dict[str, np.ndarray]
    """Before each step, under LeRobot's names."""
    actions: np.ndarray
    """float32 (T, A), as executed: noise included, clipped to the world's bounds."""
    rewards: np.ndarray
    """float32 (T,)."""
    task: str
    """The instruction text."""
    done: bool
    """True if the last step ended the episode."""
    success_at: int
    """Index of the first step after which the task was achieved; -1 for never."""
    seed: int

    @property
    def success(self) -> bool:
        return self.success_at >= 0

    def __len__(self) -> int:
        return len(self.rewards)


def make_expert(config: EnvConfig, world: World, task: str) -> Expert:
    """The scripted expert of `task`, reading the simulator's own state."""
    if config.expert is None:
        names = ", ".join(name for name, kind in config.get_known_choices().items() if kind.expert)
        raise InputError("env.type", config.type, f"scripted experts exist for: {names}")
    expert: Expert = imported(config.expert)(world, task)
    return expert


def play(
    world: World, expert: Expert, *, task: str, seed: int, noise: float, push: float, fail: bool
) -> Episode:
    """Plays one episode to its end; equal arguments give equal episodes.

    Args:
        world: Reset here with `seed`.
        expert: Reads `world`.
        task: Name of the task.
        seed: Of the world and of the noise.
        noise: Standard deviation of the Gaussian added to each action.
        push: Largest length of the constant vector that is added to what the expert wants.
        fail: If true, actions are a random drift from a random early step on.
    """
    rng = np.random.default_rng((seed, 1))
    low, high = world.spec.action_low, world.spec.action_high
    pushed = _push(world.spec.action_dim, push, seed)
    drift_from = int(rng.integers(0, _DRIFT_FROM)) if fail else world.spec.max_steps
    drift: np.ndarray = np.zeros(world.spec.action_dim)
    observation: Observation | None = world.reset(seed, task)
    done, success_at = False, -1
    seen: list[Observation] = []
    actions: list[np.ndarray] = []
    rewards: list[float] = []
    while not done:
        if len(actions) < drift_from:
            wanted = np.clip(np.asarray(expert(), np.float64), low, high) + pushed
        else:
            drift = _DRIFT_MEMORY * drift + _DRIFT_SCALE * rng.standard_normal(len(drift))
            wanted = np.clip(drift, low, high)
        action = wanted + noise * rng.standard_normal(len(wanted))
        action = np.clip(action, low, high).astype(np.float32)
        result = world.step_chunk(action[None])
        assert observation is not None
        seen.append(observation)
        actions.append(action)
        rewards.append(result.rewards[0])
        if result.success and success_at < 0:
            success_at = len(actions) - 1
        observation, done = result.observation, result.done
    return Episode(
        observations={key: np.stack([row[key] for row in seen]) for key in seen[0] if key != "task"},
        actions=np.stack(actions),
        rewards=np.asarray(rewards, np.float32),
        task=str(seen[0]["task"]),
        done=done,
        success_at=success_at,
        seed=seed,
    )


def _push(size: int, longest: float, seed: int) -> np.ndarray:
    """In any direction, and of any length up to the longest."""
    rng = np.random.default_rng((seed, 2))
    direction = rng.standard_normal(size)
    pushed: np.ndarray = longest * rng.random() * direction / np.linalg.norm(direction)
    return pushed


def metaworld_expert(world: World, task: str) -> Expert:
    """MetaWorld's own policy for the task."""
    import_mujoco()
    from metaworld import policies

    assert isinstance(world, MetaWorld)
    policy = getattr(policies, expert_name(task))()
    return lambda: policy.get_action(world.raw_observation)


def simulated_expert(world: World, task: str) -> Expert:
    """Holds the action that solves the episode."""
    assert isinstance(world, SimulatedWorld)
    return lambda: world.solution
