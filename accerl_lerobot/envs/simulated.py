# SPDX-License-Identifier: Apache-2.0
"""A problem that is learnt in seconds, without a simulator: for examples, tests and benchmarks."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from accerl_lerobot.config.ranges import Positive, Range
from accerl_lerobot.envs.base import EnvConfig, EpisodeEnvironment, Step, expand_tasks, unit_spec
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import ENVIRONMENT_STATE, TASK, Observation

CAMERA = "front"
ACTION_DIM = 2
INSTRUCTIONS = {"match": "Match the target", "mirror": "Mirror the target"}
GROUPS = {"all": tuple(INSTRUCTIONS)}
_SIGN = {"match": 1.0, "mirror": -1.0}
_REACH = 0.8


@EnvConfig.register_subclass("simulated")
@dataclass(frozen=True, kw_only=True)
class SimulatedConfig(EnvConfig):
    """How hard.

    The state holds a target and the mean of the last `hold` actions; an episode succeeds as soon as they are
    within `tolerance` of each other in every dimension.
    """

    expert = "accerl_lerobot.demos.record:simulated_expert"
    environment = "accerl_lerobot.envs.simulated:SimulatedEnvironment"

    task: str = "match"
    """``match`` (the action is the target), ``mirror`` (its negative), or both separated by a comma."""
    image_size: Annotated[int, Range("[8, 480]")] = 32
    """Height and width of ``observation.images.front`` in pixels: target green, mean action red."""
    max_steps: Annotated[int, Range("[1, 1000000]")] = 40
    """Episode limit in env steps; reaching it truncates."""
    hold: Annotated[int, Range("[1, 1000000]")] = 4
    """Number of last actions averaged; no success before so many steps."""
    tolerance: Positive = 0.25
    """Largest distance in any dimension; targets lie within ±0.8."""
    reward: Literal["success", "dense"] = "success"
    """``success`` (1.0 at the first success, which ends the episode) or ``dense`` (1 − distance at each step;
    no success ends the episode)."""
    environment_state: bool = False
    """True if observations hold ``observation.environment_state``: the state, and the share of time gone."""

    def __post_init__(self) -> None:
        super().__post_init__()
        expand_tasks(self.task, GROUPS)
        if self.hold > self.max_steps:  # or nothing would ever succeed
            raise InputError("env.hold", self.hold, f"use 1 to env.max_steps ({self.max_steps})")

    @property
    def tasks(self) -> tuple[str, ...]:
        """The task names `task` stands for."""
        return expand_tasks(self.task, GROUPS)


class SimulatedEnvironment(EpisodeEnvironment):
    """One instance."""

    def __init__(self, config: SimulatedConfig) -> None:
        self.config = config
        image = f"observation.images.{CAMERA}"
        self.spec = unit_spec(
            config, [image], INSTRUCTIONS.__getitem__, state=4, environment_state=4, action=ACTION_DIM, fps=80
        )
        self._target: np.ndarray = np.zeros(ACTION_DIM, np.float32)
        self._recent: deque[np.ndarray] = deque(maxlen=config.hold)

    @property
    def solution(self) -> np.ndarray:
        """float32 (A,): the action that solves this episode when it is held; for scripted experts."""
        return self._target * np.float32(_SIGN[self._task])

    def _begin(self, seed: int, task: str) -> None:
        rng = np.random.default_rng((seed, 0))
        self._target = rng.uniform(-_REACH, _REACH, ACTION_DIM).astype(np.float32)
        self._recent.clear()

    def _step(self, action: np.ndarray) -> Step:
        self._recent.append(action)
        distance = float(np.abs(self._mean() - self.solution).max())
        success = len(self._recent) == self.config.hold and distance <= self.config.tolerance
        if self.config.reward == "dense":
            return Step(success=success, ended=False, reward=1.0 - distance)
        return Step(success=success, ended=success)

    def render(self, height: int, width: int) -> np.ndarray:
        image = np.full((height, width, 3), 40, np.uint8)
        radius = max(1, min(height, width) // 16)
        last = np.array([height, width]) - 1
        for channel, point in ((1, self._target), (0, self._mean())):
            row, column = np.rint((point + 1.0) / 2 * last).astype(int)  # −1 … 1 are the image's edges
            rows = slice(max(0, row - radius), row + radius + 1)
            columns = slice(max(0, column - radius), column + radius + 1)
            image[rows, columns, channel] = 255
        return image

    def _mean(self) -> np.ndarray:
        if not self._recent:
            return np.zeros_like(self._target)
        return np.asarray(np.mean(self._recent, axis=0, dtype=np.float32))

    def _observe(self) -> Observation:
        size = self.config.image_size
        state = np.concatenate([self._target, self._mean()])
        observation: Observation = {
            f"observation.images.{CAMERA}": self.render(size, size),
            "observation.state": state,
            TASK: INSTRUCTIONS[self._task],
        }
        if self.config.environment_state:
            observation[ENVIRONMENT_STATE] = np.append(state, self.late).astype(np.float32)
        return observation
