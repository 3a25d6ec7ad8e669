# SPDX-License-Identifier: Apache-2.0
"""Any registered Gymnasium environment with continuous actions, with LeRobot's features.

Also `GymnasiumEnvironment`, the base of all environments that step environments of Gymnasium's interface.
Importing this file loads no Gymnasium; making the environment does.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from accerl_lerobot.config.ranges import Range
from accerl_lerobot.envs.base import (
    IS_SUCCESS,
    ChunkResult,
    EnvConfig,
    EnvironmentSpec,
    EpisodeEnvironment,
    Step,
)
from accerl_lerobot.envs.graphics import close_at_exit
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import ENVIRONMENT_STATE, TASK, Observation

FPS = 20  # control rate of environments that name none
MAX_STEPS = 500  # episode limit of environments that have none
RENDER = "render"  # in `GymConfig.images`: the picture that the environment renders
RETURNS = {
    "reset": ("observation", "info"),
    "step": ("observation", "reward", "terminated", "truncated", "info"),
}
"""Values that Gymnasium's methods return; those of the older gym returned fewer."""


@dataclass(frozen=True, kw_only=True)
class GymnasiumConfig(EnvConfig):
    """Base of the configs of environments of Gymnasium's interface."""

    LIMIT: ClassVar[str]
    """The environment's own argument that limits an episode."""

    kwargs: dict[str, Any]
    max_steps: Annotated[int, Range("[0, 1000000]")] = 0
    """Episode limit in env steps; reaching it truncates. 0: the environment's own, or 500 if it has none."""
    success: str = IS_SUCCESS
    """Key of the environment's ``info`` that is true once the task is achieved, nested ones joined by dots;
    empty: its ``terminated``."""
    reward: Literal["success", "env"] = "success"
    """``success`` (1.0 at the first success, else 0.0) or ``env`` (the environment's own)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.LIMIT in self.kwargs:
            limit = self.kwargs[self.LIMIT]
            hint = f"the limit of an episode is another field; use --env.max_steps={limit} in its place"
            raise InputError(f"env.kwargs.{self.LIMIT}", limit, hint)


class GymnasiumEnvironment(EpisodeEnvironment):
    """An environment that steps environments of Gymnasium's interface, one for each of its tasks."""

    config: GymnasiumConfig
    ends_at_success: ClassVar[bool]
    """True if the first success ends an episode; otherwise the environment alone ends it."""

    def __init__(self, environments: dict[str, Any]) -> None:
        """Take in the environments, by task, and start an episode in the first of them."""
        self.max_steps = self.config.max_steps or episode_limit(next(iter(environments.values())))
        self.environments = {task: unlimited(env) for task, env in environments.items()}
        self.pictures: dict[str, np.ndarray] = {}  # images of the last observation, by camera
        self._info_keys: set[str] = set()  # seen so far: some environments have a key only when it is true
        self._task = next(iter(environments))
        self._begin(0, self._task)
        self.spec = self._look(self._observe())
        close_at_exit(self)

    @abstractmethod
    def _look(self, observation: Observation) -> EnvironmentSpec:
        """Learn sizes and features from a first observation."""

    def _processed(self, action: np.ndarray) -> np.ndarray:
        """The action as the environment takes it."""
        return action

    def _begin(self, seed: int, task: str) -> None:
        self._raw, _ = self._returned(task, "reset", seed=seed)

    def _step(self, action: np.ndarray) -> Step:
        key, chosen = self.config.success, self._processed(action)
        self._raw, reward, ended, cut, info = self._returned(self._task, "step", chosen)
        success = bool(ended)
        if key:
            told = flattened(info)
            self._info_keys |= told.keys()
            # A vector environment within keeps the last step's beside the next episode's first.
            success = any(bool(np.any(told[name])) for name in (key, f"final_info.{key}") if name in told)
        return Step(
            success=success,
            ended=bool(ended) or (success and self.ends_at_success),
            reward=float(reward) if self.config.reward == "env" else None,
            cut=bool(cut),
        )

    def _returned(self, task: str, method: str, *arguments: Any, **named: Any) -> tuple[Any, ...]:
        """The values that a method of the environment returns, if they are Gymnasium's."""
        values = getattr(self.environments[task], method)(*arguments, **named)
        if isinstance(values, tuple) and len(values) == len(RETURNS[method]):
            return values
        found = f"{len(values)} values" if isinstance(values, tuple) else f"a {type(values).__name__}"
        hint = f"its {method} returns {found}; let it return ({', '.join(RETURNS[method])}), as in Gymnasium"
        raise InputError(f"env.{self.config.named_by}", getattr(self.config, self.config.named_by), hint)

    def step_chunk(self, actions: np.ndarray) -> ChunkResult:
        result, key = super().step_chunk(actions), self.config.success
        if not result.done or not key or {key, f"final_info.{key}"} & self._info_keys:
            return result
        shown = ", ".join(sorted(self._info_keys))
        note = (
            f"env.success={key!r}: the environment's info has no such key, which counts as a failure; "
            + (f"it has {shown}" if shown else "it is empty")
            + "; name the key that tells success, or use --env.success= to take terminated for success"
        )
        return replace(result, note=note)

    def render(self, height: int, width: int) -> np.ndarray:
        env = self.environments[self._task]
        frame = env.render() if str(env.render_mode).startswith("rgb_array") else None
        if frame is None:  # a film shows what the policy sees
            frame = next(iter(self.pictures.values()), np.zeros((height, width, 3), np.uint8))
        return resized(one_picture(frame), height, width)

    def close(self) -> None:
        for env in self.environments.values():
            env.close()
        self.environments, self._done = {}, True


