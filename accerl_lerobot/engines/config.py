# SPDX-License-Identifier: Apache-2.0
"""The config of a run: one dataclass per section, each beside the class that it configures.

Values come from YAML through ``--config_path`` and from ``--section.field=value``, as in LeRobot. Checks that
concern two sections are here.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from accerl_lerobot.algorithms import AlgorithmConfig, ChunkCriticConfig, GIPOConfig, OffPolicyConfig
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.config.parsing import decode, encode, parse
from accerl_lerobot.config.ranges import DatasetConfig, NonNegative, Positive, Range, Section, Seed, Steps
from accerl_lerobot.demos.record import DemosConfig
from accerl_lerobot.demos.sft import SFTConfig
from accerl_lerobot.envs import EnvConfig, MetaWorldConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation import EvaluationConfig
from accerl_lerobot.inference.worker import InferenceConfig
from accerl_lerobot.metrics import WandBConfig
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.replay.buffer import ASYNCHRONOUS, ReplayConfig, Schedule, lag_bound
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.timeline import TIMELINE
from accerl_lerobot.world_model.config import (
    ImaginationConfig,
    SimulatorStateConfig,
    StateModelConfig,
    default_state_model,
)

__all__ = ["DatasetConfig", "LaunchConfig", "RunConfig", "decode", "encode", "parse"]


ROLES = ("trainer", "world_model", "inference", "rollout")


@dataclass(frozen=True, kw_only=True)
class LaunchConfig(Section, section="launch"):
    """Processes of a run."""

    engine: Literal["ray", "local"] = "ray"
    """ray: asynchronous workers. local: the same parts in one process, deterministic, for tests."""
    address: str | None = None
    """HOST:PORT of a running Ray cluster to join, or auto: the one that ``ray start`` has started here. It
    must ask for a token, which is looked for where Ray does: RAY_AUTH_TOKEN, RAY_AUTH_TOKEN_PATH,
    ``~/.ray/auth_token``. None: a private Ray on this machine."""
    placement: dict[str, str] = field(default_factory=dict)
    """Role (trainer, world_model, inference or rollout) → nodes of its workers: those with a
    resource, as in ``ray start --resources='{"simulators": 1}'`` or Ray's own ``node:10.0.0.2``; or all. Not
    given: the node where the run is started, where replay always is."""
    schedule: Schedule = ASYNCHRONOUS
    """asynchronous: no worker waits for another. synchronous: a batch is collected, by all environments in
    lock step, then learned from. overlap: the next one is collected meanwhile. The last two are for measuring
    what the first gains; with several inference replicas, the environments of each are in step."""
    stall_s: Positive = 300.0
    """Timeout in seconds for an answer of a worker and a step of an environment. Twice as long without any
    progress ends all workers.

    A rollout worker or an inference replica is restarted alone. After any other loss, all workers are.
    """
    max_restarts: Annotated[int, Range("[0, 1000000]")] = 3
    """How often in a row a rollout worker or an inference replica is restarted alone; 30 s at work reset the
    count. After that, and after any other loss, all workers are restarted from the last checkpoint, as often
    in a row without a later update in between."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, default in (("schedule", ASYNCHRONOUS), ("address", None), ("placement", {})):
            value = getattr(self, name)
            if self.engine == "local" and value != default:
                raise InputError(f"launch.{name}", value, "launch.engine=local is one process; leave it out")
        for role, nodes in self.placement.items():
            if role not in ROLES or not nodes.strip():
                hint = f"use one of {', '.join(ROLES)}, and a resource of nodes, or all"
                raise InputError(f"launch.placement.{role}", nodes, hint)
        if self.address is None and self.placement:
            hint = "a private Ray has one node; add --launch.address=auto, or leave the field out"
            raise InputError("launch.placement", self.placement, hint)


def no_use_for_states(algorithm: AlgorithmConfig) -> str:
    """Hint for a `world_model` beside an algorithm that sees no states."""
    return f"algorithm.type={algorithm.type} has no use for it; use chunk_critic, or leave it out"


