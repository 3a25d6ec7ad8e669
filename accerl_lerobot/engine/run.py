# SPDX-License-Identifier: Apache-2.0
"""One run from start to summary: demonstrations → SFT → evaluation → asynchronous RL → evaluation.

``docs/cli.md`` lists the files of a run's folder.

`train`, `resume`, `evaluate` and `load_policy` are the Python interface, imported from `accerl_lerobot`.
Recording and Ray start processes that import the main module again, so a script calls `train` under
``if __name__ == "__main__":``. Progress goes to the standard error. A mistake in the settings raises
`InputError` before any work begins: one line with the field, its value and the hint.
"""

from __future__ import annotations

import contextlib
import datetime
import functools
import json
import logging
import shutil
import sys
import time
from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from accerl_lerobot import guardian
from accerl_lerobot.algorithms import ChunkCriticConfig, GIPOConfig, OffPolicyConfig
from accerl_lerobot.checkpoint import layout
from accerl_lerobot.config.parsing import as_text
from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.console import Console
from accerl_lerobot.demos.record import REPO_ID, record_demos
from accerl_lerobot.engine import ray_session, resuming
from accerl_lerobot.engine.config import RunConfig, encode, parse
from accerl_lerobot.engine.loop import Engine, Loop, Times, run_plans
from accerl_lerobot.engine.placement import check_placement
from accerl_lerobot.engine.preflight import check_device, check_environment, check_policy, check_start
from accerl_lerobot.engine.sizes import check_memory
from accerl_lerobot.engine.stopping import StoppedError, Stopping, WorkerError
from accerl_lerobot.errors import (
    InputError,
    check_absent,
    expanded,
    is_full,
    kept_traceback,
    make_folder,
    printable,
)
from accerl_lerobot.evaluation import Rate, evaluation_plans
from accerl_lerobot.experience import Observation, Request
from accerl_lerobot.metrics import MetricsLog
from accerl_lerobot.policies.config import Load, PolicyConfig, env_steps_seen, loader
from accerl_lerobot.rollout.runner import EpisodeResult
from accerl_lerobot.seeds import noise_seed
from accerl_lerobot.timeline import RECOVERY, open_clock

if TYPE_CHECKING:
    from accerl_lerobot.demos.sft import SFTConfig
    from accerl_lerobot.engine.ray_session import RaySession
    from accerl_lerobot.envs import EnvironmentSpec
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
    make_folder(path, "output_dir")
    return path


def discard_unused(directory: Path) -> None:
    """Free the name of a run that was refused before it did anything."""
    if {path.name for path in directory.iterdir()} <= {layout.CONFIG, resuming.LOCK}:
        shutil.rmtree(directory)


def start(
    config: RunConfig, console: Console, recipe: Path | None = None, load: Load | None = None
) -> tuple[Path, dict[str, Any]]:
    """Do a new run, or with ``config.resume`` the rest of the one whose config is `recipe`."""
    wanted, spec, given = None, None, config.resume or config.policy.path is not None
    with ray_session.opened(config.launch, now=given) as session:  # not before SFT
        if config.resume:
            directory, wanted = resuming.resumed_run(recipe, config)
        else:
            if load is None:
                from accerl_lerobot.policies.loading import pinned

                spec, _ = check_start(config, console.say)  # before there is a folder
                config = replace(config, policy=pinned(config.policy))
            directory = make_output_dir(config)
        console.say(f"run {directory}")
        how = resuming.resume_command(directory, config)
        guardian.explain(hint=printable(f"to resume: {how}"))
        try:
            with (
                redirect_stdout(sys.stderr),
                kept_traceback(directory),
                resuming.locked(directory, "config_path", "another process resumes it"),
            ):
                return directory, execute(config, directory, console, wanted, load, session, spec)
        except InputError:
            if wanted is None:
                discard_unused(directory)
            raise
        except BaseException as error:
            if is_full(error):
                console.say(f"the disk of {directory} is full; free some space, then {how}")
            elif isinstance(error, WorkerError) and error.brief:
                console.say(f"{error}; to resume: {how}")
            elif not isinstance(error, StoppedError):
                verb = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
                console.say(f"{verb}; to resume: {how}")
            raise


