# SPDX-License-Identifier: Apache-2.0
"""Environments of Gymnasium's interface: any registered one with continuous actions, and all of LeRobot's.

LeRobot's environments disagree on autoreset, truncation and success, so the single environment is taken out
of LeRobot's vector one, and episode limits are counted here. Observations and actions pass through LeRobot's
own per-environment processors: a policy sees exactly the observations of ``lerobot-eval``.
Importing this file loads neither Gymnasium nor LeRobot; making the environment does.
"""

from __future__ import annotations

import contextlib
import io
import re
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from accerl_lerobot.config.parsing import PLUGINS, import_plugins, leaves
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
LIMIT = "_max_episode_steps"  # attribute of an environment or a wrapper of it, where LeRobot reads the limit
LENGTH = "episode_length"  # field of LeRobot's configs of environments for the limit
RENDER = "render"  # in `GymConfig.images`: the picture that the environment renders
RETURNS = {
    "reset": ("observation", "info"),
    "step": ("observation", "reward", "terminated", "truncated", "info"),
}
"""Values that Gymnasium's methods return."""
_STATE = "observation.state"
LONE_IMAGE = "observation.image"
_PINNED = re.compile(r"[\w.-]+/[\w.-]+@[0-9a-f]{40}(:\w[\w./-]*\.py)?", re.ASCII)


@dataclass(frozen=True, kw_only=True)
class GymnasiumConfig(EnvConfig):
    """Base of the configs of environments of Gymnasium's interface."""

    max_steps: Annotated[int, Range("[0, 1000000]")] = 0
    """Episode limit in env steps; reaching it truncates. 0: the environment's own, or 500 if it has none. One
    of LeRobot's without ``episode_length`` keeps its own as well."""
    success: str = IS_SUCCESS
    """Key of the environment's ``info`` that is true once the task is achieved, nested ones joined by dots;
    empty: its ``terminated``."""
    task: str = ""
    """Instruction text, for environments that have none of their own."""
    reward: Literal["success", "env"] = "success"
    """``success`` (1.0 at the first success, else 0.0) or ``env`` (the environment's own)."""


