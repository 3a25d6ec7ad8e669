# SPDX-License-Identifier: Apache-2.0
"""Environments to act in: one contract, one config choice per environment.

Importing this package loads no simulator; an environment imports its own when it is made.
"""

from __future__ import annotations

from accerl_lerobot.envs.base import ChunkResult, EnvConfig, Environment, EnvironmentSpec, HistoryEnvironment
from accerl_lerobot.envs.gym_env import GymConfig, LeRobotEnvConfig
from accerl_lerobot.envs.libero import LiberoConfig
from accerl_lerobot.envs.making import (
    JudgedEnvironment,
    RewardModelConfig,
    environment_error,
    make_environment,
)
from accerl_lerobot.envs.metaworld import MetaWorldConfig
from accerl_lerobot.envs.simulated import SimulatedConfig

__all__ = [
    "ChunkResult", "EnvConfig", "GymConfig", "HistoryEnvironment", "JudgedEnvironment", "LeRobotEnvConfig",
    "LiberoConfig", "MetaWorldConfig", "RewardModelConfig", "SimulatedConfig", "Environment",
    "EnvironmentSpec", "environment_error", "make_environment",
]  # fmt: skip
