# SPDX-License-Identifier: Apache-2.0
"""Any registered Gymnasium environment with continuous actions, with LeRobot's features.

Importing this file loads no Gymnasium; making the world does.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np

from accerl_lerobot.config.ranges import Range
from accerl_lerobot.envs.base import EnvConfig, EpisodeWorld, Step, WorldSpec
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import ENVIRONMENT_STATE, TASK, Observation

logger = logging.getLogger(__name__)

FPS = 20  # control rate of environments that name none
RENDER = "render"  # in `GymConfig.images`: the picture that the environment renders


@EnvConfig.register_subclass("gym")
@dataclass(frozen=True, kw_only=True)
class GymConfig(EnvConfig):
    """A Gymnasium environment, and which of its observations become which features.

    Keys of nested observations are joined by dots. An episode ends with its first success.
    """

    world = "accerl_lerobot.envs.gym_env:GymWorld"

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
    success: str = "is_success"
    """Key of the environment's ``info`` that is true once the task is achieved; empty: its ``terminated``."""
    task: str = ""
    """Instruction text."""
    fps: Annotated[int, Range("[1, 1000]")] | None = None
    """Control rate in Hz, for datasets and videos. None: the environment's ``render_fps``, or 20."""
    reward: Literal["success", "env"] = "success"
    """``success`` (1.0 at the first success, else 0.0) or ``env`` (the environment's own)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.id or ":" in self.id:
            remedy = "use a name of Gymnasium's registry, and env.discover_packages_path for its package"
            raise InputError("env.id", self.id, remedy)

    @functools.cached_property
    def state_size(self) -> int:
        """See the base class; only the environment knows, so it is made to ask."""
        if not self.environment_state:
            return 0
        with contextlib.closing(GymWorld(self)) as world:
            return len(world.reset(0, self.id)[ENVIRONMENT_STATE])


class GymWorld(EpisodeWorld):
    """One Gymnasium environment."""

    def __init__(self, config: GymConfig) -> None:
        import gymnasium

        self.config = config
        self._pictures: dict[str, np.ndarray] = {}  # images of the last observation, by camera
        kwargs = {"render_mode": "rgb_array"} if RENDER in config.images.values() else {}
        self._tells = not config.success
        try:
            self._env = unlimited(gymnasium.make(config.id, **(kwargs | config.kwargs)))
        except (gymnasium.error.Error, TypeError, ValueError) as error:
            remedy = f"gymnasium.make refuses it ({error}); is env.discover_packages_path the package of it?"
            raise InputError("env.id", config.id, remedy) from error
        space = self._env.action_space
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1 or not space.is_bounded():
            raise InputError("env.id", config.id, f"actions must be a bounded vector, they are {space}")
        self._raw, _ = self._env.reset(seed=0)
        observation = self._observe()
        self.spec = WorldSpec(
            images={f"observation.images.{name}": picture.shape for name, picture in self._pictures.items()},
            state_dim=len(observation["observation.state"]),
            action_dim=space.shape[0],
            action_low=np.asarray(space.low, np.float32),
            action_high=np.asarray(space.high, np.float32),
            fps=config.fps or int(self._env.metadata.get("render_fps") or FPS),
            max_steps=config.max_steps,
            tasks=(config.id,),
            instructions=(config.task,) if config.task else (),
        )

    def _begin(self, seed: int, task: str) -> None:
        if self._steps and not self._tells:
            _warn_of_missing(self.config.success)
        self._raw, _ = self._env.reset(seed=seed)

    def render(self, height: int, width: int) -> np.ndarray:
        frame = self._env.render() if self._env.render_mode == "rgb_array" else None
        if frame is None:  # a film shows what the policy sees
            frame = next(iter(self._pictures.values()), np.zeros((height, width, 3), np.uint8))
        return resized(frame, height, width)

    def close(self) -> None:
        self._env.close()
        self._done = True

    def _step(self, action: np.ndarray) -> Step:
        self._raw, reward, ended, cut, info = self._env.step(action)
        self._tells = self._tells or self.config.success in info
        finite = math.isfinite(reward) and finite_numbers(self._raw)
        success = bool(info.get(self.config.success, False)) if self.config.success else bool(ended)
        return Step(
            success=success,
            ended=bool(ended) or success,
            reward=float(reward) if self.config.reward == "env" else None,
            cut=bool(cut),
            finite=finite,
        )

    def _observe(self) -> Observation:
        raw, config, size = flattened(self._raw), self.config, self.config.image_size
        state = self._vector("state", raw, config.state or ("",))
        observation: Observation = {TASK: config.task, "observation.state": state}
        self._pictures = {}
        for camera, key in config.images.items():
            picture = self._env.render() if key == RENDER else _part(raw, key, "images")
            picture = np.asarray(picture)
            if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
                remedy = f"{key} is {picture.dtype} {picture.shape}; an image is uint8 (H, W, 3)"
                raise InputError("env.images", config.images, remedy)
            self._pictures[camera] = resized(picture, size, size) if size else picture.copy()
        observation |= {f"observation.images.{name}": picture for name, picture in self._pictures.items()}
        if config.environment_state:
            keys, own = config.environment_state, config.environment_state == ("state",)
            numbers = state if own else self._vector("environment_state", raw, keys)
            late = np.float32(self._steps / config.max_steps)
            observation[ENVIRONMENT_STATE] = np.append(numbers, late)
        return observation

    def _vector(self, name: str, raw: dict[str, np.ndarray], keys: tuple[str, ...]) -> np.ndarray:
        parts = [_part(raw, key, name) for key in keys]
        if any(part.dtype.kind not in "fiub" for part in parts):
            raise InputError(f"env.{name}", list(keys), "name keys with numbers")
        return np.concatenate([part.astype(np.float32).ravel() for part in parts])


@functools.cache  # once in a process
def _warn_of_missing(key: str) -> None:
    logger.warning(
        "env.success=%r: the environment's info had no such key in an episode, which counts as a failure", key
    )


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


def flattened(raw: Any, prefix: str = "") -> dict[str, np.ndarray]:
    """Arrays of a nested observation by their dotted keys; one array has the key ""."""
    if not isinstance(raw, dict):
        return {prefix: np.asarray(raw)}
    nested = (flattened(part, f"{prefix}.{key}" if prefix else str(key)) for key, part in raw.items())
    return {key: array for part in nested for key, array in part.items()}


def _part(raw: dict[str, np.ndarray], key: str, name: str) -> np.ndarray:
    """The array with a key, which `name`, a field, asks for."""
    if key not in raw:
        shown = ", ".join(filter(None, raw)) or "no keys: it is one array"
        raise InputError(f"env.{name}", key, f"the observation has {shown}; name some of its keys")
    return raw[key]


def finite_numbers(raw: Any) -> bool:
    """True if no number of a nested observation is NaN or infinite."""
    arrays = flattened(raw).values()
    return all(bool(np.isfinite(array).all()) for array in arrays if array.dtype.kind == "f")