class GymnasiumEnvironment(EpisodeEnvironment):
    """An environment that steps environments of Gymnasium's interface, one for each of its tasks."""

    config: GymnasiumConfig
    ends_at_success: ClassVar[bool]
    """True if the first success ends an episode; otherwise the environment alone ends it."""

    def __init__(self, environments: dict[str, Any], fps: int) -> None:
        """Take in the environments, by task, and start an episode in the first of them to see its sizes."""
        self.environments = environments
        self._info_keys: set[str] = set()  # seen so far: some environments have a key only when it is true
        self._task = next(iter(environments))
        self._begin(0, self._task)
        observation = self._observe()
        images: dict[str, Any] = {k: np.shape(v) for k, v in observation.items() if k.startswith(LONE_IMAGE)}
        texts = [self._instruction(task) for task in environments]
        first = environments[self._task]
        limit = self.config.max_steps
        if not limit and first.has_wrapper_attr(LIMIT):
            limit = first.get_wrapper_attr(LIMIT)
        self.spec = EnvironmentSpec(
            images=images,
            state_dim=len(observation[_STATE]),
            environment_state_dim=len(observation.get(ENVIRONMENT_STATE, ())),
            action_dim=first.action_space.shape[0],
            action_low=np.asarray(first.action_space.low, np.float32),
            action_high=np.asarray(first.action_space.high, np.float32),
            fps=fps,
            max_steps=limit or MAX_STEPS,
            tasks=tuple(environments),
            instructions=tuple(text for text in texts if text),
        )
        close_at_exit(self)

    def _processed(self, action: np.ndarray) -> np.ndarray:
        """The action as the environment takes it."""
        return action

    def _instruction(self, task: str) -> str:
        """The text of a task; empty: it has none."""
        return self.config.task

    def _begin(self, seed: int, task: str) -> None:
        self._raw, _ = self._returned("reset", self.environments[task].reset(seed=seed))

    def _returned(self, method: str, values: Any) -> tuple[Any, ...]:
        """The values that a method of the environment has returned; those of the older gym are refused."""
        names = RETURNS[method]
        if isinstance(values, tuple) and len(values) == len(names):
            return values
        field = self.config.named_by
        hint = f"let its {method} return ({', '.join(names)}), as in Gymnasium"
        raise InputError(f"env.{field}", getattr(self.config, field), hint)

    def _step(self, action: np.ndarray) -> Step:
        step = self.environments[self._task].step(self._processed(action))
        self._raw, reward, ended, cut, info = self._returned("step", step)
        success = bool(ended)
        if self.config.success:
            told = dict(leaves(info))
            self._info_keys |= told.keys()
            success = bool(np.any(told.get(self.config.success, False)))
        return Step(
            success=success,
            ended=bool(ended) or (success and self.ends_at_success),
            reward=float(reward) if self.config.reward == "env" else None,
            cut=bool(cut),
        )

    def step_chunk(self, actions: np.ndarray) -> ChunkResult:
        result = super().step_chunk(actions)
        key = self.config.success
        if not result.done or not key or key in self._info_keys:
            return result
        has = ", ".join(sorted(self._info_keys)) or "no keys"
        why = f"the environment's info has no such key, which counts as a failure; it has {has}"
        hint = "name the key that tells success, or use --env.success= to take terminated for success"
        return replace(result, note=f"env.success={key!r}: {why}; {hint}")

    def render(self, height: int, width: int) -> np.ndarray:
        env = self.environments[self._task]
        if env.render_mode == "rgb_array":
            frame = env.render()
        else:  # a film shows the images of the policy
            shown = self._observe()
            frame = next((shown[key] for key in self.spec.images), np.zeros((1, 1, 3), np.uint8))
        return resized(np.asarray(frame), height, width)

    def close(self) -> None:
        for env in self.environments.values():
            env.close()
        self.environments = {}
        self._done = True


@EnvConfig.register_subclass("gym")
@dataclass(frozen=True, kw_only=True)
class GymConfig(GymnasiumConfig):
    """A Gymnasium environment, and which of its observations become which features.

    Keys of nested observations are joined by dots. An episode ends with its first success.
    """

    environment = "accerl_lerobot.envs.gym_env:GymEnvironment"
    named_by = "id"

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
    ``algorithm.type=chunk_critic``. ``state``: all of `state`, if the observation has no such key."""
    fps: Annotated[int, Range("[1, 1000]")] | None = None
    """Control rate in Hz, for datasets and videos. None: the environment's ``render_fps``, or 20."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.id or ":" in self.id:
            hint = "use a name of Gymnasium's registry, and env.discover_packages_path for its package"
            raise InputError("env.id", self.id, hint)


class GymEnvironment(GymnasiumEnvironment):
    """One Gymnasium environment."""

    config: GymConfig
    ends_at_success = True

    def __init__(self, config: GymConfig) -> None:
        import gymnasium

        self.config = config
        # Without its checker, which judges what is never read.
        options: dict[str, Any] = {"disable_env_checker": True}
        if config.max_steps:
            options["max_episode_steps"] = config.max_steps
        if RENDER in config.images.values():
            options["render_mode"] = "rgb_array"
        try:
            env: Any = gymnasium.make(config.id, **options | config.kwargs)
        except gymnasium.error.Error as error:
            hint = f"{error} Is env.discover_packages_path the package that registers it?"
            raise InputError("env.id", config.id, hint) from error
        space = env.action_space
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1 or not space.is_bounded():
            raise InputError("env.id", config.id, f"actions must be a bounded vector, they are {space}")
        fps = config.fps or int(env.metadata.get("render_fps") or FPS)
        super().__init__({config.id: env}, fps)

    def _observe(self) -> Observation:
        raw = dict(leaves(self._raw))
        config = self.config
        state = self._vector("state", raw, config.state or ("",))
        observation: Observation = {TASK: config.task, _STATE: state}
        if RENDER in config.images.values():
            raw[RENDER] = self.environments[config.id].render()
        for camera, key in config.images.items():
            picture = np.array(_part(raw, key, "images"))
            if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
                hint = f"{key} is {picture.dtype} {picture.shape}; an image is uint8 (H, W, 3)"
                raise InputError("env.images", config.images, hint)
            size = config.image_size
            if size:
                picture = resized(picture, size, size)
            observation[f"{LONE_IMAGE}s.{camera}"] = picture
        keys = config.environment_state
        if keys:
            numbers = self._vector("environment_state", {"state": state, **raw}, keys)
            observation[ENVIRONMENT_STATE] = np.append(numbers, np.float32(self.late))
        return observation

    def _vector(self, name: str, raw: dict[str, Any], keys: tuple[str, ...]) -> np.ndarray:
        parts = []
        for key in keys:
            part = _part(raw, key, name)
            if part.dtype.kind not in "fiub":
                raise InputError(f"env.{name}", list(keys), "name keys with numbers")
            parts.append(part.astype(np.float32).ravel())
        return np.concatenate(parts)


