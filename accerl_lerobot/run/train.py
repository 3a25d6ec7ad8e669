# SPDX-License-Identifier: Apache-2.0
"""One run from start to summary: demonstrations → SFT → evaluation → asynchronous RL → evaluation.

`run_to_end` opens Ray, `Run.execute` does the phases, `Run.practise` makes engines, and `Loop.run` works with
one.
`loop` has the processes of a run and what each of them waits for. ``docs/cli.md`` lists the files of a run's
folder.

`train`, `resume`, `evaluate` and `load_policy` are the Python interface, imported from `accerl_lerobot`.
Recording and Ray start processes that import the main module again, so a script calls `train` under
``if __name__ == "__main__":``. Progress goes to the standard error. A mistake in the settings raises
`InputError` before any work begins: one line with the field, its value and the hint.
"""

from __future__ import annotations

import datetime
import functools
import logging
import shutil
import sys
import time
from collections.abc import Mapping
from contextlib import closing, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from accerl_lerobot.algorithms import GIPOConfig
from accerl_lerobot.checkpoint import layout
from accerl_lerobot.config.machine import check_disk
from accerl_lerobot.config.parsing import as_text
from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.console import Console
from accerl_lerobot.demos.record import REPO_ID, record_demos
from accerl_lerobot.engines import Engine, ray_session
from accerl_lerobot.engines.config import RunConfig, encode, parse
from accerl_lerobot.engines.ray_session import check_placement
from accerl_lerobot.engines.stopping import StoppedError, Stopping, WorkerError, handled
from accerl_lerobot.envs import EnvironmentSpec
from accerl_lerobot.errors import InputError, check_absent, expanded, kept_traceback
from accerl_lerobot.evaluation import Rate, by_task, evaluation_plans, rate_of
from accerl_lerobot.experience import Observation, Request
from accerl_lerobot.metrics import MetricsLog
from accerl_lerobot.policies.config import Load, PolicyConfig, env_steps_seen
from accerl_lerobot.rollout.runner import EpisodeResult
from accerl_lerobot.run import resuming
from accerl_lerobot.run.adapter import demonstrations_of, make_adapter
from accerl_lerobot.run.loop import Loop, Recorder, Times, run_plans
from accerl_lerobot.run.preflight import (
    check_device,
    check_environment,
    check_evaluation,
    check_policy,
    check_start,
)
from accerl_lerobot.seeds import noise_seed
from accerl_lerobot.timeline import RECOVERY, open_clock
from accerl_lerobot.world_model.config import ImaginationConfig

if TYPE_CHECKING:
    from accerl_lerobot.demos.sft import SFTConfig
    from accerl_lerobot.policies.adapter import LeRobotAdapter
    from accerl_lerobot.policies.stock import StockAdapter

logger = logging.getLogger(__name__)


def make_output_dir(config: Any) -> Path:
    """Create the folder of a run: ``output_dir``, or one named after date, time and ``job_name``."""
    if config.output_dir is None:
        now = datetime.datetime.now()
        path = Path("outputs") / f"{now:%Y-%m-%d}" / f"{now:%H-%M-%S}_{config.job_name}"
    else:
        path = expanded(config.output_dir, "output_dir")
    check_absent(path)
    check_disk(config.output_dir)
    path.mkdir(parents=True)
    return path


def discard_unused(directory: Path) -> None:
    """Free the name of a run that was refused before it did anything."""
    if {path.name for path in directory.iterdir()} <= {layout.CONFIG, resuming.LOCK}:
        shutil.rmtree(directory)


def run_to_end(
    config: RunConfig, console: Console, recipe_path: Path | None = None, load: Load | None = None
) -> tuple[Path, dict[str, Any]]:
    """Do a new run, or with ``config.resume`` the rest of the one whose config is at `recipe_path`."""
    with ray_session.opened(config.launch, now=config.resume or config.policy.path is not None):
        resume_from = None
        if config.resume:
            directory, resume_from = resuming.resumed_run(recipe_path, config)
        else:
            directory = make_output_dir(config)
        run = Run(config, directory, console, resume_from, load)
        return directory, run.execute_locked()


def play_evaluation(config: RunConfig, console: Console, filmed: int = 0) -> list[EpisodeResult]:
    """Play the evaluation episodes of a run with LeRobot's sampler, on seeds that are never trained on."""
    from accerl_lerobot.policies.loading import load_acting

    with ray_session.opened(config.launch):
        check_device(config)
        spec = check_environment(config.env, config.rollout.reward_model)
        check_evaluation(config.evaluation, config.env, spec)
        # Nothing is learnt, whatever the recipe says.
        config = replace(config, algorithm=GIPOConfig(), world_model=None, imagination=ImaginationConfig())
        config = pinned(config)
        history = check_policy(config, spec)
        engine = make_engine(config, spec, history, load=load_acting, learns=False)
        with closing(engine):
            count = config.evaluation.episodes
            engine.plan(evaluation_plans(spec.tasks, count, "eval", seed=config.seed, filmed=filmed))
            return run_plans(engine, count, "eval", console)


