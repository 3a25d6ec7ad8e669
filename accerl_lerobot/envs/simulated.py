# SPDX-License-Identifier: Apache-2.0
"""A world made of nothing but time: known latency, a problem learnt in seconds, and faults on request.

For tests and for measuring the machinery around a world without a simulator's cost or noise.
"""

from __future__ import annotations

import collections
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np

from accerl_lerobot.config.ranges import NonNegative, Positive, Range, Steps
from accerl_lerobot.envs.base import ChunkResult, EnvConfig, World, WorldSpec, checked_actions
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import ENVIRONMENT_STATE, TASK, Observation

CAMERA = "front"
INSTRUCTIONS = {"match": "Match the target", "mirror": "Mirror the target"}
_SIGN = {"match": 1.0, "mirror": -1.0}
_REACH = 0.8
RESET = "reset"
"""First word of a trace's lines about resets."""


@EnvConfig.register_subclass("simulated")
@dataclass(frozen=True, kw_only=True)
class SimulatedConfig(EnvConfig):
    """How slow, how hard, how broken.

    The state holds a target; an episode succeeds as soon as the mean of the last `hold` actions is within
    `tolerance` of it in every dimension.

    Example:
        >>> SimulatedConfig(task="match", step_ms=0.2, frame_ms=6.0, latency="lognormal", latency_cv=0.5)
    """

    expert = "accerl_lerobot.demos.expert:simulated_expert"
    world = "accerl_lerobot.envs.simulated:SimulatedWorld"

    task: str = "match"
    """``match`` (the action is the target), ``mirror`` (its negative), or both separated by a comma."""
    action_dim: Annotated[int, Range("[1, 32]")] = 2
    state_dim: Annotated[int, Range("[2, 1024]")] = 4
    """At least twice `action_dim`: the target, the mean of the last actions, then zeros."""
    image_size: Annotated[int, Range("[8, 480]")] = 32
    """Height and width of ``observation.images.front`` in pixels: target green, mean action red."""
    max_steps: Annotated[int, Range("[1, 1000000]")] = 40
    """Episode limit in env steps; reaching it truncates."""
    hold: Annotated[int, Range("[1, 1000000]")] = 4
    """Number of last actions averaged; no success before so many steps."""
    tolerance: Positive = 0.25
    """Largest distance in any dimension; targets lie within ±0.8."""
    reward: Literal["success", "dense"] = "success"
    """``success`` (1.0 at the first success, else 0.0) or ``dense`` (1 − distance, each step)."""
    terminate_on_success: bool = True
    """True if the first success ends the episode."""
    environment_state: bool = False
    """True if observations hold ``observation.environment_state``: the state, and the share of `max_steps`
    gone."""
    step_ms: NonNegative = 0.0
    """Mean time an env step takes, in milliseconds; slept, so it costs no processor."""
    frame_ms: NonNegative = 0.0
    """Mean time an observation takes, in milliseconds."""
    latency: Literal["constant", "lognormal", "trace"] = "constant"
    """``constant``, ``lognormal`` or ``trace``; drawn from the episode's seed."""
    latency_cv: Annotated[float, Range("[0, 10]")] = 0.5
    """Standard deviation over mean of the lognormal law."""
    latency_trace: str | None = None
    """File that `accerl bench latency` has written of another world, scaled so that its decisions take
    `frame_ms` on average: an episode takes a stretch of it, from a moment drawn from its seed. What a reset
    takes is drawn from what resets took there."""
    crash_after: Steps = 0
    """Env steps of this instance after which it raises; 0 for never."""
    nan_after: Steps = 0
    """Env steps of this instance after which one state is NaN and its episode ends; 0 for never."""

    @property
    def state_size(self) -> int:
        """See the base class."""
        return self.state_dim + 1 if self.environment_state else 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.tasks or any(name not in INSTRUCTIONS for name in self.tasks):
            raise InputError("env.task", self.task, f"use names from: {', '.join(INSTRUCTIONS)}")
        if self.state_dim < 2 * self.action_dim:
            raise InputError("env.state_dim", self.state_dim, f"use at least {2 * self.action_dim}")
        if self.hold > self.max_steps:
            raise InputError("env.hold", self.hold, f"use 1 to env.max_steps ({self.max_steps})")
        if (self.latency == "trace") != (self.latency_trace is not None):
            remedy = "name a file of `accerl bench latency` for env.latency=trace, and for no other"
            raise InputError("env.latency_trace", self.latency_trace, remedy)
        if self.latency == "trace" and self.step_ms:
            raise InputError("env.step_ms", self.step_ms, "a trace is of whole decisions; use env.frame_ms")

    @property
    def tasks(self) -> tuple[str, ...]:
        """The task names `task` stands for."""
        return tuple(dict.fromkeys(name.strip() for name in self.task.split(",") if name.strip()))


