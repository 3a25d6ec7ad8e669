# SPDX-License-Identifier: Apache-2.0
"""One run from start to summary: demonstrations → SFT → evaluation → asynchronous RL → evaluation.

outputs/<run>/
  config.yaml            the resolved config; `accerl train --config_path=…/config.yaml` repeats the run,
                         and resumes it with `--resume=true`
  demos/                 a LeRobotDataset, if this run recorded one
  sft/                   LeRobot's own training output, sft.log beside it
  checkpoints/NNNNNN/    LeRobot's layout, and everything needed to resume; `last` is the newest
  metrics.jsonl          and tensorboard/
  timeline/              what every worker did when, see `accerl timeline`
  success_curve.png, summary.json, and before_after.mp4 unless evaluation.before=false
"""

from __future__ import annotations

import contextlib
import datetime
import json
import logging
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from accerl_lerobot.algorithms import ChunkCriticConfig, OffPolicyConfig
from accerl_lerobot.checkpoint.layout import (
    AWAY,
    CHECKPOINTS,
    CONFIG,
    DEMOS,
    PRETRAINED,
    TRAINING_STATE,
    go_back_to,
    has_checkpoint,
    newest_whole,
    write_atomically,
)
from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.console import Console
from accerl_lerobot.engine import ray_session
from accerl_lerobot.engine.config import RunConfig, encode, timeline_folder
from accerl_lerobot.engine.contract import Engine, WorkerError, pause_s
from accerl_lerobot.engine.loop import Loop, Outputs, Times, run_plans
from accerl_lerobot.engine.preflight import (
    check_machine,
    check_placement,
    check_policy,
    check_start,
    check_world,
)
from accerl_lerobot.engine.stopping import LOCK, Stopping, raise_if_stopped
from accerl_lerobot.errors import InputError, check_absent, expanded, is_full, make_folder
from accerl_lerobot.evaluation import evaluation_plans
from accerl_lerobot.metrics import METRICS, MetricsLog
from accerl_lerobot.policies.config import Load, loader
from accerl_lerobot.replay.journal import EPISODES
from accerl_lerobot.rollout.runner import EpisodeResult
from accerl_lerobot.timeline import RECOVERY, open_clock

if TYPE_CHECKING:
    from accerl_lerobot.engine.ray_session import RaySession

logger = logging.getLogger(__name__)

BASE = "base"
"""Folder of the policy that a run began from, where that had to be reconstructed."""
WARM_START = "warm_start.json"
"""File with the path of the policy that came of a run's own demonstrations and SFT."""


def make_output_dir(config: Any) -> Path:
    """Create the folder of a run: ``output_dir``, or one named after date, time and ``job_name``.

    Raises:
        InputError: it exists, or cannot be created.
    """
    if config.output_dir is None:
        now = datetime.datetime.now()
        path = Path("outputs") / f"{now:%Y-%m-%d}" / f"{now:%H-%M-%S}_{config.job_name}"
    else:
        path = expanded(config.output_dir, "output_dir")
    check_absent(path)
    make_folder(path, "output_dir")
    return path


def discard_unused(directory: Path) -> None:
    """Remove the folder of a run that was refused before it did anything, so that its name is free again."""
    if {path.name for path in directory.iterdir()} <= {CONFIG, LOCK}:
        shutil.rmtree(directory)


def evaluate(config: RunConfig, console: Console, filmed: int = 0) -> list[EpisodeResult]:
    """Play the evaluation episodes of a run with LeRobot's sampler, on seeds that are never trained on.

    Args:
        config: of which the sections of algorithms and training do not matter.
        console: progress for people.
        filmed: episodes whose frames are kept.
    """
    check_machine(config)
    spec = check_world(config.env)
    engine = make_engine(config, spec.tasks, check_policy(config, spec))
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
        from accerl_lerobot.policies.teacher import WithTeacher

        size, algorithm = history * config.env.state_size, config.algorithm
        load = WithTeacher(loader(load), size, algorithm.teacher_episodes, algorithm.teacher_noise)
    if isinstance(config.algorithm, OffPolicyConfig) and (dataset := demonstrations_of(config)) is not None:
        from accerl_lerobot.trainer.demonstrations import WithDemonstrations

        load = WithDemonstrations(loader(load), dataset, config.rollout.decision_cost)
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
    own = None if config.output_dir is None else Path(config.output_dir).absolute() / DEMOS
    if own is None or not own.is_dir():
        return None
    return replace(config.dataset, repo_id=config.demos.repo_id, root=str(own))