def pinned(config: RunConfig) -> RunConfig:
    """The config with the commit that a checkpoint on the Hub has now."""
    from accerl_lerobot.policies import loading

    return replace(config, policy=loading.pinned(config.policy))


def _with_absolute_paths(config: RunConfig) -> RunConfig:
    """The config with absolute local paths: workers of a cluster have a working directory of their own."""

    def absolute(section: Any) -> Any:
        path = getattr(section, "path", None)
        if path is None:
            return section
        local = expanded(path, f"{section.SECTION}.path")
        if not local.exists():  # a name on the Hub
            return section
        return replace(section, path=str(local.absolute()))

    rollout = replace(config.rollout, reward_model=absolute(config.rollout.reward_model))
    return replace(
        config,
        policy=absolute(config.policy),
        imagination=absolute(config.imagination),
        world_model=absolute(config.world_model),
        rollout=rollout,
    )


def make_engine(
    config: RunConfig,
    spec: EnvironmentSpec,
    history: int,
    state: Path | None = None,
    load: Load | None = None,
    learns: bool = True,
) -> Engine:
    """The engine that ``launch.engine`` names, for this environment; see `RayEngine` for the arguments."""
    config = _with_absolute_paths(config)
    if state is not None:
        state = state.absolute()
    load_adapter = functools.partial(
        make_adapter,
        config.algorithm,
        config.state_model,
        environment_state=history * spec.environment_state_dim,
        remembered=demonstrations_of(config, spec.instructions),
        load=load,
    )
    if config.launch.engine == "local":
        from accerl_lerobot.engines.local import LocalEngine

        return LocalEngine(config, spec.tasks, history, state, load_adapter)
    ray_session.prepare(joins=config.launch.address is not None)
    from accerl_lerobot.engines.ray_engine import RayEngine

    return RayEngine(config, spec.tasks, history, state, load_adapter, learns)


def fine_tune(
    sft: SFTConfig, dataset: DatasetConfig, directory: Path, seed: int, device: str, console: Console
) -> Path:
    """Run SFT in ``directory/sft`` and show its progress; the policy that comes of it."""
    from accerl_lerobot.demos.dataset_files import open_metadata, task_texts
    from accerl_lerobot.demos.sft import run_sft

    texts = task_texts(open_metadata(dataset))
    with console.stage("SFT", total=sft.steps) as stage:
        return run_sft(
            sft, dataset, directory / "sft", seed, device, texts,
            on_step=lambda step, loss: stage.update(step, f"loss {loss:.3f}"),
        )  # fmt: skip


def warm_start(config: RunConfig, directory: Path, console: Console) -> RunConfig:
    """The run with its ``policy.path``, for which demonstrations are recorded and SFT is run if need be.

    What has been done is not done again; what was stopped begins again.
    """
    from accerl_lerobot.policies.loading import resolve_device

    note = directory / resuming.WARM_START
    if config.policy.path is not None:
        return config
    if note.is_file():
        return resuming.improving(config, resuming.warm_started(directory))
    for name in (f"{layout.DEMOS}.partial", "sft"):
        shutil.rmtree(directory / name, ignore_errors=True)
    dataset = config.dataset
    if dataset.repo_id is None:
        root = directory / layout.DEMOS  # there once it is complete
        if not root.exists():
            record_demos(config.env, config.demos, str(root), config.seed, console)
        dataset = replace(dataset, repo_id=REPO_ID, root=str(root))
    device = str(resolve_device(config.policy.device))
    path = fine_tune(config.sft, dataset, directory, config.seed, device, console)
    relative = Path(path).absolute().relative_to(directory.absolute())
    layout.write_json(note, {"policy": str(relative)})
    return resuming.improving(config, path)