@EnvConfig.register_subclass("lerobot")
@dataclass(frozen=True, kw_only=True)
class LeRobotEnvConfig(GymnasiumConfig):
    """Which of LeRobot's environments, those of installed packages ``lerobot_env_*`` included."""

    environment = "accerl_lerobot.envs.gym_env:LeRobotEnvironment"
    named_by = "name"

    name: str = "pusht"
    """LeRobot's own name of the environment: what ``lerobot-eval --env.type`` takes."""
    kwargs: dict[str, Any] = field(default_factory=dict)
    """Fields of LeRobot's config of that environment, such as ``task`` or ``obs_type``."""
    trust_remote_code: bool = False
    """True if an environment on the Hub is run with your rights. It needs ``hub_path`` in `kwargs`, with the
    commit whose code you have read: ``owner/name@COMMIT`` or ``owner/name@COMMIT:file.py``."""
    camera: str = "image"
    """Name of a lone camera: ``observation.images.<camera>``; if empty, LeRobot's ``observation.image``,
    which policies trained on LeRobot's PushT dataset expect."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.name.startswith("libero"):
            hint = "LeRobot takes its starts in turn and not from the seed; use env.type=libero for LIBERO"
            raise InputError("env.name", self.name, hint)


class LeRobotEnvironment(GymnasiumEnvironment):
    """One of LeRobot's environments; a suite of several tasks has one simulator for each."""

    config: LeRobotEnvConfig
    ends_at_success = False

    def __init__(self, config: LeRobotEnvConfig) -> None:
        from lerobot.envs.configs import EnvConfig as LeRobotConfig
        from lerobot.envs.factory import make_env

        self.config = config
        if config.name not in LeRobotConfig.get_known_choices():
            broken = import_plugins(*PLUGINS)
            known = LeRobotConfig.get_known_choices()
            if config.name not in known:
                hint = "; ".join([*broken.values(), f"LeRobot has: {', '.join(known)}"])
                raise InputError("env.name", config.name, hint)
        kind = LeRobotConfig.get_choice_class(config.name)
        names = kind.__dataclass_fields__
        self._fields = f"LeRobot's {config.name} has the fields {', '.join(names)}"
        settings = dict(config.kwargs)
        if config.max_steps and LENGTH in names:
            if LENGTH in settings:
                hint = f"env.max_steps={config.max_steps} sets it; give one of the two"
                raise InputError(f"env.kwargs.{LENGTH}", settings[LENGTH], hint)
            settings[LENGTH] = config.max_steps
        try:
            self._settings = kind(**settings)
        except (TypeError, ValueError) as error:
            raise InputError("env.kwargs", config.kwargs, f"{error}; {self._fields}") from error
        _check_hub(config, getattr(self._settings, "hub_path", None))
        self._before, self._after = self._settings.get_env_processors()
        with contextlib.redirect_stdout(io.StringIO()):  # LeRobot prints, and results go there
            trust = config.trust_remote_code
            self._vectors = _by_task(make_env(self._settings, n_envs=1, trust_remote_code=trust))
        environments = {task: vector.envs[0] for task, vector in self._vectors.items()}
        super().__init__(environments, int(self._settings.fps))

    def _processed(self, action: np.ndarray) -> np.ndarray:
        import torch

        processed = self._after({"action": torch.from_numpy(action[None])})
        return np.asarray(processed["action"][0])

    def _instruction(self, task: str) -> str:
        env = self.environments[task].unwrapped
        for name in ("task_description", "task"):
            text = getattr(env, name, None)
            if text and isinstance(text, str):
                return text
        return self.config.task

    def close(self) -> None:
        for vector in self._vectors.values():
            vector.close()
        self._vectors = {}
        self.environments = {}
        super().close()

    def _observe(self) -> Observation:
        from lerobot.envs.utils import preprocess_observation

        text = self._instruction(self._task)
        batch = self._before({**preprocess_observation(_batched(self._raw)), TASK: [text]})
        images = [key for key in batch if key.startswith(LONE_IMAGE)]
        if _STATE not in batch or not images:
            shown = ", ".join(key for key in batch if key.startswith("observation."))
            hint = f"a policy needs images and a state, and this environment shows {shown or 'neither'}"
            with_both = "use obs_type=pixels_agent_pos"
            advice = with_both if hasattr(self._settings, "obs_type") else self._fields
            raise InputError("env.kwargs", self.config.kwargs, f"{hint}; {advice}")
        observation: Observation = {TASK: text, _STATE: batch[_STATE][0].numpy().astype(np.float32)}
        for key in images:
            name = key
            if key == LONE_IMAGE and self.config.camera:
                name = f"{LONE_IMAGE}s.{self.config.camera}"
            # LeRobot has divided by 255; rounding brings every one of the 256 values back.
            image = (batch[key][0].permute(1, 2, 0) * 255).round().byte()
            observation[name] = image.numpy().copy()
        return observation