def warm_start(config: RunConfig, directory: Path, console: Console) -> RunConfig:
    """Record demonstrations and run SFT where the config asks for it; set ``policy.path``."""
    from accerl_lerobot.demos.dataset_files import open_metadata, task_texts
    from accerl_lerobot.demos.record import record_demos
    from accerl_lerobot.demos.sft import run_sft
    from accerl_lerobot.policies.loading import resolve_device

    if not config.sft.steps:
        remedy = "give a LeRobot checkpoint, or sft.steps > 0 to make one from demonstrations"
        raise InputError("policy.path", None, remedy)
    dataset = config.dataset
    if dataset.repo_id is None:
        root = directory / DEMOS
        with console.stage("demonstrations"):
            record_demos(config.env, replace(config.demos, root=str(root), seed=config.seed))
        dataset = replace(dataset, repo_id=config.demos.repo_id, root=str(root))
    meta = open_metadata(dataset)
    with console.stage("SFT", total=config.sft.steps) as stage:
        assert dataset.repo_id is not None
        path = run_sft(
            config.sft,
            dataset,
            directory / "sft",
            config.seed,
            str(resolve_device(config.policy.device)),
            task_texts(meta),
            on_step=lambda step, loss: stage.update(step, f"loss {loss:.3f}"),
        )
    return improving(config, path)


def train(
    config: RunConfig,
    directory: Path,
    console: Console,
    wanted: str | None = None,
    load: Load | None = None,
) -> dict[str, Any]:
    """Run everything and return the summary, which is also in ``summary.json``.

    Args:
        config: the run.
        directory: its folder; empty, if it is a new one.
        console: progress for people.
        wanted: the checkpoint to resume from, where the run has been begun before; see
            `checkpoint.newest_whole`.
        load: makes the policy's adapter, and may be given a path of its own; None: of LeRobot's checkpoint.

    Raises:
        InputError: the settings do not fit each other, or no checkpoint can be resumed from.
        StoppedError: it was asked to stop, and has been saved.
    """
    started = time.monotonic()
    checkpoint = None if wanted is None else _checkpoint(directory, wanted, console)
    if wanted is not None and checkpoint is None and load is None:
        check_start(config)
    text = yaml.safe_dump(encode(replace(config, resume=False)), sort_keys=False)
    write_atomically(directory / CONFIG, text)
    tasks = check_world(config.env).tasks
    check_placement(replace(config, output_dir=str(directory)))
    if checkpoint is None:
        _check_imagination(config, resuming=False)
        config = _warm_started(config, directory, console)
    else:
        go_back_to(checkpoint)
        config = _resumed(config, directory, checkpoint, console)
        if load is None:
            check_start(config)
        _check_imagination(config, resuming=True)
        console.say(f"going on from {checkpoint}")
    before_s = 0.0 if checkpoint is None else None
    config = replace(config, output_dir=str(directory))
    times = Times(started=started, warm_s=time.monotonic() - started, before_s=before_s)
    with contextlib.ExitStack() as stack:  # flushes the log, whatever fails
        stop = stack.enter_context(Stopping())
        times.clock = stack.enter_context(contextlib.closing(open_clock(timeline_folder(config), "driver")))
        log = stack.enter_context(contextlib.closing(MetricsLog(directory, config.wandb, encode(config))))
        session = None
        if config.launch.engine != "local":
            ray_session.prepare(joins=config.launch.address is not None)
            session = stack.enter_context(contextlib.closing(ray_session.RaySession(config.launch)))
        recovery = Recovery(config.launch.max_recoveries)
        while True:
            # A run, or what is left of it, by one set of workers.
            history = 1 if load is not None else check_policy(config, own=True)
            state = None if checkpoint is None else checkpoint / TRAINING_STATE
            try:
                try:
                    with console.stage("starting workers"), stop.at_once():
                        engine = make_engine(config, tasks, history, state, load, session)
                except KeyboardInterrupt:
                    raise_if_stopped(stop, directory)
                    raise
                with contextlib.closing(engine):
                    outputs = Outputs(directory, console, log)
                    return Loop(config, outputs, engine, tasks, times, stop).run(state)
            except Exception as error:
                lost = "" if session is None else session.lost  # whatever error that has led to
                loss = WorkerError(lost) if lost else error
                if not isinstance(loss, WorkerError):
                    raise
                times.clock.enter(RECOVERY)
                raise_if_stopped(stop, directory)
                checkpoint = recovery.next(directory / CHECKPOINTS, console, loss, times.furthest)
                raise_if_stopped(stop, directory)
                go_back_to(checkpoint)
                config = _resumed(config, directory, checkpoint, console)


