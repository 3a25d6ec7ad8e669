# SPDX-License-Identifier: Apache-2.0
"""The contract every environment keeps, whatever simulator is behind it.

Episode limits, auto-reset and task text are ours, because simulators disagree on them: an environment never
resets itself, `terminated` means the task is over (bootstrap 0), `truncated` that only time ran out
(learning takes that as an end, too).
"""

from __future__ import annotations

import difflib
import json
import shlex
from abc import ABC, abstractmethod
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import draccus
import numpy as np

from accerl_lerobot.config.parsing import encoded_defaults
from accerl_lerobot.config.ranges import Range, Section, registered_name
from accerl_lerobot.envs.graphics import start_graphics
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import ENVIRONMENT_STATE, REAL, TASK, Observation
from accerl_lerobot.seeds import EVAL_SEEDS


@dataclass(frozen=True, kw_only=True)
class EnvironmentSpec:
    """Sizes and features that a policy must fit to act in an environment."""

    images: dict[str, tuple[int, int, int]]  # ``observation.images.<camera>`` → (H, W, 3)
    state_dim: int  # length of ``observation.state``
    environment_state_dim: int = 0  # length of ``observation.environment_state``; 0: observations have none
    action_dim: int
    action_low: np.ndarray  # float32 (A,). Actions outside are clipped by the environment.
    action_high: np.ndarray
    fps: int  # control rate in Hz
    labelled_fps: tuple[int, ...] = ()  # other rates that datasets of the environment name for the same
    max_steps: int  # episode limit in env steps; reaching it truncates
    tasks: tuple[str, ...]  # names `Environment.reset` accepts
    instructions: tuple[str, ...] = ()
    """Text of each task, in the order of `tasks`; empty where the environment has none."""


@dataclass(frozen=True, kw_only=True)
class ChunkResult:
    """Outcome of one executed chunk; `rewards` has one entry per executed step, at most K."""

    observation: Observation  # after the last executed step
    rewards: np.ndarray  # float32 (k,), 1 ≤ k ≤ K: the episode may end before the chunk does
    terminated: bool
    truncated: bool
    success: bool  # True if the task has been achieved at any step of the episode so far
    note: str = ""  # at the end of an episode: why its success may not be what happened
    finite: bool = True  # False if the simulator diverged: the episode must not be trained on

    @property
    def steps(self) -> int:
        return len(self.rewards)

    @property
    def done(self) -> bool:
        return self.terminated or self.truncated


class Environment(ABC):
    """One environment instance.

    Example:
        >>> environment = make_environment(MetaWorldConfig(task="drawer-open-v3"))
        >>> observation = environment.reset(seed=3, task="drawer-open-v3")
        >>> result = environment.step_chunk(np.zeros((10, 4), np.float32))
    """

    spec: EnvironmentSpec
    source: ClassVar[str] = REAL
    """Source of the segments that are collected in it: ``real`` or ``imagined``."""

    @abstractmethod
    def reset(self, seed: int, task: str) -> Observation:
        """Starts an episode; equal (seed, task) and actions give bit-equal episodes, in any process."""

    @abstractmethod
    def step_chunk(self, actions: np.ndarray) -> ChunkResult:
        """Executes up to K of the actions, float32 (K, A), and observes once, after the last.

        Gives the same states, rewards and successes as K calls with one action each.
        """

    @abstractmethod
    def render(self, height: int, width: int) -> np.ndarray:
        """A frame for people, uint8 (height, width, 3); does not change the state."""

    def state(self) -> Any:
        """The episode under way, for `restore`; None where doing it again brings it back."""
        return None

    def restore(self, state: Any) -> None:
        """Goes on with the episode of a `state`."""
        raise NotImplementedError

    def close(self) -> None:  # noqa: B027 - most environments hold nothing
        """Frees the simulator. Safe to call twice."""


class Step(NamedTuple):
    """Outcome of one env step."""

    success: bool
    ended: bool  # True if the task is over, which `success` alone need not mean
    reward: float | None = None  # None: 1.0 at the first success, else 0.0
    cut: bool = False  # True if the simulator itself ends the episode early
    finite: bool = True  # see `ChunkResult.finite`


