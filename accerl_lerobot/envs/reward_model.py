# SPDX-License-Identifier: Apache-2.0
"""Success as one of LeRobot's reward models sees it, in place of the environment's own.

For environments that cannot tell, such as a real robot behind Gymnasium's interface. The model judges what is
seen after each executed chunk, at the rollout worker's CPU; an episode ends with the first success.
"""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from accerl_lerobot.checkpoint.safety import FileSource, brief, tensor_shapes
from accerl_lerobot.config.parsing import PLUGINS, import_plugins
from accerl_lerobot.config.ranges import Commit, Range, Section
from accerl_lerobot.envs.base import ChunkResult, Environment, WrappedEnvironment
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import TASK, Observation

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


@functools.lru_cache(maxsize=1)
def load_judge(config: RewardModelConfig) -> Callable[[Observation], bool]:
    """Loads a reward model, one for all environments of a process; the result tells if it sees a success."""
    import torch
    from lerobot.configs.rewards import RewardModelConfig as LeRobotConfig
    from lerobot.processor import PolicyProcessorPipeline
    from lerobot.rewards.factory import get_reward_model_class

    from accerl_lerobot.policies import untrusted

    assert config.path is not None
    origin = FileSource(f"{REWARD_MODEL}.path", config.path)
    folder = untrusted.fetched_checkpoint(config.path, config.revision, origin.field)
    names = [path.name for path in folder.glob("*_preprocessor.json")]
    if len(names) != 1:
        raise origin.refuse("*_preprocessor.json", f"{len(names)} of them; lerobot-train writes one")
    import_plugins(*PLUGINS)
    try:
        untrusted.check_processor(folder, names[0], origin)
        trusted = config.trust_remote_code
        with untrusted.guarded(REWARD_MODEL, trusted), contextlib.redirect_stdout(sys.stderr):
            theirs = LeRobotConfig.from_pretrained(folder)
            if theirs.observation_delta_indices is not None:
                hint = "looks at several observations at once; use one that judges each alone"
                raise InputError(origin.field, config.path, f"{theirs.type} {hint}")
            theirs.device = "cpu"
            model = get_reward_model_class(theirs.type).from_pretrained(folder, config=theirs)
            on_cpu = {"device_processor": {"device": "cpu"}}
            prepare = PolicyProcessorPipeline.from_pretrained(folder, names[0], overrides=on_cpu)
    except InputError:
        raise
    except Exception as error:  # LeRobot takes the files at their word, and may fail over any of them
        hint = f"it cannot be loaded as one of LeRobot's reward models ({brief(error)})"
        raise InputError(origin.field, config.path, hint) from error
    mine, there = model.state_dict(), tensor_shapes(folder / untrusted.WEIGHTS, origin)
    held = {mine[name].data_ptr() for name in there if name in mine}  # some have several names
    if missing := [name for name, tensor in mine.items() if tensor.data_ptr() not in held]:
        hint = f"{len(missing)} tensors are missing, such as {missing[0]}; save it again"
        raise origin.refuse(untrusted.WEIGHTS, hint)
    wanted = {name: tuple(feature.shape) for name, feature in theirs.input_features.items()}

    @torch.no_grad()
    def succeeded(observation: Observation) -> bool:
        batch: dict[str, Any] = {TASK: [observation[TASK]]}
        for name, shape in wanted.items():
            value = torch.from_numpy(np.asarray(observation.get(name, np.zeros(0))))[None]
            value = value.permute(0, 3, 1, 2).float() / 255 if value.dim() == 4 else value.float()
            if value.shape[1:] != shape:
                offers = tuple(value.shape[1:]) if name in observation else "is missing"
                hint = f"its {name} is {shape}, the environment's {offers}"
                raise InputError(origin.field, config.path, hint)
            batch[name] = value
        batch = prepare(batch)
        if hasattr(model, "predict_reward"):
            return bool(model.predict_reward(batch, threshold=config.threshold)[0])
        return bool(model.compute_reward(batch)[0] > config.threshold)

    return succeeded


class JudgedEnvironment(WrappedEnvironment):
    """An environment whose successes, and rewards, are what a reward model says.

    An episode also ends where the environment itself ends it, successfully or not.
    """

    def __init__(self, environment: Environment, succeeded: Callable[[Observation], bool]) -> None:
        super().__init__(environment)
        self.succeeded = succeeded

    def step_chunk(self, actions: np.ndarray) -> ChunkResult:
        result = self._environment.step_chunk(actions)
        success = not result.info.get("nonfinite") and self.succeeded(result.observation)
        rewards = np.zeros_like(result.rewards)
        rewards[-1] = success
        ended, out_of_time = result.terminated or success, result.truncated and not success
        return replace(
            result, rewards=rewards, success=success, terminated=ended, truncated=out_of_time, note=""
        )
