# SPDX-License-Identifier: Apache-2.0
"""The contract every world keeps, whatever simulator is behind it.

Episode limits, auto-reset and task text are ours, because simulators disagree on them: a world never resets
itself, `terminated` means the task is over (bootstrap 0), `truncated` that only time ran out (bootstrap V).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np

from accerl_lerobot.experience import Observation


@dataclass(frozen=True, kw_only=True)
class WorldSpec:
    """Sizes and features that a policy must fit to act in a world."""

    images: dict[str, tuple[int, int, int]]
    """``observation.images.<camera>`` → (H, W, 3)."""
    state_dim: int
    """Length of ``observation.state``."""
    action_dim: int
    action_low: np.ndarray
    """float32 (A,). Actions outside are clipped by the world."""
    action_high: np.ndarray
    fps: int
    """Control rate in Hz."""
    max_steps: int
    """Episode limit in env steps; reaching it truncates."""
    tasks: tuple[str, ...]
    """Names `World.reset` accepts."""
    instructions: tuple[str, ...] = ()
    """Text of each task, in the order of `tasks`; empty where the environment has none."""


@dataclass(frozen=True, kw_only=True)
class ChunkResult:
    """Outcome of one executed chunk; `rewards` has one entry per executed step, at most K."""

    observation: Observation
    """After the last executed step."""
    rewards: np.ndarray
    """float32 (k,), 1 ≤ k ≤ K: the episode may end before the chunk does."""
    terminated: bool
    truncated: bool
    success: bool
    """True if the task has been achieved at any step of the episode so far."""
    info: dict[str, float] = field(default_factory=dict)

    @property
    def steps(self) -> int:
        return len(self.rewards)

    @property
    def done(self) -> bool:
        return self.terminated or self.truncated


class World(ABC):
    """One environment instance.

    Example:
        >>> world = make_world(MetaWorldConfig(task="drawer-open-v3"))
        >>> observation = world.reset(seed=3, task="drawer-open-v3")
        >>> result = world.step_chunk(np.zeros((10, 4), np.float32))
        >>> result.steps, result.done, result.success
        (10, False, False)
    """

    spec: WorldSpec

    @abstractmethod
    def reset(self, seed: int, task: str) -> Observation:
        """Starts an episode. Equal (seed, task) give bit-equal episodes under equal actions, in any process.

        Raises:
            InputError: `task` is not in ``spec.tasks``.
        """

    @abstractmethod
    def step_chunk(self, actions: np.ndarray) -> ChunkResult:
        """Executes up to K actions and observes once, after the last.

        Gives the same states, rewards and successes as K calls with one action each.

        Args:
            actions: float32 (K, A).

        Raises:
            RuntimeError: the episode is over; call `reset`.
            ValueError: wrong shape or a non-finite action.
        """

    @abstractmethod
    def render(self, height: int, width: int) -> np.ndarray:
        """A frame for people, uint8 (height, width, 3); does not change the state."""

    def close(self) -> None:  # noqa: B027 - most worlds hold nothing
        """Frees the simulator. Safe to call twice."""


def checked_actions(actions: np.ndarray, spec: WorldSpec) -> np.ndarray:
    """The chunk as float32 within the world's bounds.

    Raises:
        ValueError: not (K ≥ 1, A), or a value is not finite.
    """
    actions = np.asarray(actions, np.float32)
    if actions.ndim != 2 or len(actions) == 0 or actions.shape[1] != spec.action_dim:
        raise ValueError(f"actions have shape {actions.shape}; expected (K >= 1, {spec.action_dim})")
    if not np.isfinite(actions).all():
        raise ValueError("actions hold a non-finite value")
    return np.clip(actions, spec.action_low, spec.action_high)