class EpisodeEnvironment(Environment):
    """An environment that is stepped one action at a time; counts steps and decides how an episode ends."""

    _task = ""
    _steps = 0
    _success = False
    _done = True

    @abstractmethod
    def _begin(self, seed: int, task: str) -> None:
        """Resets the simulator."""

    @abstractmethod
    def _step(self, action: np.ndarray) -> Step:
        """Steps the simulator."""

    @abstractmethod
    def _observe(self) -> Observation:
        """Looks at the current state."""

    @property
    def late(self) -> float:
        """Share of the time limit gone."""
        if self._steps == 0:
            return 0.0
        return self._steps / self.spec.max_steps

    def reset(self, seed: int, task: str) -> Observation:
        if task not in self.spec.tasks:
            raise InputError("task", task, f"this environment has: {', '.join(self.spec.tasks)}")
        self._done = True  # an error below leaves an environment that must be reset
        self._begin(seed, task)
        self._task = task
        self._steps = 0
        self._success = False
        self._done = False
        return self._observe()

    def step_chunk(self, actions: np.ndarray) -> ChunkResult:
        if self._done:
            raise RuntimeError("the episode is over: call reset before step_chunk")
        rewards = []
        for action in checked_actions(actions, self.spec):
            step = self._step(action)
            self._steps += 1
            reward = step.reward
            if reward is None:
                reward = float(step.success and not self._success)
            rewards.append(reward)
            self._success |= step.success
            late = self._steps >= self.spec.max_steps
            self._done = step.ended or step.cut or late
            if self._done:
                break
        return ChunkResult(
            observation=self._observe(),
            rewards=np.asarray(rewards, np.float32),
            terminated=step.ended,
            truncated=self._done and not step.ended,
            success=self._success,
            finite=step.finite,
        )


def checked_actions(actions: np.ndarray, spec: EnvironmentSpec) -> np.ndarray:
    """The chunk as float32 within the environment's bounds; refuses other shapes than (K ≥ 1, A), and NaN."""
    actions = np.asarray(actions, np.float32)
    fit = actions.size and actions.shape[1:] == (spec.action_dim,)
    if not fit or not np.isfinite(actions).all():
        raise ValueError(f"actions {actions.shape} are not finite or not (K >= 1, {spec.action_dim})")
    return np.clip(actions, spec.action_low, spec.action_high)


@dataclass(frozen=True, kw_only=True)
class EnvConfig(Section, draccus.ChoiceRegistry, section="env"):
    """Base of every environment config; subclasses register the name that ``--env.type`` takes."""

    environment: ClassVar[str]
    """``module:class`` of the environment, made from the config."""
    named_by: ClassVar[str] = "type"
    """The field that names the environment."""
    starts: ClassVar[int | None] = None  # of a task in evaluations, which repeat them; None: one a seed
    expert: ClassVar[str | None] = None
    """``module:function`` of the scripted expert for demonstrations: given an environment and a task, it
    returns a function whose every call is the action (A,) for the state that the environment is in."""

    discover_packages_path: str | None = field(default=None, metadata={"prepares": start_graphics})
    """Package to import that registers ``env.type``, ``env.id`` or ``env.name``, where that is not one of
    ours, Gymnasium's or LeRobot's; every machine of the cluster needs it."""
    max_steps: Annotated[int, Range("[1, 1000000]")] = 500
    """Episode limit in env steps; reaching it truncates."""

    type = registered_name

    @property
    def time_limit(self) -> int:
        """Env steps of an episode at most; 0: the environment's own limit."""
        return self.max_steps

    @property
    def tells_state(self) -> bool:
        """True if observations hold ``observation.environment_state``."""
        return bool(getattr(self, "environment_state", None))

    def nominal(self) -> Self:
        """This config without deployment shift; an environment that has one overrides it."""
        return self


IS_SUCCESS = "is_success"  # LeRobot's key of ``info``