class Run:
    """One run, or the rest of it. Its config becomes more definite phase by phase.

    Phases: checks, warm start (demonstrations and SFT), practice (an engine, and the loop around it).

    Args:
        resume_from: name of the checkpoint; None: a new run.
        load: loads the policy; None: a LeRobot checkpoint.
    """

    def __init__(
        self,
        config: RunConfig,
        directory: Path,
        console: Console,
        resume_from: str | None = None,
        load: Load | None = None,
    ) -> None:
        self.config = config
        self.directory = directory
        self.console = console
        self.resume_from = resume_from
        self.load = load
        self.times = Times()
        self.resume_command = resuming.resume_command(directory, config)

    def execute_locked(self) -> dict[str, Any]:
        """`execute`, in a folder that is locked meanwhile; says how to resume whatever ends the run."""
        try:
            with redirect_stdout(sys.stderr), kept_traceback(self.directory), resuming.locked(self.directory):
                return self.execute()
        except InputError:
            if self.resume_from is None:
                discard_unused(self.directory)
            raise
        except StoppedError:
            raise
        except BaseException as error:
            reason = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
            self.console.say(f"{reason}; to resume: {self.resume_command}")
            raise

    def execute(self) -> dict[str, Any]:
        """Do all phases; returns the summary, which is also in ``summary.json``."""
        started = time.monotonic()
        checkpoint = self.check()
        self.console.say(f"run {self.directory}")
        if checkpoint is None:
            self.config = warm_start(self.config, self.directory, self.console)
        else:
            layout.go_back_to(checkpoint)
            (self.directory / layout.SUMMARY).unlink(missing_ok=True)  # of a later end, if it had ended
            self.console.say(f"going on from {checkpoint}")
        if self.config.imagination.environments and self.config.imagination.path is None:
            from accerl_lerobot.run.play import prepared

            self.config = prepared(self.config, self.directory, self.console, self.load)
        self.times.warm_s = time.monotonic() - started
        self.config = replace(self.config, output_dir=str(self.directory))
        return self.practise(checkpoint)

    def check(self) -> Path | None:
        """Refuse a run that could not go well, and write its config; the checkpoint that it goes on from."""
        checkpoint = None
        if self.resume_from is None:
            if self.load is None:
                self.config = pinned(self.config)
            self._write_config(self.config)  # first: it can be resumed, whatever fails from here on
        else:
            checkpoint = resuming.checkpoint_of(self.directory, self.resume_from, self.console)
        recipe = self.config
        if checkpoint is not None:
            self.config = resuming.continued(recipe, self.directory, checkpoint)
        if self.load is None:
            self.spec = check_start(self.config, self.console.say)
        else:
            self.spec = check_environment(self.config.env)
        check_placement(self.config)
        if self.config.imagination.environments:
            from accerl_lerobot.world_model.imagined import check_imagination

            check_imagination(self.config)
        self._write_config(recipe)  # only now: a resume that is refused leaves the run as it was
        return checkpoint

    def _write_config(self, recipe: RunConfig) -> None:
        text = yaml.safe_dump(encode(replace(recipe, resume=False)), sort_keys=False)
        layout.write_atomically(self.directory / layout.CONFIG, text)

    def practise(self, checkpoint: Path | None) -> dict[str, Any]:
        """Evaluate, train and evaluate by one engine after another, each from the last checkpoint."""
        stop = Stopping(self.resume_command)
        checkpoints = self.directory / layout.CHECKPOINTS
        failures = 0  # in a row, without a later update
        most = self.config.launch.max_restarts
        with (
            handled(stop.note),
            closing(open_clock(self.config.timeline_folder, "driver")) as self.times.clock,
            closing(MetricsLog(self.directory, self.config.wandb, encode(self.config))) as log,
        ):
            while True:
                furthest = self.times.furthest
                try:
                    return self._practise_with_engine(checkpoint, stop, log)
                except WorkerError as failure:
                    self.times.clock.enter(RECOVERY)
                    stop.check()
                    if self.times.furthest > furthest:
                        failures = 0
                    failures += 1
                    if failures > most or not layout.has_checkpoint(checkpoints):
                        raise
                    checkpoint = resuming.newest_checkpoint(self.directory, layout.LAST, self.console)
                    self.console.say(f"{failure}\ngoing on from {checkpoint} ({failures} of {most} times)")
                    layout.go_back_to(checkpoint)
                    self.config = resuming.continued(self.config, self.directory, checkpoint)

    def _practise_with_engine(
        self, checkpoint: Path | None, stop: Stopping, log: MetricsLog
    ) -> dict[str, Any]:
        """The run, or the rest of it, by one set of workers."""
        history = 1 if self.load else check_policy(self.config, self.spec, own=True)
        training_state = None if checkpoint is None else checkpoint / layout.TRAINING_STATE
        with self.console.stage("starting workers"), stop.at_once():
            engine = make_engine(self.config, self.spec, history, training_state, self.load)
        recorder = Recorder(self.config, log, self.console, self.times)
        with closing(engine):
            loop = Loop(self.config, self.directory, engine, self.spec.tasks, recorder, stop)
            return loop.run(training_state)


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """Outcome of a run."""

    directory: Path
    policy: Path
    """The improved policy, a LeRobot checkpoint."""
    before: Rate | None
    """Success before RL; None with ``evaluation.before=false``."""
    after: Rate
    """Success after it, on the same starts."""
    summary: dict[str, Any]
    """Content of ``summary.json``: env steps, episodes, updates, lag, seconds, success by task."""