@EnvConfig.register_subclass("gym")
@dataclass(frozen=True, kw_only=True)
class GymConfig(GymnasiumConfig):
    """A Gymnasium environment, and which of its observations become which features.

    Keys of nested observations are joined by dots. An episode ends with its first success.
    """

    environment = "accerl_lerobot.envs.gym_env:GymEnvironment"
    named_by = "id"
    LIMIT = "max_episode_steps"

    id: str = ""
    """Name in Gymnasium's registry. The package that registers it is `discover_packages_path`."""
    kwargs: dict[str, Any] = field(default_factory=dict)
    """Arguments of ``gymnasium.make``."""
    images: dict[str, str] = field(default_factory=lambda: {"image": RENDER})
    """Camera → key of the observation, uint8 (H, W, 3), or ``render``: what the environment renders, once a
    decision. Each becomes ``observation.images.<camera>``."""
    image_size: Annotated[int, Range("[0, 1024]")] = 0
    """Height and width that images are resized to, in pixels; 0: as they are."""
    state: tuple[str, ...] = ()
    """Keys whose numbers are, in turn, ``observation.state``; empty: the observation, if it is one vector."""
    environment_state: tuple[str, ...] = ()
    """Keys whose numbers, and the share of `max_steps` gone, are ``observation.environment_state``, for
    ``algorithm.type=chunk_critic``. ``state``: the same as `state`."""
    task: str = ""
    """Instruction text."""
    fps: Annotated[int, Range("[1, 1000]")] | None = None
    """Control rate in Hz, for datasets and videos. None: the environment's ``render_fps``, or 20."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.id or ":" in self.id:
            hint = "use a name of Gymnasium's registry, and env.discover_packages_path for its package"
            raise InputError("env.id", self.id, hint)

    @functools.cached_property
    def state_size(self) -> int:
        """See the base class; only the environment knows, so it is made to ask."""
        if not self.environment_state:
            return 0
        from accerl_lerobot.envs.making import make_environment

        with contextlib.closing(make_environment(self)) as environment:
            return len(environment.reset(0, self.id)[ENVIRONMENT_STATE])


class GymEnvironment(GymnasiumEnvironment):
    """One Gymnasium environment."""

    config: GymConfig
    ends_at_success = True

    def __init__(self, config: GymConfig) -> None:
        import gymnasium

        self.config, env = config, _made(config)
        space = env.action_space
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1 or not space.is_bounded():
            raise InputError("env.id", config.id, f"actions must be a bounded vector, they are {space}")
        super().__init__({config.id: env})

    def _look(self, observation: Observation) -> EnvironmentSpec:
        config, env = self.config, self.environments[self.config.id]
        space = env.action_space
        return EnvironmentSpec(
            images={f"observation.images.{name}": picture.shape for name, picture in self.pictures.items()},
            state_dim=len(observation["observation.state"]),
            action_dim=space.shape[0],
            action_low=np.asarray(space.low, np.float32),
            action_high=np.asarray(space.high, np.float32),
            fps=config.fps or int(env.metadata.get("render_fps") or FPS),
            max_steps=self.max_steps,
            tasks=(config.id,),
            instructions=(config.task,) if config.task else (),
        )

    def _observe(self) -> Observation:
        raw, config, size = flattened(self._raw), self.config, self.config.image_size
        state = self._vector("state", raw, config.state or ("",))
        observation: Observation = {TASK: config.task, "observation.state": state}
        self.pictures = {}
        for camera, key in config.images.items():
            env = self.environments[config.id]
            picture = one_picture(env.render()) if key == RENDER else _part(raw, key, "images")
            if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
                hint = f"{key} is {picture.dtype} {picture.shape}; an image is uint8 (H, W, 3)"
                raise InputError("env.images", config.images, hint)
            self.pictures[camera] = resized(picture, size, size) if size else picture.copy()
        observation |= {f"observation.images.{name}": picture for name, picture in self.pictures.items()}
        if config.environment_state:
            keys, own = config.environment_state, config.environment_state == ("state",)
            numbers = state if own else self._vector("environment_state", raw, keys)
            observation[ENVIRONMENT_STATE] = np.append(numbers, np.float32(self.late))
        return observation

    def _vector(self, name: str, raw: dict[str, Any], keys: tuple[str, ...]) -> np.ndarray:
        parts = [_part(raw, key, name) for key in keys]
        if any(part.dtype.kind not in "fiub" for part in parts):
            raise InputError(f"env.{name}", list(keys), "name keys with numbers")
        return np.concatenate([part.astype(np.float32).ravel() for part in parts])


def _made(config: GymConfig) -> Any:
    """The environment that ``gymnasium.make`` gives; without its checker, which judges what is never read."""
    import gymnasium

    renders = {"render_mode": "rgb_array"} if RENDER in config.images.values() else {}
    try:
        return gymnasium.make(config.id, **({"disable_env_checker": True} | renders | config.kwargs))
    except gymnasium.error.VersionNotFound as error:
        raise InputError("env.id", config.id, str(error)) from error
    except gymnasium.error.UnregisteredEnv as error:
        hint = f"{error} Is env.discover_packages_path the package that registers it?"
        raise InputError("env.id", config.id, hint) from error
    except TypeError as error:
        if not any(f"unexpected keyword argument '{name}'" in str(error) for name in config.kwargs):
            raise
        hint = f"it takes {_arguments(config.id)} ({error})"
        raise InputError("env.kwargs", config.kwargs, hint) from error


def _arguments(name: str) -> str:
    """Names of the arguments that an environment takes."""
    from gymnasium.envs.registration import load_env_creator, spec

    entry = spec(name).entry_point
    creator = load_env_creator(entry) if isinstance(entry, str) else entry
    assert creator is not None
    return ", ".join(inspect.signature(creator).parameters)


def episode_limit(env: Any) -> int:
    """The limit that an environment or a wrapper of it has, in env steps; it is where LeRobot reads it."""
    try:
        limit = env.get_wrapper_attr("_max_episode_steps")
    except AttributeError:
        limit = None
    return int(limit or MAX_STEPS)


def unlimited(env: Any) -> Any:
    """An environment with its wrappers, but without Gymnasium's time limit: ours counts, and it truncates."""
    import gymnasium

    if isinstance(env, gymnasium.wrappers.TimeLimit):
        return unlimited(env.env)
    if isinstance(env, gymnasium.Wrapper):
        env.env = unlimited(env.env)
    return env


