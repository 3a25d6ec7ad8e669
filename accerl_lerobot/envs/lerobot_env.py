# SPDX-License-Identifier: Apache-2.0
"""Any environment LeRobot can make, as a world.

LeRobot's environments disagree on autoreset, truncation and success, so this takes the single environment out
of LeRobot's vector one and keeps episode limits itself. Observations and actions pass through LeRobot's own
per-environment processors: a policy sees exactly what ``lerobot-eval`` would show it.
Importing this file loads no LeRobot; making the world does.
"""

from __future__ import annotations

import io
import math
import re
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np

from accerl_lerobot.config.ranges import Range
from accerl_lerobot.envs.base import EnvConfig, EpisodeWorld, Step, WorldSpec
from accerl_lerobot.envs.gym_env import finite_numbers, resized, unlimited
from accerl_lerobot.envs.metaworld import close_at_exit, import_mujoco
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import TASK, Observation

_STATE = "observation.state"
_IMAGE = "observation.image"
_PINNED = re.compile(r"[\w.-]+/[\w.-]+@[0-9a-f]{40}(:\w[\w./-]*\.py)?", re.ASCII)
_NEEDS_MUJOCO = ("aloha", "metaworld", "robocasa")


@EnvConfig.register_subclass("lerobot")
@dataclass(frozen=True, kw_only=True)
class LeRobotEnvConfig(EnvConfig):
    """Which of LeRobot's environments, those of installed packages ``lerobot_env_*`` included."""

    world = "accerl_lerobot.envs.lerobot_env:LeRobotWorld"

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
    max_steps: Annotated[int, Range("[1, 1000000]")] = 300
    """Episode limit in env steps; reaching it truncates."""
    reward: Literal["success", "env"] = "success"
    """``success`` (1.0 at the first success, else 0.0) or ``env`` (the environment's own)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.name:
            raise InputError("env.name", self.name, "name one of LeRobot's environments, such as pusht")
        if self.name.startswith("libero"):
            remedy = "LeRobot takes its starts in turn and not from the seed; use env.type=libero for LIBERO"
            raise InputError("env.name", self.name, remedy)


class LeRobotWorld(EpisodeWorld):
    """One of LeRobot's environments; a suite of several tasks has one simulator for each."""

    def __init__(self, config: LeRobotEnvConfig) -> None:
        if config.name in _NEEDS_MUJOCO:
            import_mujoco()
        from lerobot.envs.configs import EnvConfig as LeRobotConfig
        from lerobot.envs.factory import make_env
        from lerobot.utils.import_utils import register_third_party_plugins

        self.config = config
        if config.name not in LeRobotConfig.get_known_choices():
            register_third_party_plugins()
        known = LeRobotConfig.get_known_choices()
        if config.name not in known:
            raise InputError("env.name", config.name, f"LeRobot has: {', '.join(known)}")
        try:
            self._lerobot_config = known[config.name](**config.kwargs)
        except (TypeError, ValueError) as error:
            raise InputError("env.kwargs", config.kwargs, str(error)) from error
        _check_hub(config, getattr(self._lerobot_config, "hub_path", None))
        self._before, self._after = self._lerobot_config.get_env_processors()
        with redirect_stdout(io.StringIO()):  # LeRobot prints, and results go there
            trust = config.trust_remote_code
            self._vectors = make_env(self._lerobot_config, n_envs=1, trust_remote_code=trust)
        self._envs = _single_envs(self._vectors)
        self.spec = self._look()
        close_at_exit(self)

    def _begin(self, seed: int, task: str) -> None:
        self._raw, _ = self._envs[task].reset(seed=seed)

    def _step(self, action: np.ndarray) -> Step:
        import torch

        processed = self._after({"action": torch.from_numpy(action[None])})["action"].numpy()[0]
        self._raw, reward, ended, cut, info = self._envs[self._task].step(processed)
        return Step(
            success=bool(info.get("is_success", False)),
            ended=bool(ended),
            reward=float(reward) if self.config.reward == "env" else None,
            cut=bool(cut),
            finite=math.isfinite(reward) and finite_numbers(self._raw),
        )

    def render(self, height: int, width: int) -> np.ndarray:
        return resized(np.asarray(self._envs[self._task].render(), np.uint8), height, width)

    def close(self) -> None:
        for suite in self._vectors.values():
            for vector in suite.values():
                vector.close()
        self._vectors, self._envs, self._done = {}, {}, True

    def _look(self) -> WorldSpec:
        """Learns shapes from a first observation."""
        task, env = next(iter(self._envs.items()))
        self._task = task
        self._raw, _ = env.reset(seed=0)
        observation = self._observe()
        images: dict[str, Any] = {k: np.shape(v) for k, v in observation.items() if k.startswith(_IMAGE)}
        if not images or _STATE not in observation:
            shown = ", ".join(k for k in observation if k != TASK) or "neither"
            remedy = f"a policy needs images and a state, {self.config.name} shows {shown}"
            raise InputError("env.kwargs", self.config.kwargs, f"{remedy}; try obs_type=pixels_agent_pos")
        space = env.action_space
        return WorldSpec(
            images=images, state_dim=len(observation[_STATE]), action_dim=space.shape[0],
            action_low=np.asarray(space.low, np.float32), action_high=np.asarray(space.high, np.float32),
            fps=int(self._lerobot_config.fps), max_steps=self.config.max_steps, tasks=tuple(self._envs),
            instructions=tuple(filter(None, map(self._instruction, self._envs))),
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
        return observation

    def _instruction(self, task: str) -> str:
        env = self._envs[task].unwrapped
        for name in ("task_description", "task"):
            if isinstance(text := getattr(env, name, None), str) and text:
                return text
        return self.config.task


def _check_hub(config: LeRobotEnvConfig, hub_path: str | None) -> None:
    """Refuses code from the Hub that nobody asked for, or whose version is not named."""
    if hub_path is None and config.trust_remote_code:
        remedy = f"{config.name} is no environment on the Hub; leave it out"
        raise InputError("env.trust_remote_code", True, remedy)
    if hub_path is None:
        return
    if not config.trust_remote_code:
        remedy = f"{config.name} is code of {hub_path} on the Hub, which would run with your rights; read it,"
        remedy += " then set this, and its commit in hub_path"
        raise InputError("env.trust_remote_code", False, remedy)
    if not _PINNED.fullmatch(hub_path) or ".." in hub_path:
        remedy = "name a commit, owner/name@COMMIT or owner/name@COMMIT:file.py with 40 hexadecimal digits"
        raise InputError("env.kwargs.hub_path", hub_path, f"{remedy}: branches can be moved to other code")


def _single_envs(vectors: dict[str, dict[int, Any]]) -> dict[str, Any]:
    """Names each single environment ``suite`` or, where there are several, ``suite/number``."""
    flat = [(suite, number, vector) for suite, tasks in vectors.items() for number, vector in tasks.items()]
    if len(flat) == 1:
        return {flat[0][0]: unlimited(flat[0][2].envs[0])}
    return {f"{suite}/{number}": unlimited(vector.envs[0]) for suite, number, vector in flat}


def _batched(raw: Any) -> Any:
    """Adds the leading dimension a vector environment would have added."""
    if isinstance(raw, dict):
        return {key: _batched(value) for key, value in raw.items()}
    return np.asarray(raw)[None]