@dataclass(frozen=True, kw_only=True)
class EvaluationResult:
    """Outcome of an evaluation."""

    success: Rate
    tasks: dict[str, Rate]
    episodes: list[EpisodeResult]
    """Each with its task, seed, steps and return."""


class ActingPolicy:
    """A LeRobot policy with its processors."""

    def __init__(self, adapter: LeRobotAdapter | StockAdapter) -> None:
        self.adapter = adapter
        self.history = env_steps_seen(adapter.policy.config)
        self._episode = self._decisions = 0

    def reset(self) -> None:
        """Begins another episode: what the policy remembers is cleared, and its noise becomes another."""
        self._episode += 1
        self._decisions = 0

    def act(self, observation: Observation) -> np.ndarray:
        """The next K actions by LeRobot's own sampler, float32 (K, A), in the environment's units.

        An observation has ``observation.images.<camera>`` uint8 (H, W, 3), ``observation.state`` float32 (S,)
        and ``task``, the instruction. For a policy with ``n_obs_steps`` above 1 each array begins with that
        dimension, oldest first, as ``make_environment(config, policy.history)`` gives them.
        """
        seed = noise_seed(self._episode, self._decisions)
        self._decisions += 1
        request = Request(observation=observation, noise_seed=seed, explore=False)
        return self.adapter.decide([request], version=0)[0].chunk


def load_config(recipe: str | Path | None = None, changes: Mapping[str, Any] | None = None) -> RunConfig:
    """Settings of a run, as ``accerl train`` reads them from a YAML file; None: the defaults.

    `changes` are values by field, such as ``{"env.task": "door-open-v3", "trainer.updates": 100}``.

    Raises:
        InputError: a field does not exist, or a value does not fit.
    """
    path = [] if recipe is None else [f"--config_path={recipe}"]
    fields = [f"--{name}={as_text(value)}" for name, value in (changes or {}).items()]
    config: RunConfig = parse(RunConfig, [*path, *fields])
    return config


def train(config: RunConfig) -> TrainResult:
    """Demonstrations and SFT where the settings ask for them, then RL, with an evaluation before and after.

    Raises:
        InputError: the settings do not fit each other, the policy or the environment.
        StoppedError: a signal has stopped it; `resume` goes on.
    """
    if config.resume:
        raise InputError("resume", True, "use accerl_lerobot.resume(DIRECTORY)")
    return _result(*run_to_end(config, Console()))


def resume(directory: str | Path, changes: Mapping[str, Any] | None = None) -> TrainResult:
    """Resumes a run that was stopped, from its last complete checkpoint."""
    recipe = expanded(str(directory), "directory") / layout.CONFIG
    config = load_config(recipe, {**(changes or {}), "resume": True})
    return _result(*run_to_end(config, Console(), recipe))


def evaluate(
    config: RunConfig,
    policy: str | Path | None = None,
    episodes: int | None = None,
    revision: str | None = None,
) -> EvaluationResult:
    """Success of a policy with LeRobot's own sampler, on starts that no run of this seed trains on.

    Environment, seed and workers come from `config`; so do `policy` and `episodes`, unless they are given.
    `policy` is a LeRobot checkpoint on disk or the Hub, and `revision` its commit.
    """
    if policy is not None:
        config = resuming.improving(config, policy)
    if policy is not None or revision is not None:
        config = replace(config, policy=replace(config.policy, revision=revision))
    if episodes is not None:
        config = replace(config, evaluation=replace(config.evaluation, episodes=episodes))
    with redirect_stdout(sys.stderr):
        results = play_evaluation(config, Console())
    tasks = {task: rate_of(played) for task, played in by_task(results).items()}
    return EvaluationResult(success=rate_of(results), tasks=tasks, episodes=results)


def load_policy(
    path: str | Path,
    revision: str | None = None,
    device: str = "auto",
    discover_packages_path: str | None = None,
) -> ActingPolicy:
    """A LeRobot checkpoint, on disk or the Hub, ready to act; runs no code from it and unpickles nothing.

    `discover_packages_path` names the package of its policy type, where that is not ours and not installed
    as ``lerobot_policy_*``.
    """
    from accerl_lerobot.policies.loading import load_acting

    config = PolicyConfig(
        path=str(path), revision=revision, device=device, discover_packages_path=discover_packages_path
    )
    with redirect_stdout(sys.stderr):
        return ActingPolicy(load_acting(config))


def _result(directory: Path, summary: dict[str, Any]) -> TrainResult:
    def rate(when: str) -> Rate:
        n = summary[f"n_{when}"]
        return Rate(successes=round(summary[f"success_{when}"] * n), n=n)

    return TrainResult(
        directory=directory,
        policy=directory / layout.CHECKPOINTS / layout.LAST / layout.PRETRAINED,
        before=None if summary["success_before"] is None else rate("before"),
        after=rate("after"),
        summary=summary,
    )