def resized(frame: np.ndarray, height: int, width: int) -> np.ndarray:
    """An image, uint8 (height, width, 3), by bilinear interpolation."""
    from PIL import Image

    return np.asarray(Image.fromarray(frame).resize((width, height), Image.Resampling.BILINEAR))


def one_picture(rendered: Any) -> np.ndarray:
    """A rendered frame as one image: several views stand beside each other."""
    views = list(rendered.values()) if isinstance(rendered, Mapping) else rendered
    several = isinstance(views, (list, tuple)) or np.ndim(views) == 4
    return np.concatenate([np.asarray(view) for view in views], axis=1) if several else np.asarray(views)


def flattened(raw: Any, prefix: str = "") -> dict[str, Any]:
    """Values of a nested mapping by their dotted keys; one that is no mapping has the key ""."""
    if not isinstance(raw, Mapping):
        return {prefix: raw}
    nested = (flattened(part, f"{prefix}.{key}" if prefix else str(key)) for key, part in raw.items())
    return {key: value for part in nested for key, value in part.items()}


def _part(raw: dict[str, Any], key: str, name: str) -> np.ndarray:
    """The array with a key, which `name`, a field, asks for."""
    if key not in raw:
        shown = ", ".join(filter(None, raw)) or "no keys: it is one array"
        raise InputError(f"env.{name}", key, f"the observation has {shown}; name some of its keys")
    return np.asarray(raw[key])
