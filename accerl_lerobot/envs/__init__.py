# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Worlds to act in: one contract, one config choice per world.

Importing this package loads no simulator; a world imports its own when it is made.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from accerl_lerobot.envs.base import ChunkResult, World, WorldSpec
from accerl_lerobot.envs.config import EnvConfig
from accerl_lerobot.envs.history import HistoryWorld
from accerl_lerobot.envs.lerobot_env import LeRobotEnvConfig, LeRobotWorld
from accerl_lerobot.envs.metaworld import MetaWorld, MetaWorldConfig
from accerl_lerobot.envs.simulated import SimulatedConfig, SimulatedWorld

__all__ = [
    "ChunkResult",
    "EnvConfig",
    "HistoryWorld",
    "LeRobotEnvConfig",
    "LeRobotWorld",
    "MetaWorld",
    "MetaWorldConfig",
    "SimulatedConfig",
    "SimulatedWorld",
    "World",
    "WorldSpec",
    "make_world",
]

_WORLDS: dict[type[EnvConfig], Callable[[Any], World]] = {
    LeRobotEnvConfig: LeRobotWorld,
    MetaWorldConfig: MetaWorld,
    SimulatedConfig: SimulatedWorld,
}


def make_world(config: EnvConfig, history: int = 1) -> World:
    """Builds the world that `config` describes.

    Args:
        config: of one of the kinds of world.
        history: how many env steps an observation holds; above 1, arrays begin with that dimension.
    """
    world = _WORLDS[type(config)](config)
    return world if history == 1 else HistoryWorld(world, history)
