# SPDX-License-Identifier: Apache-2.0
"""Our MetaWorld and LIBERO in stock LeRobot: ``lerobot-eval`` and ``lerobot-train`` on the world we train in.

``--env.discover_packages_path=accerl_lerobot.envs.lerobot_plugin --env.type=accerl_metaworld``. A package and
not a module, because LeRobot's plugin loader looks for submodules.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import gymnasium as gym
import numpy as np
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end

from accerl_lerobot.envs import EnvConfig as WorldConfig
from accerl_lerobot.envs import LiberoConfig, MetaWorldConfig, make_world
from accerl_lerobot.envs.libero_simulator import FPS as LIBERO_FPS
from accerl_lerobot.envs.metaworld import FPS, ShiftConfig
from accerl_lerobot.experience import Observation

VIDEO_SIZE = 256


class AccerlEnv(gym.Env):
    """One task of a `World` as a Gymnasium environment; it never resets itself."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}
    render_mode = "rgb_array"

    def __init__(self, config: WorldConfig, task: str) -> None:
        # Builds its simulator at the first reset, in whatever process that is.
        self._world = make_world(config)
        spec = self._world.spec
        self.task, self.task_description = task, spec.instructions[spec.tasks.index(task)]
        self.metadata = self.metadata | {"render_fps": spec.fps}
        self._max_episode_steps = config.max_steps  # LeRobot's rollout asks for it under this name
        images = {_camera(key): gym.spaces.Box(0, 255, size, np.uint8) for key, size in spec.images.items()}
        state = gym.spaces.Box(-np.inf, np.inf, (spec.state_dim,), np.float32)
        self.observation_space = gym.spaces.Dict({"pixels": gym.spaces.Dict(images), "agent_pos": state})
        self.action_space = gym.spaces.Box(spec.action_low, spec.action_high, dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**32))
        return self._format(self._world.reset(seed, self.task)), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        result = self._world.step_chunk(np.asarray(action, np.float32)[None])
        info = {"is_success": result.success, **result.info}
        observation = self._format(result.observation)
        return observation, float(result.rewards[0]), result.terminated, result.truncated, info

    def render(self) -> np.ndarray:
        return self._world.render(VIDEO_SIZE, VIDEO_SIZE)

    def close(self) -> None:
        self._world.close()

    def _format(self, observation: Observation) -> dict[str, Any]:
        pixels = {_camera(key): observation[key] for key in self._world.spec.images}
        return {"pixels": pixels, "agent_pos": observation["observation.state"]}


@dataclass
class AccerlEnvConfig(EnvConfig):
    """The fields that LeRobot needs of any world of ours."""

    world: ClassVar[type[WorldConfig]]

    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        spec = make_world(self.world_config).spec  # refuses bad values now
        self.features = {
            "action": PolicyFeature(type=FeatureType.ACTION, shape=(spec.action_dim,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(spec.state_dim,)),
        }
        self.features_map = {"action": "action", "agent_pos": "observation.state"}
        for key, size in spec.images.items():
            name = f"pixels/{_camera(key)}"
            self.features[name] = PolicyFeature(type=FeatureType.VISUAL, shape=size)
            self.features_map[name] = key

    @property
    def world_config(self) -> WorldConfig:
        """The world behind every environment made from this config: its fields that this one has too."""
        names = {own.name for own in dataclasses.fields(self.world)}
        given = {name: value for name, value in vars(self).items() if name in names}
        if "shift" in given:
            given["shift"] = ShiftConfig(**given["shift"])
        return self.world(**given)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """One vector environment per task, as ``{task: {0: vector}}``."""
        config, vectors, kind = self.world_config, {}, gym.vector.SyncVectorEnv
        if use_async_envs and n_envs > 1:
            kind = functools.partial(gym.vector.AsyncVectorEnv, context="forkserver")
        for task in make_world(config).spec.tasks:
            # A finished environment waits for its batch without simulating an episode nobody sees.
            make = freeze_after_episode_end(functools.partial(AccerlEnv, config, task))
            vectors[task] = {0: kind([make] * n_envs)}
        return vectors


@EnvConfig.register_subclass("accerl_metaworld")
@dataclass
class AccerlMetaWorldEnvConfig(AccerlEnvConfig):
    """`MetaWorldConfig` as LeRobot spells configs; see there for the meaning and range of each field."""

    world = MetaWorldConfig

    task: str | None = "drawer-open-v3"
    fps: int = FPS
    camera: str = "corner2"
    image_size: int = 64
    max_steps: int = 500
    rendering: Literal["stock", "fast"] = "fast"
    shift: dict[str, Any] = field(default_factory=dict)


@EnvConfig.register_subclass("accerl_libero")
@dataclass
class AccerlLiberoEnvConfig(AccerlEnvConfig):
    """`LiberoConfig` as LeRobot spells configs; see there for the meaning and range of each field."""

    world = LiberoConfig

    task: str | None = "libero_object"
    fps: int = LIBERO_FPS
    camera: str = "agentview,robot0_eye_in_hand"
    image_size: int = 256
    max_steps: int = 280
    rendering: Literal["stock", "fast"] = "stock"
    assets: str = ""


def _camera(key: str) -> str:
    return key.removeprefix("observation.images.")