def play_evaluation(config: RunConfig, console: Console, filmed: int = 0) -> list[EpisodeResult]:
    """Play the evaluation episodes of a run with LeRobot's sampler, on seeds that are never trained on."""
    from accerl_lerobot.policies.loading import load_acting, pinned

    with ray_session.opened(config.launch, now=True) as session:
        check_device(config)
        check_memory(config)
        spec = check_environment(config.env, config.rollout.reward_model)
        config = replace(config, policy=pinned(config.policy))
        history = check_policy(config, spec)
        # Nothing is learnt, whatever the recipe says.
        config = replace(config, algorithm=GIPOConfig(), world_model=None)
        engine = make_engine(config, spec.tasks, history, load=load_acting, session=session)
        with contextlib.closing(engine):
            count = config.evaluation.episodes
            engine.plan(evaluation_plans(spec.tasks, count, "eval", seed=config.seed, filmed=filmed))
            return run_plans(engine, count, "eval", console)


def make_engine(
    config: RunConfig,
    tasks: tuple[str, ...],
    history: int,
    state: Path | None = None,
    load: Load | None = None,
    session: RaySession | None = None,
) -> Engine:
    """The engine that ``launch.engine`` names; see `RayEngine` for the arguments."""
    if isinstance(config.algorithm, ChunkCriticConfig):
        from accerl_lerobot.policies.teacher import with_teacher

        size, share = history * config.env.state_size, config.algorithm.teacher_episodes
        load = functools.partial(with_teacher, loader(load), config.state_model, size, share)
    if isinstance(config.algorithm, OffPolicyConfig) and (dataset := demonstrations_of(config)) is not None:
        from accerl_lerobot.trainer.demonstrations import with_demonstrations

        load = functools.partial(with_demonstrations, loader(load), dataset, config.rollout.decision_cost)
    if config.launch.engine == "local":
        from accerl_lerobot.engine.local import LocalEngine

        return LocalEngine(config, tasks, history, state, load)
    ray_session.prepare(joins=config.launch.address is not None)
    from accerl_lerobot.engine.launch import RayEngine

    return RayEngine(config, tasks, history, state, load, session)


def demonstrations_of(config: RunConfig) -> DatasetConfig | None:
    """The dataset that the run was given, or has recorded; None without one."""
    if config.dataset.repo_id is not None:
        root = config.dataset.root
        return replace(config.dataset, root=None if root is None else str(Path(root).expanduser().absolute()))
    if config.folder is None or not (config.folder / layout.DEMOS).is_dir():
        return None
    return replace(config.dataset, repo_id=REPO_ID, root=str(config.folder / layout.DEMOS))


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
    if (warm := resuming.warm_started(directory)) is not None:
        return resuming.improving(config, warm)
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
    layout.write_atomically(note, json.dumps({"policy": str(relative)}) + "\n")
    return resuming.improving(config, path)


