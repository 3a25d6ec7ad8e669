# SPDX-License-Identifier: Apache-2.0
"""Environments are made from their configs, and their errors become one line."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, metadata

from accerl_lerobot.checkpoint.safety import brief
from accerl_lerobot.config.parsing import discover, imported
from accerl_lerobot.envs.base import EnvConfig, Environment, HistoryEnvironment
from accerl_lerobot.envs.graphics import drawing_error, start_graphics
from accerl_lerobot.envs.reward_model import JudgedEnvironment, RewardModelConfig, load_judge
from accerl_lerobot.errors import InputError


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
    if reward_model is not None and reward_model.path is not None:
        environment = JudgedEnvironment(environment, load_judge(reward_model))
    return environment if history == 1 else HistoryEnvironment(environment, history)


def environment_error(config: EnvConfig, error: Exception) -> InputError:
    """The one line for an error of somebody's environment, which may be any."""
    if isinstance(error, InputError):
        return error
    if (drawing := drawing_error(error)) is not None:
        return drawing
    field, name = f"env.{config.named_by}", str(getattr(config, config.named_by))
    if isinstance(error, ModuleNotFoundError):
        missing = str(error.name or getattr(error.__cause__, "name", None)).partition(".")[0]
        package = "accerl-lerobot" if config.named_by == "type" else "lerobot"
        extra = f"; pip install '{package}[{name}]'" if name in _extras(package) else ""
        return InputError(field, name, f"the package {missing} is not installed{extra}")
    why = f"the environment fails ({type(error).__name__}: {brief(error)}); ACCERL_LOG=DEBUG shows where"
    if kwargs := getattr(config, "kwargs", None):
        return InputError("env.kwargs", kwargs, f"{name}: {why}")
    return InputError(field, name, why)


def _extras(package: str) -> Sequence[str]:
    """Names of the extras that a package can be installed with."""
    try:
        return metadata(package).get_all("Provides-Extra") or ()
    except PackageNotFoundError:
        return ()
