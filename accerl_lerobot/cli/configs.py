# SPDX-License-Identifier: Apache-2.0
"""Fields of the verbs' command lines, where they are not a whole run's."""

from __future__ import annotations

from dataclasses import dataclass, field

from accerl_lerobot.config.ranges import Device, Section, Seed
from accerl_lerobot.demos.record import DemosConfig
from accerl_lerobot.demos.sft import SFTConfig
from accerl_lerobot.engine.config import DatasetConfig, LaunchConfig, check_chunk
from accerl_lerobot.envs import EnvConfig, MetaWorldConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation.config import EvaluationConfig
from accerl_lerobot.inference.worker import InferenceConfig
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.world_model.config import (
    ValidationConfig,
    WorldModelConfig,
)


@dataclass(frozen=True, kw_only=True)
class DemosRun(Section):
    """``accerl demos``: scripted experts, recorded."""

    env: EnvConfig = field(default_factory=MetaWorldConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)


@dataclass(frozen=True, kw_only=True)
class SFTRun(Section):
    """``accerl sft``: LeRobot's own trainer on a LeRobotDataset."""

    seed: Seed = 0
    output_dir: str | None = None
    """Folder to create. None: ``outputs/<date>/<time>_<job_name>``."""
    job_name: str = "sft"
    """Last part of the folder's name."""
    device: Device = "auto"
    """cpu, cuda, or auto."""
    env: EnvConfig | None = None
    """When given, the dataset is checked against it first."""
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    sft: SFTConfig = field(default_factory=SFTConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sft.init_path is None:
            check_chunk(self.sft.policy)


@dataclass(frozen=True, kw_only=True)
class EvalRun(Section):
    """``accerl eval``: a checkpoint on seeds that no run trains on."""

    seed: Seed = 0
    """Selects the initial states: those of a run with this seed, or others, on which nothing was tuned."""
    output_dir: str | None = None
    """Folder for ``evaluation.json`` and videos; None prints only."""
    env: EnvConfig = field(default_factory=MetaWorldConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    inference: InferenceConfig = field(default_factory=InferenceConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    launch: LaunchConfig = field(default_factory=LaunchConfig)


@dataclass(frozen=True, kw_only=True)
class WorldModelRun(Section):
    """``accerl world-model``: a world model, and a success model, from one or two LeRobotDatasets."""

    seed: Seed = 0
    output_dir: str | None = None
    """Folder to create. None: ``outputs/<date>/<time>_<job_name>``."""
    job_name: str = "world_model"
    """Last part of the folder's name."""
    device: Device = "auto"
    """cpu, cuda, or auto: where both networks are trained and validated."""
    env: EnvConfig = field(default_factory=MetaWorldConfig)
    """Environment to model: its cameras, sizes, rate and tasks."""
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """Demonstrations, some of which fail."""
    online: DatasetConfig = field(default_factory=DatasetConfig)
    """Episodes of a policy, as ``accerl export`` writes them, to train on as well; none without a name. No
    demonstration shows how a policy fails."""
    world_model: WorldModelConfig = field(default_factory=WorldModelConfig)


@dataclass(frozen=True, kw_only=True)
class WorldModelEvalRun(Section):
    """``accerl world-model-eval``: a saved world model on one or two LeRobotDatasets."""

    path: str | None = None
    """The folder named world_model that ``accerl world-model`` wrote."""
    discover_packages_path: str | None = None
    """Package to import that registers the type of the world model, where that is not one of ours."""
    seed: Seed = 0
    """Seed of the choice of windows."""
    output_dir: str | None = None
    """Folder to create. None: ``outputs/<date>/<time>_<job_name>``."""
    job_name: str = "world_model_eval"
    """Last part of the folder's name."""
    device: Device = "auto"
    """cpu, cuda, or auto: where the world model and the success model run."""
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """Episodes it was not trained on; of its own dataset, those that were held out."""
    online: DatasetConfig = field(default_factory=DatasetConfig)
    """Likewise, episodes of a policy as ``accerl export`` writes them; none without a name."""
    validation: ValidationConfig = field(default_factory=ValidationConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.path is None:
            raise InputError("path", None, "name the folder world_model of an accerl world-model run")
