# SPDX-License-Identifier: Apache-2.0
"""Fields of the verbs that are not a run of ``accerl train``; see `RunConfig` for that."""

from __future__ import annotations

from dataclasses import dataclass, field

from accerl_lerobot.algorithms import AlgorithmConfig, AWRConfig, ChunkCriticConfig, OffPolicyConfig
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.config.ranges import Device, NewFolder, Section, Seed
from accerl_lerobot.demos.record import DemosConfig
from accerl_lerobot.demos.sft import SFTConfig
from accerl_lerobot.engines.config import DatasetConfig, LaunchConfig, no_use_for_states
from accerl_lerobot.envs import EnvConfig, MetaWorldConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation import EvaluationConfig
from accerl_lerobot.inference.worker import InferenceConfig
from accerl_lerobot.metrics import WandBConfig
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.world_model.config import StateModelConfig, WorldModelConfig


@dataclass(frozen=True, kw_only=True)
class DemosRun(Section):
    """``accerl demos``: scripted experts, recorded."""

    seed: Seed = 0
    """Disjoint demonstrations for different seeds."""
    root: NewFolder = "outputs/demos"
    """Folder of the dataset; must not exist."""
    env: EnvConfig = field(default_factory=MetaWorldConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)


@dataclass(frozen=True, kw_only=True)
class NewFolderRun(Section):
    """Fields of verbs that compute something from a dataset into a new folder."""

    seed: Seed = 0
    output_dir: str | None = None
    """Folder to create. None: ``outputs/<date>/<time>_<job_name>``."""
    job_name: str
    """Last part of the folder's name."""
    dataset: DatasetConfig = field(default_factory=DatasetConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dataset.repo_id is None:
            hint = "name a LeRobotDataset, on the Hub or with dataset.root"
            raise InputError("dataset.repo_id", None, hint)


@dataclass(frozen=True, kw_only=True)
class SFTRun(NewFolderRun):
    """``accerl sft``: LeRobot's own trainer on a LeRobotDataset."""

    job_name: str = "sft"
    device: Device = "auto"
    """cpu, cuda, or auto."""
    env: EnvConfig | None = None
    """When given, the dataset is checked against it first."""
    sft: SFTConfig = field(default_factory=SFTConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sft.steps == 0:
            raise InputError("sft.steps", 0, "use at least 1")


@dataclass(frozen=True, kw_only=True)
class OfflineRun(NewFolderRun):
    """``accerl offline``: a LeRobot checkpoint learns from a LeRobotDataset whose episodes are labelled.

    Each of ``trainer.updates`` is one gradient step on 64 decisions.
    """

    job_name: str = "offline"
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """Successes and failures, told apart by ``next.success``, or by sparse ``next.reward``."""
    algorithm: AlgorithmConfig = field(default_factory=AWRConfig)
    world_model: StateModelConfig | None = None
    """State that chunk_critic's critic and teacher see. None: simulator where the dataset has
    ``observation.environment_state``, else latent."""
    trainer: TrainerConfig = field(default_factory=TrainerConfig)
    wandb: WandBConfig = field(default_factory=WandBConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.algorithm, OffPolicyConfig):
            hint = "it needs likelihoods of what was done; use awr, self_imitation or chunk_critic"
            raise InputError("algorithm.type", self.algorithm.type, hint)
        if self.world_model is not None and not isinstance(self.algorithm, ChunkCriticConfig):
            raise InputError("world_model.type", self.world_model.type, no_use_for_states(self.algorithm))
        if self.policy.path is None:
            raise InputError("policy.path", None, "give a LeRobot checkpoint; accerl sft makes one")
        if self.trainer.ranks != 1:
            raise InputError("trainer.ranks", self.trainer.ranks, "offline learning is one process; use 1")


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
class WorldModelRun(NewFolderRun):
    """``accerl world-model``: a world model, and a success model, from a LeRobotDataset."""

    job_name: str = "world_model"
    device: Device = "auto"
    """cpu, cuda, or auto."""
    env: EnvConfig = field(default_factory=MetaWorldConfig)
    """Environment to model: its cameras, sizes, rate and tasks."""
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """Successes and failures; episodes of a policy, as ``accerl export`` writes, should be among them: no
    demonstration shows how a policy fails."""
    world_model: WorldModelConfig = field(default_factory=WorldModelConfig)


@dataclass(frozen=True, kw_only=True)
class WorldModelEvalRun(NewFolderRun):
    """``accerl world-model-eval``: a saved world model on a LeRobotDataset."""

    job_name: str = "world_model_eval"
    device: Device = "auto"
    """cpu, cuda, or auto."""
    path: str | None = None
    """The folder named world_model that ``accerl world-model`` wrote."""
    discover_packages_path: str | None = None
    """Package to import that registers the type of the world model, where that is not one of ours."""
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """Episodes it was not trained on; of its own dataset, those that were held out."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.path is None:
            raise InputError("path", None, "name the folder world_model of an accerl world-model run")