class SimulatedWorld(World):
    """One instance; `crash_after` and `nan_after` count over all its episodes.

    Args:
        config: What to simulate.
    """

    def __init__(self, config: SimulatedConfig) -> None:
        self.config = config
        size, dims = config.image_size, config.action_dim
        self.spec = WorldSpec(
            images={f"observation.images.{CAMERA}": (size, size, 3)},
            state_dim=config.state_dim,
            action_dim=dims,
            action_low=np.full(dims, -1, np.float32),
            action_high=np.full(dims, 1, np.float32),
            fps=80,
            max_steps=config.max_steps,
            tasks=config.tasks,
            instructions=tuple(INSTRUCTIONS[task] for task in config.tasks),
        )
        self._lifetime = 0
        self._task = ""
        self._target: np.ndarray = np.zeros(dims, np.float32)
        self._recent: collections.deque[np.ndarray] = collections.deque(maxlen=config.hold)
        self._clock = np.random.default_rng(0)
        self._trace = Trace(np.ones(1), np.zeros(0))  # of constant latency
        if config.latency_trace is not None:
            self._trace = read_trace(config.latency_trace, "env.latency_trace")
        self._at = 0
        self._steps = 0
        self._success = False
        self._done = True
        self._nan = False

    @property
    def solution(self) -> np.ndarray:
        """float32 (A,): the action that solves this episode when it is held; for scripted experts."""
        return self._target * np.float32(_SIGN[self._task])

    def reset(self, seed: int, task: str) -> Observation:
        if task not in self.spec.tasks:
            raise InputError("task", task, f"this world has: {', '.join(self.spec.tasks)}")
        rng = np.random.default_rng((seed, 0))
        self._clock = np.random.default_rng((seed, 1))
        self._at = int(self._clock.integers(len(self._trace.decisions)))
        self._task = task
        self._target = rng.uniform(-_REACH, _REACH, self.config.action_dim).astype(np.float32)
        self._recent.clear()
        self._steps, self._success, self._done, self._nan = 0, False, False, False
        if len(resets := self._trace.resets):
            _wait(self.config.frame_ms / 1000 * float(self._clock.choice(resets)))
        else:
            _wait(self._delay(self.config.frame_ms))
        return self._observe()

    def step_chunk(self, actions: np.ndarray) -> ChunkResult:
        if self._done:
            raise RuntimeError("the episode is over: call reset before step_chunk")
        actions = checked_actions(actions, self.spec)
        config, rewards, delay = self.config, [], 0.0
        for action in actions:
            delay += self._delay(config.step_ms)
            self._steps += 1
            self._lifetime += 1
            if self._lifetime == config.crash_after:
                raise RuntimeError(f"simulated crash after {self._lifetime} env steps")
            self._nan = self._lifetime == config.nan_after
            self._recent.append(action)
            distance = float(np.abs(self._mean() - self.solution).max())
            succeeded = len(self._recent) == config.hold and distance <= config.tolerance
            first = succeeded and not self._success
            rewards.append(1.0 - distance if config.reward == "dense" else float(first))
            self._success |= succeeded
            terminated = not self._nan and self._success and config.terminate_on_success
            truncated = not terminated and (self._nan or self._steps >= config.max_steps)
            self._done = terminated or truncated
            if self._done:
                break
        _wait(delay + self._delay(config.frame_ms))
        return ChunkResult(
            observation=self._observe(),
            rewards=np.asarray(rewards, np.float32),
            terminated=terminated,
            truncated=truncated,
            success=self._success,
            info={"nonfinite": 1.0} if self._nan else {},
        )

    def render(self, height: int, width: int) -> np.ndarray:
        image = np.full((height, width, 3), 40, np.uint8)
        for channel, point in ((1, self._target), (0, self._mean())):
            row, column = (_pixel(point[i % len(point)], size) for i, size in ((0, height), (1, width)))
            radius = max(1, min(height, width) // 16)
            rows = slice(max(0, row - radius), row + radius + 1)
            image[rows, max(0, column - radius) : column + radius + 1, channel] = 255
        return image

    def _mean(self) -> np.ndarray:
        if not self._recent:
            return np.zeros_like(self._target)
        return np.asarray(np.mean(self._recent, axis=0, dtype=np.float32))

    def _observe(self) -> Observation:
        size, dims = self.config.image_size, self.config.action_dim
        state = np.zeros(self.config.state_dim, np.float32)
        state[:dims], state[dims : 2 * dims] = self._target, self._mean()
        if self._nan:
            state[:] = np.nan
        observation: Observation = {
            f"observation.images.{CAMERA}": self.render(size, size),
            "observation.state": state,
            TASK: INSTRUCTIONS[self._task],
        }
        if self.config.environment_state:
            late = self._steps / self.config.max_steps
            observation[ENVIRONMENT_STATE] = np.append(state, late).astype(np.float32)
        return observation

    def _delay(self, mean_ms: float) -> float:
        """Seconds, drawn anew for each step and each observation."""
        if mean_ms == 0:
            return 0.0
        if self.config.latency == "lognormal":
            variance = math.log1p(self.config.latency_cv**2)
            return mean_ms / 1000 * math.exp(self._clock.normal(-variance / 2, math.sqrt(variance)))
        self._at = (self._at + 1) % len(self._trace.decisions)
        return mean_ms / 1000 * float(self._trace.decisions[self._at])


class Trace(NamedTuple):
    """How long a world has taken, in units of its mean decision."""

    decisions: np.ndarray
    """float64 (T,), one after the other, of mean 1."""
    resets: np.ndarray
    """float64 (R,); there may be none."""


def read_trace(path: str, field: str = "latency_trace") -> Trace:
    """A text file with a duration on each line, in whatever unit, of a decision or after the word ``reset``
    of a reset; what follows a ``#`` is for people.

    Args:
        path: of the file.
        field: where it is named, for an error.

    Raises:
        InputError: it cannot be read, there is a line that is neither, or none of a decision.
    """
    try:
        text = Path(path).expanduser().read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(field, path, f"it cannot be read ({error}); use a text file") from None
    found: dict[bool, list[float]] = {True: [], False: []}
    for number, line in enumerate(text.splitlines(), start=1):
        if not (words := line.partition("#")[0].split()):
            continue
        try:
            value = float(words[-1]) if words[:-1] in ([], [RESET]) else math.nan
        except ValueError:
            value = math.nan
        if not 0 <= value < math.inf:
            remedy = f"line {number}, {line.strip()!r}, is no duration; use a number, or {RESET} and a number"
            raise InputError(field, path, remedy)
        found[len(words) > 1].append(value)
    if not sum(found[False]) > 0:
        raise InputError(field, path, "no time passes in it; write one duration on each line")
    mean = float(np.mean(found[False]))
    return Trace(np.asarray(found[False]) / mean, np.asarray(found[True]) / mean)


def _wait(delay: float) -> None:
    if delay > 0:
        time.sleep(delay)


def _pixel(value: float, size: int) -> int:
    """Where −1 … 1 lies among `size` pixels."""
    return round((float(value) + 1) / 2 * (size - 1))