@dataclass(frozen=True, kw_only=True)
class RunConfig(Section):
    """Everything one run needs.

    The start is one of: ``policy.path`` (a LeRobot checkpoint); ``sft`` on ``dataset``; ``sft`` on
    demonstrations that the run records itself with ``demos``.
    """

    seed: Seed = 0
    """Seed of demonstrations, SFT, exploration, replay and the starts of evaluation."""
    output_dir: str | None = None
    """Folder of the run; must not exist. None: ``outputs/<date>/<time>_<job_name>``."""
    job_name: str = "run"
    """Last part of the folder's name."""
    env: EnvConfig = field(default_factory=MetaWorldConfig)
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)
    sft: SFTConfig = field(default_factory=SFTConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    inference: InferenceConfig = field(default_factory=InferenceConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    algorithm: AlgorithmConfig = field(default_factory=GIPOConfig)
    world_model: StateModelConfig | None = None
    """State that chunk_critic's critic and teacher see. None: simulator where the environment tells it, else
    latent."""
    trainer: TrainerConfig = field(default_factory=TrainerConfig)
    imagination: ImaginationConfig = field(default_factory=ImaginationConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    launch: LaunchConfig = field(default_factory=LaunchConfig)
    wandb: WandBConfig = field(default_factory=WandBConfig)
    save_every_updates: Steps = 0
    """Checkpoint every so many updates; 0: none by their number."""
    save_every_s: NonNegative = 600.0
    """Checkpoint at least every so many seconds of training; 0: none by time. There is always one at the end,
    and one when the run is asked to stop; there is one before training if there are any by number or time."""
    resume: bool = False
    """Resume the run whose config is ``--config_path``: ``RUN/config.yaml``, or that of one of its
    checkpoints, ``RUN/checkpoints/last/config.yaml``."""

    @property
    def folder(self) -> Path | None:
        """Folder of the run; None: nothing is kept."""
        return None if self.output_dir is None else Path(self.output_dir).absolute()

    @property
    def timeline_folder(self) -> Path | None:
        """Where the timeline of a run's workers is kept; None: nowhere."""
        return None if self.folder is None else self.folder / TIMELINE

    @property
    def state_model(self) -> StateModelConfig:
        """`world_model`, or the type that is used where none is given."""
        if self.world_model is not None:
            return self.world_model
        return default_state_model(self.env.tells_state)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.policy.path is not None and self.sft.steps:
            hint = "add --sft.steps=0 to improve this checkpoint, or fine-tune it first with sft.init_path"
            raise InputError("policy.path", self.policy.path, hint)
        if self.world_model is not None and not isinstance(self.algorithm, ChunkCriticConfig):
            raise InputError("world_model.type", self.world_model.type, no_use_for_states(self.algorithm))
        if isinstance(self.algorithm, OffPolicyConfig):
            self._check_off_policy()
        counts = {"inference.workers": self.inference.workers, "trainer.ranks": self.trainer.ranks}
        for name, count in counts.items():
            if count > 1 and self.launch.engine == "local":
                hint = "launch.engine=local is one process; use launch.engine=ray, or 1"
                raise InputError(name, count, hint)
        if self.inference.workers > self.rollout.workers:
            hint = f"use at most rollout.workers, {self.rollout.workers}, or some have nobody to answer"
            raise InputError("inference.workers", self.inference.workers, hint)
        rollout = self.rollout
        if self.trainer.updates:
            batch = self.trainer.batch_decisions
            self.replay.check(batch_decisions=batch, segment_decisions=rollout.segment_length)
        imagined = self.imagination.environments
        if imagined and 0 < rollout.episodes < rollout.workers:
            hint = f"use at least {rollout.workers}: each rollout worker needs a real episode to imagine from"
            raise InputError("rollout.episodes", rollout.episodes, hint)
        judge = rollout.reward_model.path
        if imagined and self.imagination.path is None and judge is not None:
            hint = "the run's own world model learns the environment's successes; give imagination.path"
            raise InputError("rollout.reward_model.path", judge, hint)
        if self.launch.schedule != ASYNCHRONOUS and (imagined or rollout.episodes):
            hint = "use asynchronous, or leave out imagination.environments and rollout.episodes"
            raise InputError("launch.schedule", self.launch.schedule, hint)

    def _check_off_policy(self) -> None:
        """A memory of its own stands for replay's reuse, and holds whole real episodes."""
        if isinstance(self.world_model, SimulatorStateConfig) and not self.env.tells_state:
            hint = f"env.type={self.env.type} tells no state; "
            hint += "add env.environment_state, if the environment has it, or use latent"
            raise InputError("world_model.type", "simulator", hint)
        only = f"algorithm.type={self.algorithm.type}"
        for name, value, wanted, why in (
            ("replay.samples_per_insert", self.replay.samples_per_insert, 1.0, "draws from its own memory"),
            ("trainer.ranks", self.trainer.ranks, 1, "is learnt by one process"),
            ("imagination.environments", self.imagination.environments, 0, "learns from real episodes only"),
        ):
            if value != wanted:
                raise InputError(name, value, f"{only} {why}; use {wanted}")


def in_flight(config: RunConfig) -> int:
    """Decisions that environments of equal speed make while a segment is on its way to replay."""
    rollout = config.rollout
    environments = rollout.environments + config.imagination.environments
    return rollout.workers * environments * rollout.segment_length


def lag_limits(config: RunConfig) -> tuple[int, int]:
    """The largest lag under this recipe, and what its pace alone would allow; in updates."""
    early = 1 if config.launch.engine == "ray" else 0  # publications under way, and batches drawn early
    counts = {
        "batch_decisions": config.trainer.batch_decisions,
        "in_flight": in_flight(config),
        "pickup": early,
        "prefetch": early,
    }
    unlimited = replace(config.replay, max_lag=10**9)
    return lag_bound(config.replay, **counts), lag_bound(unlimited, **counts)
