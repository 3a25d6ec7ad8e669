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
"""A run is one dataclass per room, composed, checked and saved beside the results.

YAML through ``--config_path``, any field through ``--room.field=value``, as in LeRobot. Nothing is filled in later.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import draccus

from accerl_lerobot.algorithms import AlgorithmConfig, GIPOConfig
from accerl_lerobot.demos.record import DemosConfig
from accerl_lerobot.demos.sft import SFTConfig
from accerl_lerobot.envs import EnvConfig, MetaWorldConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation.config import EvaluationConfig
from accerl_lerobot.inference.worker import InferenceConfig
from accerl_lerobot.metrics import WandBConfig
from accerl_lerobot.policies.loading import PolicyConfig
from accerl_lerobot.replay.pacing import ReplayConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.trainer.config import TrainerConfig


@dataclass(frozen=True, kw_only=True)
class DatasetConfig:
    """A LeRobotDataset, on the Hub or in a folder."""

    repo_id: str | None = None
    """Hub id, or a label for `root`. None: the run records its own demonstrations."""
    root: str | None = None
    """Local folder; None uses the Hub and its cache."""
    revision: str | None = None
    """Hub revision."""


@dataclass(frozen=True, kw_only=True)
class LaunchConfig:
    """Where the workers run."""

    engine: str = "ray"
    """ray: asynchronous workers. local: the same parts in one process, deterministic, for tests and debugging."""
    stall_s: float = 300.0
    """A run in which nothing at all moved for so many seconds ends with an error; > 0."""

    def __post_init__(self) -> None:
        if self.engine not in ("ray", "local"):
            raise InputError("launch.engine", self.engine, "use ray or local")
        if not self.stall_s > 0:
            raise InputError("launch.stall_s", self.stall_s, "use a positive number of seconds")


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Everything one run needs.

    The start is one of: ``policy.path`` (a LeRobot checkpoint); ``sft`` on ``dataset``; ``sft`` on demonstrations that the
    run records itself with ``demos``.
    """

    seed: int = 0
    """0 to 99; of demonstrations, SFT, exploration and replay. Evaluation episodes do not depend on it."""
    output_dir: str | None = None
    """Folder of the run; must not exist. None: ``outputs/<date>/<time>_<job_name>``."""
    job_name: str = "run"
    env: EnvConfig = field(default_factory=MetaWorldConfig)
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)
    sft: SFTConfig = field(default_factory=SFTConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    inference: InferenceConfig = field(default_factory=InferenceConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    algorithm: AlgorithmConfig = field(default_factory=GIPOConfig)
    trainer: TrainerConfig = field(default_factory=TrainerConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    launch: LaunchConfig = field(default_factory=LaunchConfig)
    wandb: WandBConfig = field(default_factory=WandBConfig)
    save_every_updates: int = 0
    """Checkpoint every so many updates; 0: only at the end."""

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 100:
            raise InputError("seed", self.seed, "use 0 to 99")
        if self.save_every_updates < 0:
            raise InputError("save_every_updates", self.save_every_updates, "use 0 (only at the end) or more")
        if self.policy.path is not None and self.sft.steps:
            remedy = "give either a checkpoint to improve or an SFT that makes one; sft.init_path fine-tunes a checkpoint"
            raise InputError("policy.path", self.policy.path, remedy)
        if self.trainer.updates:
            self.replay.check(
                batch_decisions=self.trainer.batch_decisions, segment_decisions=self.rollout.segment_length
            )


def parse(config_class: type[Any], arguments: list[str]) -> Any:
    """Parses ``--config_path=…`` and overrides into a config.

    Raises:
        InputError: an unknown key, a value of the wrong type, or one out of range; names the field.
    """
    try:
        path = None
        rest = []
        for argument in arguments:
            key, _, value = argument.partition("=")
            if key == "--config_path":
                path = Path(value)
                if not path.is_file():
                    raise InputError("config_path", value, "no such file; see recipes/")
            else:
                rest.append(argument)
        return draccus.parse(config_class, config_path=path, args=rest)
    except InputError:
        raise
    except draccus.utils.DraccusException as error:
        raise _as_input_error(error) from error


def encode(config: Any) -> dict[str, Any]:
    """Plain JSON types, for files and loggers."""
    encoded: dict[str, Any] = draccus.encode(config)
    return encoded


def _as_input_error(error: BaseException) -> InputError:
    """The InputError inside draccus's wrapping, or draccus's own message as one."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, InputError):
            return cause
        cause = cause.__cause__ or cause.__context__
    return InputError(
        "config", str(error).splitlines()[0], "run accerl train --help for the fields of each room"
    )
