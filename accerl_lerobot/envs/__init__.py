# SPDX-License-Identifier: Apache-2.0
"""Worlds to act in: one contract, one config choice per world.

Importing this package loads no simulator; a world imports its own when it is made.
"""

from __future__ import annotations

from accerl_lerobot.config.parsing import discover, imported
from accerl_lerobot.envs.base import ChunkResult, EnvConfig, HistoryWorld, World, WorldSpec
from accerl_lerobot.envs.gym_env import GymConfig
from accerl_lerobot.envs.lerobot_env import LeRobotEnvConfig
from accerl_lerobot.envs.libero import LiberoConfig
from accerl_lerobot.envs.metaworld import MetaWorldConfig
from accerl_lerobot.envs.reward_model import JudgedWorld, RewardModelConfig, load_judge
from accerl_lerobot.envs.simulated import SimulatedConfig
from accerl_lerobot.errors import InputError

__all__ = [
    "ChunkResult", "EnvConfig", "GymConfig", "HistoryWorld", "JudgedWorld", "LeRobotEnvConfig",
    "LiberoConfig", "MetaWorldConfig", "RewardModelConfig", "SimulatedConfig", "World", "WorldSpec",
    "make_world",
]  # fmt: skip


def make_world(config: EnvConfig, history: int = 1, reward_model: RewardModelConfig | None = None) -> World:
    """Builds the world that `config` describes.

    An observation holds `history` env steps; above 1, arrays begin with that dimension. `reward_model` tells
    success, if it has a path.
    """
    try:
        discover(config.discover_packages_path, "env")
        world: World = imported(config.world)(config)
    except ModuleNotFoundError as error:
        name = str(getattr(config, "name", config.type))
        extra = f"{'accerl-' if name == config.type else ''}lerobot[{name}]"
        missing = str(error.name or getattr(error.__cause__, "name", None)).partition(".")[0]
        remedy = f"the package {missing} is not installed; pip install '{extra}'"
        raise InputError("env.type" if name == config.type else "env.name", name, remedy) from error
    if reward_model is not None and reward_model.path is not None:
        world = JudgedWorld(world, load_judge(reward_model))
    return world if history == 1 else HistoryWorld(world, history)