def execute(
    config: RunConfig,
    directory: Path,
    console: Console,
    wanted: str | None = None,
    load: Load | None = None,
    session: RaySession | None = None,
    spec: EnvironmentSpec | None = None,
) -> dict[str, Any]:
    """Do all phases and return the summary, which is also in ``summary.json``; `spec`: of a checked run."""
    started = time.monotonic()
    checkpoint = None if wanted is None else resuming.checkpoint_of(directory, wanted, console)
    text = yaml.safe_dump(encode(replace(config, resume=False)), sort_keys=False)
    if wanted is None:  # first: whatever fails from here on, the run can be resumed
        layout.write_atomically(directory / layout.CONFIG, text)
    if checkpoint is not None:
        config = resuming.continued(config, directory, checkpoint)
    if wanted is not None and load is None:
        spec, _ = check_start(config)
    spec = spec or check_environment(config.env)
    check_placement(replace(config, output_dir=str(directory)))
    if config.imagination.share:
        from accerl_lerobot.engine.imagination import check_imagination

        check_imagination(config)
    if wanted is not None:  # only now: a resume that is refused leaves the run as it was
        layout.write_atomically(directory / layout.CONFIG, text)
    if checkpoint is not None:
        layout.go_back_to(checkpoint)
        console.say(f"going on from {checkpoint}")
    else:
        config = warm_start(config, directory, console)
    config, before_s = replace(config, output_dir=str(directory)), 0.0 if checkpoint is None else None
    times = Times(started=started, warm_s=time.monotonic() - started, before_s=before_s)
    with contextlib.ExitStack() as stack:  # flushes the log, whatever fails
        stop = stack.enter_context(Stopping(resuming.resume_command(directory, config)))
        times.clock = stack.enter_context(contextlib.closing(open_clock(config.timeline_folder, "driver")))
        log = stack.enter_context(contextlib.closing(MetricsLog(directory, config.wandb, encode(config))))
        recovery = resuming.Recovery(config.launch.max_restarts)
        while True:  # a run, or what is left of it, by one set of workers
            history = 1 if load is not None else check_policy(config, spec, own=True)
            state = None if checkpoint is None else checkpoint / layout.TRAINING_STATE
            try:
                with console.stage("starting workers"), stop.at_once():
                    engine = make_engine(config, spec.tasks, history, state, load, session)
                with contextlib.closing(engine):
                    loop = Loop(config, directory, console, log, engine, spec.tasks, times, stop)
                    return loop.run(state)
            except Exception as error:
                lost = "" if session is None else session.lost  # whatever error that has led to
                loss = WorkerError(lost) if lost else error
                if not isinstance(loss, WorkerError):
                    raise
                times.clock.enter(RECOVERY)
                stop.check()
                checkpoint = recovery.next(directory / layout.CHECKPOINTS, console, loss, times.furthest)
                stop.check()
                layout.go_back_to(checkpoint)
                config = resuming.continued(config, directory, checkpoint)


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
        """Begins another episode, for policies that remember former observations or actions."""
        self._episode, self._decisions = self._episode + 1, 0

    def act(self, observation: Observation) -> np.ndarray:
        """The next K actions by LeRobot's own sampler, float32 (K, A), in the environment's units.

        An observation has ``observation.images.<camera>`` uint8 (H, W, 3), ``observation.state`` float32 (S,)
        and ``task``, the instruction. For a policy with ``n_obs_steps`` above 1 each array begins with that
        dimension, oldest first, as ``make_environment(config, policy.history)`` gives them.
        """
        self._decisions += 1
        seed = noise_seed(self._episode, self._decisions)
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
    return _result(*start(config, Console()))


def resume(directory: str | Path, changes: Mapping[str, Any] | None = None) -> TrainResult:
    """Resumes a run that was stopped, from its last complete checkpoint."""
    recipe = Path(directory) / layout.CONFIG
    config = load_config(recipe, {**(changes or {}), "resume": True})
    return _result(*start(config, Console(), recipe))


def evaluate(
    config: RunConfig,
    policy: str | Path | None = None,
    episodes: int | None = None,
    revision: str | None = None,
) -> EvaluationResult:
    """Success of a policy with LeRobot's own sampler, on starts that no run of this seed trains on.

    `config` has the environment, seed and workers, the `policy`, a LeRobot checkpoint on disk or the Hub (of
    the commit `revision`), and the number of `episodes`, where these are not given.
    """
    if policy is not None:
        config = resuming.improving(config, policy)
        config = replace(config, policy=replace(config.policy, revision=revision))
    if episodes is not None:
        config = replace(config, evaluation=replace(config.evaluation, episodes=episodes))
    with redirect_stdout(sys.stderr):
        results = play_evaluation(config, Console())
    names = sorted({result.plan.task for result in results})
    tasks = {name: _rate([result for result in results if result.plan.task == name]) for name in names}
    return EvaluationResult(success=_rate(results), tasks=tasks, episodes=results)


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


def _rate(results: list[EpisodeResult]) -> Rate:
    return Rate(successes=sum(r.success for r in results), n=len(results))
