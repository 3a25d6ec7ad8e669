# SPDX-License-Identifier: Apache-2.0
"""Any environment LeRobot can make, as an environment.

LeRobot's environments disagree on autoreset, truncation and success, so this takes the single environment out
of LeRobot's vector one and keeps episode limits itself. Observations and actions pass through LeRobot's own
per-environment processors: a policy sees exactly what ``lerobot-eval`` would show it.
Importing this file loads no LeRobot; making the environment does.
"""

from __future__ import annotations

import dataclasses
import io
import re
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from accerl_lerobot.config.parsing import PLUGINS, import_plugins
from accerl_lerobot.envs.base import EnvConfig, EnvironmentSpec
from accerl_lerobot.envs.gym_env import GymnasiumConfig, GymnasiumEnvironment
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import TASK, Observation

_STATE = "observation.state"
_IMAGE = "observation.image"
_PINNED = re.compile(r"[\w.-]+/[\w.-]+@[0-9a-f]{40}(:\w[\w./-]*\.py)?", re.ASCII)
_LIMIT = "episode_length"
_INTERNAL = {"features", "features_map", "max_parallel_tasks", "disable_env_checker", _LIMIT}
"""Fields of LeRobot's configs that say how it works, and one that is ours."""


@EnvConfig.register_subclass("lerobot")
@dataclass(frozen=True, kw_only=True)
class LeRobotEnvConfig(GymnasiumConfig):
    """Which of LeRobot's environments, those of installed packages ``lerobot_env_*`` included."""

    environment = "accerl_lerobot.envs.lerobot_env:LeRobotEnvironment"
    named_by = "name"
    LIMIT = _LIMIT

    name: str = "pusht"
    """LeRobot's own name of the environment: what ``lerobot-eval --env.type`` takes."""
    kwargs: dict[str, Any] = field(default_factory=dict)
    """Fields of LeRobot's config of that environment, such as ``task`` or ``obs_type``."""
    trust_remote_code: bool = False
    """True if an environment on the Hub is run with your rights. It needs ``hub_path`` in `kwargs`, with the
    commit whose code you have read: ``owner/name@COMMIT`` or ``owner/name@COMMIT:file.py``."""
    task: str = ""
    """Instruction text, for environments that have none of their own."""
    camera: str = "image"
    """Name of a lone camera: ``observation.images.<camera>``; if empty, LeRobot's ``observation.image``,
    which policies trained on LeRobot's PushT dataset expect."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.name:
            raise InputError("env.name", self.name, "name one of LeRobot's environments, such as pusht")
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
        known, broken = LeRobotConfig.get_known_choices(), dict[str, str]()
        if config.name not in known:
            broken = import_plugins(*PLUGINS)
        if config.name not in known:
            words = "; ".join([*broken.values(), f"LeRobot has: {', '.join(known)}"])
            raise InputError("env.name", config.name, words)
        fields = {own.name for own in dataclasses.fields(known[config.name])}
        limit = {_LIMIT: config.max_steps} if config.max_steps and _LIMIT in fields else {}
        self._fields = f"LeRobot's {config.name} has the fields {', '.join(sorted(fields - _INTERNAL))}"
        try:
            self._lerobot_config = known[config.name](**limit, **config.kwargs)
        except (TypeError, ValueError) as error:
            raise InputError("env.kwargs", config.kwargs, f"{error}; {self._fields}") from error
        _check_hub(config, getattr(self._lerobot_config, "hub_path", None))
        self._before, self._after = self._lerobot_config.get_env_processors()
        with redirect_stdout(io.StringIO()):  # LeRobot prints, and results go there
            trust = config.trust_remote_code
            self._vectors = make_env(self._lerobot_config, n_envs=1, trust_remote_code=trust)
        super().__init__(_single_envs(self._vectors))

    def _processed(self, action: np.ndarray) -> np.ndarray:
        import torch

        processed: np.ndarray = self._after({"action": torch.from_numpy(action[None])})["action"].numpy()
        return processed[0]

    def close(self) -> None:
        for suite in self._vectors.values():
            for vector in suite.values():
                vector.close()
        self._vectors, self.environments, self._done = {}, {}, True

    def _look(self, observation: Observation) -> EnvironmentSpec:
        images: dict[str, Any] = {k: np.shape(v) for k, v in observation.items() if k.startswith(_IMAGE)}
        if not images or _STATE not in observation:
            shown = ", ".join(k for k in observation if k != TASK) or "neither"
            why = f"a policy needs images and a state, {self.config.name} shows {shown}"
            hint = self._fields
            if hasattr(self._lerobot_config, "obs_type"):
                hint = "use obs_type=pixels_agent_pos"
            raise InputError("env.kwargs", self.config.kwargs, f"{why}; {hint}")
        space = self.environments[self._task].action_space
        return EnvironmentSpec(
            images=images, state_dim=len(observation[_STATE]), action_dim=space.shape[0],
            action_low=np.asarray(space.low, np.float32), action_high=np.asarray(space.high, np.float32),
            fps=int(self._lerobot_config.fps), max_steps=self.max_steps, tasks=tuple(self.environments),
            instructions=tuple(filter(None, map(self._instruction, self.environments))),
        )  # fmt: skip

    def _observe(self) -> Observation:
        from lerobot.envs.utils import preprocess_observation

        text = self._instruction(self._task)
        batch = self._before({**preprocess_observation(_batched(self._raw)), TASK: [text]})
        observation: Observation = {TASK: text}
        for key, value in batch.items():
            if key == _STATE:
                observation[key] = value[0].numpy().astype(np.float32)
            elif key.startswith(_IMAGE):
                renamed = key == _IMAGE and self.config.camera
                name = f"observation.images.{self.config.camera}" if renamed else key
                # LeRobot has divided by 255; rounding brings every one of the 256 values back.
                observation[name] = (value[0].permute(1, 2, 0) * 255).round().byte().numpy().copy()
        self.pictures = {k: v for k, v in observation.items() if isinstance(v, np.ndarray) and k != _STATE}
        return observation

    def _instruction(self, task: str) -> str:
        env = self.environments[task].unwrapped
        for name in ("task_description", "task"):
            if isinstance(text := getattr(env, name, None), str) and text:
                return text
        return self.config.task


def _check_hub(config: LeRobotEnvConfig, hub_path: str | None) -> None:
    """Refuses code from the Hub that nobody asked for, or whose version is not named."""
    if hub_path is None and config.trust_remote_code:
        hint = f"{config.name} is no environment on the Hub; leave it out"
        raise InputError("env.trust_remote_code", True, hint)
    if hub_path is None:
        return
    if not config.trust_remote_code:
        hint = f"{config.name} is code of {hub_path} on the Hub, which would run with your rights; read it,"
        hint += " then set this, and its commit in hub_path"
        raise InputError("env.trust_remote_code", False, hint)
    if not _PINNED.fullmatch(hub_path) or ".." in hub_path:
        hint = "name a commit, owner/name@COMMIT or owner/name@COMMIT:file.py with 40 hexadecimal digits"
        raise InputError("env.kwargs.hub_path", hub_path, f"{hint}: branches can be moved to other code")


def _single_envs(vectors: dict[str, dict[int, Any]]) -> dict[str, Any]:
    """Names each single environment ``suite`` or, where there are several, ``suite/number``."""
    flat = [(suite, number, vector) for suite, tasks in vectors.items() for number, vector in tasks.items()]
    if len(flat) == 1:
        return {flat[0][0]: flat[0][2].envs[0]}
    return {f"{suite}/{number}": vector.envs[0] for suite, number, vector in flat}


def _batched(raw: Any) -> Any:
    """Adds the leading dimension a vector environment would have added; text has none there, either."""
    if isinstance(raw, dict):
        return {key: _batched(value) for key, value in raw.items()}
    array = np.asarray(raw)
    return array[None] if array.dtype.kind in "fiub" else (raw,)