def _check_hub(config: LeRobotEnvConfig, hub_path: str | None) -> None:
    """Refuse code from the Hub that nobody asked for, or whose version is not named."""
    if hub_path is None:
        return
    if not config.trust_remote_code:
        hint = f"{config.name} is code of {hub_path} on the Hub, which would run with your rights; read it,"
        hint += " then set this, and its commit in hub_path"
        raise InputError("env.trust_remote_code", False, hint)
    if not _PINNED.fullmatch(hub_path) or ".." in hub_path:
        hint = "name a commit, owner/name@COMMIT or owner/name@COMMIT:file.py with 40 hexadecimal digits"
        raise InputError("env.kwargs.hub_path", hub_path, f"{hint}: branches can be moved to other code")


def _by_task(vectors: dict[str, dict[int, Any]]) -> dict[str, Any]:
    """Name each vector environment ``suite/number``, or a lone one ``suite``."""
    found = {}
    for suite, tasks in vectors.items():
        for number, vector in tasks.items():
            found[f"{suite}/{number}"] = vector
    if len(found) == 1:
        return dict(zip(vectors, found.values(), strict=True))
    return found


def _batched(raw: Any) -> Any:
    """Add the leading dimension a vector environment would have added; text has none there, either."""
    if isinstance(raw, dict):
        return {key: _batched(value) for key, value in raw.items()}
    array = np.asarray(raw)
    if array.dtype.kind not in "fiub":
        return (raw,)
    return array[None]


def resized(frame: np.ndarray, height: int, width: int) -> np.ndarray:
    """An image, uint8 (height, width, 3), by bilinear interpolation."""
    from PIL import Image

    return np.asarray(Image.fromarray(frame).resize((width, height), Image.Resampling.BILINEAR))


def _part(raw: dict[str, Any], key: str, name: str) -> np.ndarray:
    """The array with a key, which `name`, a field, asks for."""
    if key not in raw:
        shown = ", ".join(filter(None, raw)) or "no keys: it is one array"
        raise InputError(f"env.{name}", key, f"the observation has {shown}; name some of its keys")
    return np.asarray(raw[key])
