# SPDX-License-Identifier: Apache-2.0
"""Our MetaWorld inside stock LeRobot: ``lerobot-eval`` and ``lerobot-train`` on the world we train in.

A package and not a module, because LeRobot's plugin loader looks for submodules.

Example:
    ::

        lerobot-eval --policy.path=outputs/run/pretrained_model \\
          --env.discover_packages_path=accerl_lerobot.envs.lerobot_plugin \\
          --env.type=accerl_metaworld --env.task=drawer-open-v3 --env.image_size=64 --env.max_steps=150 \\
          --eval.n_episodes=20 --eval.batch_size=4
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end

from accerl_lerobot.envs.metaworld import (
    ACTION_DIM,
    FPS,
    STATE_DIM,
    MetaWorld,
    MetaWorldConfig,
    ShiftConfig,
    description,
)
from accerl_lerobot.experience import Observation

VIDEO_SIZE = 256


class AccerlMetaWorldEnv(gym.Env):
    """One task of our `MetaWorld` as a Gymnasium environment; it never resets itself.

    Args:
        config: What to simulate.
        task: One of the config's tasks.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}
    render_mode = "rgb_array"

    def __init__(self, config: MetaWorldConfig, task: str) -> None:
        self.task, self.task_description = task, description(task)
        self._max_episode_steps = config.max_steps  # LeRobot's rollout asks for it under this name
        self._world = MetaWorld(
            config
        )  # builds its simulator at the first reset, in whatever process that is
        self._cameras = config.cameras
        spec = self._world.spec
        images = {name: gym.spaces.Box(0, 255, spec.images[_key(name)], np.uint8) for name in self._cameras}
        self.observation_space = gym.spaces.Dict(
            {
                "pixels": gym.spaces.Dict(images),
                "agent_pos": gym.spaces.Box(-np.inf, np.inf, (spec.state_dim,), np.float32),
            }
        )
        self.action_space = gym.spaces.Box(spec.action_low, spec.action_high, dtype=np.float32)
        self._last: dict[str, Any] = {}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**32))
        self._last = self._format(self._world.reset(seed, self.task))
        return self._last, {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        result = self._world.step_chunk(np.asarray(action, np.float32)[None])
        if result.observation is not None:  # after a termination the last frame stands, as nobody acts on it
            self._last = self._format(result.observation)
        info = {"is_success": result.success, **result.info}
        return self._last, float(result.rewards[0]), result.terminated, result.truncated, info

    def render(self) -> np.ndarray:
        return self._world.render(VIDEO_SIZE, VIDEO_SIZE)

    def close(self) -> None:
        self._world.close()

    def _format(self, observation: Observation) -> dict[str, Any]:
        pixels = {name: observation[_key(name)] for name in self._cameras}
        return {"pixels": pixels, "agent_pos": observation["observation.state"]}


@EnvConfig.register_subclass("accerl_metaworld")
@dataclass
class AccerlMetaWorldEnvConfig(EnvConfig):
    """`MetaWorldConfig` as LeRobot spells configs; see there for the meaning and range of each field."""

    task: str | None = "drawer-open-v3"
    fps: int = FPS
    camera: str = "corner2"
    image_size: int = 64
    max_steps: int = 500
    lighting: Literal["cheap", "default"] = "cheap"
    shift: dict[str, Any] = field(default_factory=dict)
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.world_config  # noqa: B018 - refuses bad values now
        size = self.image_size
        self.features = {
            "action": PolicyFeature(type=FeatureType.ACTION, shape=(ACTION_DIM,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(STATE_DIM,)),
        }
        self.features_map = {"action": "action", "agent_pos": "observation.state"}
        for name in self.world_config.cameras:
            self.features[f"pixels/{name}"] = PolicyFeature(type=FeatureType.VISUAL, shape=(size, size, 3))
            self.features_map[f"pixels/{name}"] = _key(name)

    @property
    def world_config(self) -> MetaWorldConfig:
        """The world behind every environment made from this config."""
        return MetaWorldConfig(
            task=self.task or "",
            camera=self.camera,
            image_size=self.image_size,
            max_steps=self.max_steps,
            lighting=self.lighting,
            shift=ShiftConfig(**self.shift),
        )

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """One vector environment per task, as ``{task: {0: vector}}``."""
        config, vectors = self.world_config, {}
        for task in config.tasks:
            # A finished environment waits for its batch without simulating an episode nobody sees.
            make = freeze_after_episode_end(functools.partial(AccerlMetaWorldEnv, config, task))
            if use_async_envs and n_envs > 1:
                vector = gym.vector.AsyncVectorEnv([make] * n_envs, context="forkserver")
            else:
                vector = gym.vector.SyncVectorEnv([make] * n_envs)
            vectors[task] = {0: vector}
        return vectors


def _key(camera: str) -> str:
    return f"observation.images.{camera}"
