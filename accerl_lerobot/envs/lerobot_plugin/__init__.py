# SPDX-License-Identifier: Apache-2.0
"""Our environments in stock LeRobot: ``lerobot-eval`` and ``lerobot-train`` on the environment we train in.

``--env.discover_packages_path=accerl_lerobot.envs.lerobot_plugin --env.type=accerl --env.environment='{type:
…}'``. A package and not a module, because LeRobot's plugin loader looks for submodules.
"""

from __future__ import annotations

import contextlib
import functools
import sys
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import _LazyAsyncVectorEnv, freeze_after_episode_end

from accerl_lerobot.config.parsing import DISCOVER, decode
from accerl_lerobot.envs import EnvConfig as EnvironmentConfig
from accerl_lerobot.envs import make_environment
from accerl_lerobot.envs.gym_env import LONE_IMAGE
from accerl_lerobot.errors import InputError, warn_once
from accerl_lerobot.experience import TASK, Observation

VIDEO_SIZE = 256


class AccerlEnv(gym.Env):
    """One task of a `Environment` as a Gymnasium environment; it never resets itself."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}
    render_mode = "rgb_array"
    task_description = ""

    def __init__(self, config: EnvironmentConfig, task: str) -> None:
        self._environment = make_environment(config)  # its simulator is built at the first reset
        spec = self._environment.spec
        self.task = task
        self.metadata = self.metadata | {"render_fps": spec.fps}
        self._max_episode_steps = spec.max_steps  # LeRobot's rollout asks for it under this name
        pixels = _pixels({key: Box(0, 255, size, np.uint8) for key, size in spec.images.items()})
        if isinstance(pixels, dict):
            pixels = Dict(pixels)
        state = Box(-np.inf, np.inf, (spec.state_dim,), np.float32)
        self.observation_space = Dict({"pixels": pixels, "agent_pos": state})
        self.action_space = Box(spec.action_low, spec.action_high, dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**32))
        observation = self._environment.reset(seed, self.task)
        self.task_description = str(observation[TASK])
        return self._format(observation), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        result = self._environment.step_chunk(np.asarray(action, np.float32)[None])
        if result.note:
            warn_once(result.note)
        info = {"is_success": result.success}
        observation = self._format(result.observation)
        return observation, float(result.rewards[0]), result.terminated, result.truncated, info

    def render(self) -> np.ndarray:
        return self._environment.render(VIDEO_SIZE, VIDEO_SIZE)

    def close(self) -> None:
        self._environment.close()

    def _format(self, observation: Observation) -> dict[str, Any]:
        pixels = _pixels({key: observation[key] for key in self._environment.spec.images})
        return {"pixels": pixels, "agent_pos": observation["observation.state"]}


@dataclass(frozen=True)
class _Recipe:
    env: EnvironmentConfig


@EnvConfig.register_subclass("accerl")
@dataclass
class AccerlEnvConfig(EnvConfig):
    """Any environment of ours, plugins included."""

    # The fields of a recipe's `env`; LeRobot's parser could not tell which ones a type has.
    environment: dict[str, Any] = field(default_factory=dict)
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        with contextlib.closing(make_environment(self.environment_config)) as environment:
            spec = environment.spec
        self.fps = spec.fps
        self.tasks = spec.tasks
        self.features = {
            "action": PolicyFeature(type=FeatureType.ACTION, shape=(spec.action_dim,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(spec.state_dim,)),
        }
        self.features_map = {"action": "action", "agent_pos": "observation.state"}
        for key, size in spec.images.items():
            name = "pixels" if key == LONE_IMAGE else f"pixels/{_camera(key)}"
            self.features[name] = PolicyFeature(type=FeatureType.VISUAL, shape=size)
            self.features_map[name] = key

    @functools.cached_property
    def environment_config(self) -> EnvironmentConfig:
        package = self.environment.get(DISCOVER)
        if package and package not in sys.modules:  # LeRobot imports what its command line names
            hint = f"only the command line can have code imported: add --env.environment.{DISCOVER}={package}"
            raise InputError(f"env.environment.{DISCOVER}", package, hint)
        recipe: _Recipe = decode(_Recipe, {"env": self.environment})
        return recipe.env

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """One vector environment per task, as ``{task: {0: vector}}``."""
        config = self.environment_config
        vectors = {}
        for task in self.tasks:
            make = functools.partial(AccerlEnv, config, task)
            if use_async_envs and n_envs > 1:  # one task's processes at a time
                vector: Any = _LazyAsyncVectorEnv([make] * n_envs)
            else:
                # A finished environment waits for its batch without simulating an episode nobody sees.
                vector = gym.vector.SyncVectorEnv([freeze_after_episode_end(make)] * n_envs)
            vectors[task] = {0: vector}
        return vectors


def _pixels(images: dict[str, Any]) -> Any:
    """Images as LeRobot's environments have them: by camera, or a lone one that has no name."""
    if LONE_IMAGE in images:
        return images[LONE_IMAGE]
    return {_camera(key): image for key, image in images.items()}


def _camera(key: str) -> str:
    return key.removeprefix("observation.images.")