class Recovery:
    """Chooses the checkpoint to resume from after the loss of a worker, unless that happens again and again.

    Args:
        most: times in a row.
    """

    def __init__(self, most: int) -> None:
        self._most, self._times, self._begun, self._furthest = most, 0, "", -1

    def next(self, checkpoints: Path, console: Console, error: WorkerError, furthest: int) -> Path:
        """The checkpoint to resume from; waits longer each time without progress in between.

        Args:
            furthest: the latest update so far. A run that gets further each time is not stuck, though it may
                be hit again before its next checkpoint.

        Raises:
            WorkerError: `error`: there is no checkpoint, or it has been tried often enough.
        """
        try:
            path, passed = newest_whole(checkpoints)
        except InputError:
            raise error from None
        stuck = path.name == self._begun and furthest <= self._furthest
        self._times = self._times + 1 if stuck else 1
        self._begun, self._furthest = path.name, max(furthest, self._furthest)
        if self._times > self._most:
            raise error
        for why in passed:
            console.say(f"passed over checkpoint {why}")
        pause = pause_s(self._times - 1)
        when = f" in {pause:.0f} s" if pause else ""
        reason = f"the disk of {checkpoints.parent} is full" if is_full(error) else error
        console.say(f"{reason}\ngoing on from {path}{when} ({self._times} of {self._most} times)")
        time.sleep(pause)
        return path


def _checkpoint(directory: Path, wanted: str, console: Console) -> Path | None:
    """The checkpoint to resume from; None if there is none yet."""
    if not has_checkpoint(directory / CHECKPOINTS):
        console.say("there is no checkpoint yet: the run begins again after its warm start")
        for name in (METRICS, EPISODES):
            (directory / name).unlink(missing_ok=True)
        shutil.rmtree(directory / "tensorboard", ignore_errors=True)
        return None
    path, passed = newest_whole(directory / CHECKPOINTS, wanted)
    for why in passed:
        console.say(f"passed over checkpoint {why}")
    return path


def _warm_started(config: RunConfig, directory: Path, console: Console) -> RunConfig:
    """Run the warm start, unless that has been done; one that was stopped begins again."""
    note = directory / WARM_START
    if config.policy.path is not None:
        return config
    if not note.is_file():
        for name in (DEMOS, f"{DEMOS}.partial", "sft"):
            shutil.rmtree(directory / name, ignore_errors=True)
        warm = warm_start(config, directory, console)
        path = Path(str(warm.policy.path)).absolute().relative_to(directory.absolute())
        write_atomically(note, json.dumps({"policy": str(path)}) + "\n")
        return warm
    path = directory / json.loads(note.read_text())["policy"]
    return improving(config, path)


def _resumed(config: RunConfig, directory: Path, checkpoint: Path, console: Console) -> RunConfig:
    """The run from its checkpoint on, which holds everything, whatever has become of its start."""
    if config.policy.tuning.mode != "lora":
        return improving(config, checkpoint / PRETRAINED)
    # A checkpoint has low-rank adapters merged; apart from what they adapt they are in the training state.
    start = _start(config, directory)
    if start is None:
        start = str(directory / BASE)
        if not Path(start).is_dir():
            from accerl_lerobot.policies.loading import reconstruct_base

            with console.stage("the policy it began from is not here: reconstructing it, up to rounding"):
                reconstruct_base(config.policy, checkpoint, directory / BASE)
    return improving(config, start)


def _start(config: RunConfig, directory: Path) -> str | None:
    """The policy that a run began from, a folder or Hub id; None if it is not here any more."""
    path, note = config.policy.path, directory / WARM_START
    if path is None:
        made = directory / json.loads(note.read_text())["policy"] if note.is_file() else None
        return str(made) if made is not None and made.is_dir() else None
    on_the_hub = not path.startswith((".", "/", "~", f"{AWAY}/")) and path.count("/") <= 1
    return path if on_the_hub or Path(path).expanduser().is_dir() else None


def _check_imagination(config: RunConfig, resuming: bool) -> None:
    if config.imagination.share:
        from accerl_lerobot.engine.imagination import check_imagination

        path = config.imagination.path
        if resuming and path is not None and not Path(path).expanduser().is_dir():
            remedy = (
                "no such folder; the first world model of a run is not in its checkpoints: put a copy there"
            )
            raise InputError("imagination.path", path, remedy)
        check_imagination(config)


def improving(config: RunConfig, path: Path | str) -> RunConfig:
    """The run as one that improves a checkpoint."""
    return replace(config, policy=replace(config.policy, path=str(path)), sft=replace(config.sft, steps=0))
