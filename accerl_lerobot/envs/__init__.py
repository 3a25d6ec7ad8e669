# SPDX-License-Identifier: Apache-2.0
"""Environments to act in: one contract, one config choice per environment.

Importing this package loads no simulator; an environment imports its own when it is made. Errors of one are
told on one line.

A reward model serves environments that cannot tell success, such as a real robot behind Gymnasium's
interface. It judges the observation after each executed chunk, at the rollout worker's CPU; an episode ends
with the first success.
"""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import metadata
from typing import Annotated, Any

import numpy as np

from accerl_lerobot.checkpoint.safety import FileSource
from accerl_lerobot.config.parsing import PLUGINS, discover, import_plugins, imported
from accerl_lerobot.config.ranges import Commit, Range, Section
from accerl_lerobot.envs.base import (
    ChunkResult,
    EnvConfig,
    Environment,
    EnvironmentSpec,
    HistoryEnvironment,
    WrappedEnvironment,
)
from accerl_lerobot.envs.graphics import drawing_error, start_graphics
from accerl_lerobot.envs.gym_env import GymConfig, LeRobotEnvConfig
from accerl_lerobot.envs.libero import LiberoConfig
from accerl_lerobot.envs.metaworld import MetaWorldConfig
from accerl_lerobot.envs.simulated import SimulatedConfig
from accerl_lerobot.errors import InputError, in_one_line
from accerl_lerobot.experience import TASK, Observation

__all__ = [
    "ChunkResult", "EnvConfig", "GymConfig", "HistoryEnvironment", "JudgedEnvironment", "LeRobotEnvConfig",
    "LiberoConfig", "MetaWorldConfig", "RewardModelConfig", "SimulatedConfig", "Environment",
    "EnvironmentSpec", "environment_error", "make_environment",
]  # fmt: skip

REWARD_MODEL = "rollout.reward_model"


@dataclass(frozen=True, kw_only=True)
class RewardModelConfig(Section, section=REWARD_MODEL):
    """The model that tells success, where the environment does not."""

    path: str | None = None
    """A reward model that judges single observations, as ``lerobot-train`` makes a
    ``reward_classifier``: a folder or a Hub id. None: the environment tells."""
    revision: str | None = None
    """Hub revision."""
    threshold: Annotated[float, Range("(0, 1)")] = 0.5
    """Probability of success, or reward, above which an observation counts as a success."""
    trust_remote_code: Commit | None = None
    """Commit of the Hub repository that the model's encoder is from:
    its Python code, which you have read, runs with your rights, and no other does."""


def make_environment(
    config: EnvConfig, history: int = 1, reward_model: RewardModelConfig | None = None
) -> Environment:
    """Build the environment that `config` describes.

    An observation holds `history` env steps; above 1, arrays begin with that dimension. `reward_model` tells
    success, if it has a path.
    """
    start_graphics()
    try:
        discover(config.discover_packages_path, "env")
        environment: Environment = imported(config.environment)(config)
    except Exception as error:
        raise environment_error(config, error) from error
    if history > 1:
        environment = HistoryEnvironment(environment, history)
    if reward_model is not None and reward_model.path is not None:
        environment = JudgedEnvironment(environment, load_judge(reward_model), history)
    return environment


def environment_error(config: EnvConfig, error: Exception) -> InputError:
    """The one line for an error of somebody's environment, which may be any."""
    if isinstance(error, InputError):
        return error
    drawing = drawing_error(error)
    if drawing is not None:
        return drawing
    field = f"env.{config.named_by}"
    value = getattr(config, config.named_by)
    if isinstance(error, ModuleNotFoundError):
        missing = str(error.name or getattr(error.__cause__, "name", None)).partition(".")[0]
        hint = f"the package {missing} is not installed"
        package = "accerl-lerobot" if config.named_by == "type" else "lerobot"
        if value in (metadata(package).get_all("Provides-Extra") or ()):
            hint += f"; pip install '{package}[{value}]'"
        return InputError(field, value, hint)
    return InputError(
        field, value, f"the environment fails ({in_one_line(error)}); ACCERL_LOG=DEBUG shows where"
    )


@functools.lru_cache(maxsize=1)
def load_judge(config: RewardModelConfig) -> Callable[[Observation], bool]:
    """Load a reward model, one for all environments of a process; the result tells if it sees a success."""
    import torch
    from lerobot.configs.rewards import RewardModelConfig as LeRobotConfig
    from lerobot.processor import PolicyProcessorPipeline
    from lerobot.rewards.factory import get_reward_model_class

    from accerl_lerobot.policies import untrusted

    origin = FileSource(f"{REWARD_MODEL}.path", config.path)
    folder = untrusted.fetched_checkpoint(str(config.path), config.revision, origin.field)
    import_plugins(*PLUGINS)
    with (
        untrusted.refusing(origin, "it cannot be loaded as one of LeRobot's reward models"),
        untrusted.guarded(REWARD_MODEL, config.trust_remote_code),
        contextlib.redirect_stdout(sys.stderr),
    ):
        (name,) = [path.name for path in folder.glob("*_preprocessor.json")]
        untrusted.check_processor(folder, name, origin)
        settings = LeRobotConfig.from_pretrained(folder)
        if settings.observation_delta_indices is not None:
            hint = f"{settings.type} looks at several observations at once; use one that judges each alone"
            raise InputError(origin.field, config.path, hint)
        settings.device = "cpu"
        model = get_reward_model_class(settings.type).from_pretrained(folder, config=settings)
        on_cpu = {"device_processor": {"device": "cpu"}}
        prepare = PolicyProcessorPipeline.from_pretrained(folder, name, overrides=on_cpu)

    @torch.no_grad()
    def succeeded(observation: Observation) -> bool:
        batch: dict[str, Any] = {TASK: [observation[TASK]]}
        for name, feature in settings.input_features.items():
            array = np.asarray(observation.get(name, np.zeros(0)))
            value = torch.from_numpy(array)[None].float()
            if value.dim() == 4:
                value = value.permute(0, 3, 1, 2) / 255
            shape = tuple(value.shape[1:])
            if shape != tuple(feature.shape):
                hint = f"its {name} is {feature.shape}, the environment's {shape}"
                raise InputError(origin.field, config.path, hint)
            batch[name] = value
        batch = prepare(batch)
        if hasattr(model, "predict_reward"):
            return bool(model.predict_reward(batch, threshold=config.threshold)[0])
        return bool(model.compute_reward(batch)[0] > config.threshold)

    return succeeded


class JudgedEnvironment(WrappedEnvironment):
    """An environment whose successes, and rewards, are those that a reward model sees.

    It looks at the newest of `history` env steps, once after each chunk. An episode also ends where the
    environment itself ends it, successfully or not.
    """

    def __init__(
        self, environment: Environment, succeeded: Callable[[Observation], bool], history: int = 1
    ) -> None:
        super().__init__(environment)
        self.succeeded = succeeded
        self._history = history

    def step_chunk(self, actions: np.ndarray) -> ChunkResult:
        result = self._environment.step_chunk(actions)
        newest = dict(result.observation)
        if self._history > 1:
            arrays = {name: value for name, value in newest.items() if isinstance(value, np.ndarray)}
            newest |= {name: value[-1] for name, value in arrays.items()}
        success = result.finite and self.succeeded(newest)
        rewards = np.zeros_like(result.rewards)
        rewards[-1] = success
        return replace(
            result,
            rewards=rewards,
            success=success,
            terminated=result.terminated or success,
            truncated=result.truncated and not success,
            note="",
        )