def expand_tasks(text: str, groups: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Expands names of tasks and groups, separated by commas; keeps the order, drops repetitions."""
    known = dict(groups)
    for group in groups.values():
        known |= {task: (task,) for task in group}
    found: dict[str, None] = {}
    for part in text.split(","):
        name = part.strip()
        if name not in known:
            hint = f"{name!r} is no task; "
            close = difflib.get_close_matches(name, known, cutoff=0.4)
            if close:
                hint += f"did you mean {' or '.join(close)}? "
            example = next(iter(groups.values()))[0]
            hint += f"use names such as {example}, separated by commas, or of {', '.join(groups)}"
            raise InputError("env.task", text, hint)
        found |= dict.fromkeys(known[name])
    return tuple(found)


@dataclass(frozen=True, kw_only=True)
class SuiteConfig(EnvConfig):
    """Base of the simulators that have many tasks and cameras."""

    groups: ClassVar[Callable[[], Mapping[str, Sequence[str]]]]
    """Tasks of each group that `task` may name."""
    CAMERAS: ClassVar[tuple[str, ...]]
    """Names that `camera` may have."""

    task: str
    camera: str
    image_size: int
    environment_state: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        expand_tasks(self.task, type(self).groups())
        known = set(self.cameras) & set(self.CAMERAS)
        if len(known) < len(self.cameras):
            hint = f"name each camera once, separated by commas, of: {', '.join(self.CAMERAS)}"
            raise InputError("env.camera", self.camera, hint)

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks that `task` stands for."""
        return expand_tasks(self.task, type(self).groups())

    @property
    def cameras(self) -> tuple[str, ...]:
        """The camera names that `camera` stands for."""
        return tuple(name.strip() for name in self.camera.split(","))


def unit_spec(
    config: Any,
    images: Iterable[str],
    instruction: Callable[[str], str],
    *,
    state: int,
    environment_state: int,
    action: int,
    fps: int,
) -> EnvironmentSpec:
    """Spec of an environment whose images are squares and whose actions lie in [−1, 1].

    `environment_state` is the length of ``observation.environment_state`` without the share of time gone.
    """
    return EnvironmentSpec(
        images=dict.fromkeys(images, (config.image_size, config.image_size, 3)),
        state_dim=state,
        environment_state_dim=environment_state + 1 if config.environment_state else 0,
        action_dim=action,
        action_low=np.full(action, -1, np.float32),
        action_high=np.full(action, 1, np.float32),
        fps=fps,
        max_steps=config.time_limit,
        tasks=config.tasks,
        instructions=tuple(map(instruction, config.tasks)),
    )


_spare: dict[str, dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
"""Simulators that no environment has, by config and task."""


class SuiteEnvironment(EpisodeEnvironment):
    """An environment of many tasks; simulators are kept, and shared by environments that play the same tasks
    in turn."""

    simulator: Any = None  # of the current task; for experts, not for policies

    def __init__(self, config: SuiteConfig, spec: EnvironmentSpec) -> None:
        self.config = config
        self.spec = spec
        self._spare = _spare[repr(config)]

    @abstractmethod
    def _build(self, task: str) -> Any:
        """Builds a simulator: it has `reset`, `step`, which tells success and if all numbers are finite,
        `state`, `everything` (numbers of ``observation.environment_state``), `render` and `close`."""

    def _begin(self, seed: int, task: str) -> None:
        if self.simulator is None or self._task != task:
            self._put_back()
            try:
                self.simulator = self._spare[task].pop()
            except IndexError:  # LeRobot plays tasks in threads, so looking first would not do
                self.simulator = self._build(task)
            self._task = task
        self.simulator.reset(seed)

    def _put_back(self) -> None:
        if self.simulator is not None:
            self._spare[self._task].append(self.simulator)
        self.simulator = None

    def _step(self, action: np.ndarray) -> Step:
        success, finite = self.simulator.step(action)
        solved = success and finite
        return Step(success=solved, ended=solved, cut=not finite, finite=finite)

    def render(self, height: int, width: int) -> np.ndarray:
        return np.asarray(self.simulator.render(self.config.cameras[0], height, width))

    def close(self) -> None:
        self._put_back()
        for simulators in self._spare.values():
            while simulators:
                simulators.pop().close()
        self._done = True

    def _observe(self) -> Observation:
        simulator = self.simulator
        spec = self.spec
        size = self.config.image_size
        observation: Observation = {}
        for camera, key in zip(self.config.cameras, spec.images, strict=True):
            observation[key] = simulator.render(camera, size, size)
        observation["observation.state"] = simulator.state()
        if self.config.environment_state:
            numbers = np.append(simulator.everything(), self.late)
            observation[ENVIRONMENT_STATE] = numbers.astype(np.float32)
        observation[TASK] = spec.instructions[spec.tasks.index(self._task)]
        return observation


def lerobot_eval_arguments(env: Mapping[str, Any], renames: Mapping[str, str]) -> list[str]:
    """``--env.…``, names and seed of stock ``lerobot-eval``; none if the environment is of no known type.

    `renames` is the run's ``policy.rename_map``.
    """
    kind = env.get("type")
    if kind not in EnvConfig.get_known_choices():
        return []
    # Only what differs from the defaults, as the run wrote them.
    usual = encoded_defaults(EnvConfig.get_choice_class(kind))
    given = {name: value for name, value in env.items() if value != usual.get(name)}
    plugin = "accerl_lerobot.envs.lerobot_plugin"
    fields = {"discover_packages_path": plugin, "type": "accerl", "environment": json.dumps(given)}
    if "discover_packages_path" in given:
        fields["environment.discover_packages_path"] = given["discover_packages_path"]
    arguments = [f"--env.{name}={shlex.quote(str(value))}" for name, value in fields.items()]
    if renames:
        arguments.append(f"--rename_map={shlex.quote(json.dumps(renames))}")
    arguments.append(f"--seed={EVAL_SEEDS.start}")  # the starts of our evaluation of a run with seed 0
    return arguments


class WrappedEnvironment(Environment):
    """Base of environments that change what another one shows."""

    def __init__(self, environment: Environment) -> None:
        self._environment = environment
        self.spec = environment.spec

    def reset(self, seed: int, task: str) -> Observation:
        return self._environment.reset(seed, task)

    def render(self, height: int, width: int) -> np.ndarray:
        return self._environment.render(height, width)

    def close(self) -> None:
        self._environment.close()


class HistoryEnvironment(WrappedEnvironment):
    """An environment whose observations hold its last states, in a dimension of `length` in front of each
    array.

    LeRobot's ``n_obs_steps`` counts env steps, not decisions, so the last states of a chunk are looked at one
    by one, those before them are not. An episode begins with copies of its first observation, as in LeRobot's
    queues; where one ends early, its last observation stands for those that were not looked at.
    """

    def __init__(self, environment: Environment, length: int) -> None:
        super().__init__(environment)
        self._seen: deque[Observation] = deque(maxlen=length)
        self._length = length
        self._left = 0

    def reset(self, seed: int, task: str) -> Observation:
        self._seen.extend([self._environment.reset(seed, task)] * self._length)
        self._left = self.spec.max_steps
        return self._observation()

    def step_chunk(self, actions: np.ndarray) -> ChunkResult:
        actions = checked_actions(actions, self.spec)
        if self._left:  # after the end, the environment itself complains
            actions = actions[: self._left]
        unseen = max(1, len(actions) - self._length + 1)
        parts = [actions[:unseen], *actions[unseen:, None]]
        results: list[ChunkResult] = []
        for part in parts:
            result = self._environment.step_chunk(part)
            results.append(result)
            self._seen.append(result.observation)
            if result.done:
                break
        if results[0].steps > 1:  # some were passed unseen; `length` follow, unless it was cut
            self._seen.extend([self._seen[-1]] * (self._length - len(results)))
        rewards = np.concatenate([each.rewards for each in results])
        self._left -= len(rewards)
        return replace(result, observation=self._observation(), rewards=rewards)

    def _observation(self) -> Observation:
        observation = dict(self._seen[-1])
        for key, value in observation.items():
            if isinstance(value, np.ndarray):
                observation[key] = np.stack([np.asarray(o[key]) for o in self._seen])
        return observation
