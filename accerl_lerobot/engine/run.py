# SPDX-License-Identifier: Apache-2.0
"""One run from start to summary: demonstrations → SFT → evaluation → asynchronous RL → evaluation.

outputs/<run>/
  config.yaml            the resolved config; `accerl train --config_path=…/config.yaml` repeats the run,
                         and goes on with it with `--resume=true`
  demos/                 a LeRobotDataset, if this run recorded one
  sft/                   LeRobot's own training output, sft.log beside it
  checkpoints/NNNNNN/    LeRobot's layout, and all that is needed to go on; `last` is the newest
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
from typing import TYPE_CHECKING, Any, Protocol

import yaml

from accerl_lerobot.checkpoint.layout import (
    AWAY,
    CHECKPOINTS,
    CONFIG,
    DEMOS,
    PRETRAINED,
    TRAINING_STATE,
    begun,
    go_back_to,
    newest_whole,
    write_atomically,
)
from accerl_lerobot.console import Console
from accerl_lerobot.engine import ray_environment
from accerl_lerobot.engine.config import LaunchConfig, RunConfig, encode, timeline_folder
from accerl_lerobot.engine.contract import Engine, WorkerError, pause_s
from accerl_lerobot.engine.loop import Loop, Times
from accerl_lerobot.engine.preflight import check_placement, check_policy, check_start, check_world
from accerl_lerobot.engine.resume import heed_stop
from accerl_lerobot.engine.stopping import Stopping
from accerl_lerobot.errors import InputError, check_absent, expanded, is_full, make_folder
from accerl_lerobot.metrics import METRICS, MetricsLog
from accerl_lerobot.policies.config import Load
from accerl_lerobot.replay.journal import EPISODES
from accerl_lerobot.timeline import RECOVERY, open_clock

if TYPE_CHECKING:
    from accerl_lerobot.engine.own_ray import OwnRay

logger = logging.getLogger(__name__)

BASE = "base"
"""Folder of a run: the policy that it began from, where that had to be computed back."""
WARM_START = "warm_start.json"
"""File that says which policy a run's own demonstrations and SFT have led to."""


class Placed(Protocol):
    """A config that says where its results go."""

    @property
    def output_dir(self) -> str | None:
        """The folder, which must not exist; None: one named after date, time and job."""

    @property
    def job_name(self) -> str:
        """Name of the run's folder."""


def make_output_dir(config: Placed) -> Path:
    """Creates the folder of a run.

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


def make_engine(
    config: RunConfig,
    tasks: tuple[str, ...],
    history: int,
    state: Path | None = None,
    load: Load | None = None,
    own: OwnRay | None = None,
) -> Engine:
    """The engine that ``launch.engine`` names.

    Args:
        config: the run.
        tasks: the training tasks.
        history: env steps that the policy sees at a time.
        state: the ``training_state`` to go on from; None: begin.
        load: makes the policy's adapter; None: of LeRobot's checkpoint.
        own: the Ray to use, which outlives the engine; None: one that ends with it.
    """
    if config.launch.engine == "local":
        from accerl_lerobot.engine.local import LocalEngine

        return LocalEngine(config, tasks, history, state, load)
    ray_environment.prepare(joins=config.launch.address is not None)
    from accerl_lerobot.engine.launch import RayEngine

    return RayEngine(config, tasks, history, state, load, own)


def warm_start(config: RunConfig, directory: Path, console: Console) -> RunConfig:
    """Records demonstrations and runs SFT where the config asks for it; sets ``policy.path``."""
    from accerl_lerobot.demos.record import record_demos
    from accerl_lerobot.demos.sft import run_sft
    from accerl_lerobot.demos.windows import open_metadata, task_texts
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
            dataset.repo_id,
            dataset.root,
            directory / "sft",
            config.seed,
            str(resolve_device(config.policy.device)),
            task_texts(meta),
            on_step=lambda step, loss: stage.update(step, f"loss {loss:.3f}"),
            revision=dataset.revision,
        )
    return _improving(config, path)


def train(
    config: RunConfig,
    directory: Path,
    console: Console,
    wanted: str | None = None,
    load: Load | None = None,
) -> dict[str, Any]:
    """Runs everything and returns the summary, which is also in ``summary.json``.

    Args:
        config: the run.
        directory: its folder; empty, if it is a new one.
        console: progress for people.
        wanted: the checkpoint to go on from, where the run has been begun before; see
            `checkpoint.newest_whole`.
        load: makes the policy's adapter, and may be given a path of its own; None: of LeRobot's checkpoint.

    Raises:
        InputError: the settings do not fit each other, or no checkpoint can be gone on from.
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
        _check_imagination(config, going_on=False)
        config = _warm_started(config, directory, console)
    else:
        go_back_to(checkpoint)
        config = _going_on(config, directory, checkpoint, console)
        if load is None:
            check_start(config)
        _check_imagination(config, going_on=True)
        console.say(f"going on from {checkpoint}")
    before_s = 0.0 if checkpoint is None else None
    config = replace(config, output_dir=str(directory))
    times = Times(started=started, warm_s=time.monotonic() - started, before_s=before_s)
    with contextlib.ExitStack() as stack:  # flushes the log, whatever fails
        stop = stack.enter_context(Stopping())
        times.clock = stack.enter_context(contextlib.closing(open_clock(timeline_folder(config), "driver")))
        log = stack.enter_context(contextlib.closing(MetricsLog(directory, config.wandb, encode(config))))
        own = (
            None
            if config.launch.engine == "local"
            else stack.enter_context(contextlib.closing(_own_ray(config.launch)))
        )
        recovery = Recovery(config.launch.max_recoveries)
        while True:
            try:
                return _attempt(config, directory, checkpoint, console, log, tasks, times, stop, load, own)
            except Exception as error:
                lost = "" if own is None else own.lost  # whatever error that has led to
                loss = WorkerError(lost) if lost else error
                if not isinstance(loss, WorkerError):
                    raise
                times.clock.enter(RECOVERY)
                heed_stop(stop, directory)
                checkpoint = recovery.next(directory / CHECKPOINTS, console, loss, times.furthest)
                heed_stop(stop, directory)
                go_back_to(checkpoint)
                config = _going_on(config, directory, checkpoint, console)


def _own_ray(launch: LaunchConfig) -> OwnRay:
    ray_environment.prepare(joins=launch.address is not None)
    from accerl_lerobot.engine.own_ray import OwnRay

    return OwnRay(launch)


def _attempt(
    config: RunConfig,
    directory: Path,
    checkpoint: Path | None,
    console: Console,
    log: MetricsLog,
    tasks: tuple[str, ...],
    times: Times,
    stop: Stopping,
    load: Load | None,
    own: OwnRay | None,
) -> dict[str, Any]:
    """The run, or what is left of it, by one set of workers, which have ended when this returns or raises."""
    history = 1 if load is not None else check_policy(config, own=True)
    state = None if checkpoint is None else checkpoint / TRAINING_STATE
    try:
        with console.stage("starting workers"), stop.at_once():
            engine = make_engine(config, tasks, history, state, load, own)
    except KeyboardInterrupt:
        heed_stop(stop, directory)
        raise
    with contextlib.closing(engine):
        return Loop(config, directory, console, engine, log, tasks, times, stop).run(state)


class Recovery:
    """Goes on after the loss of a worker, from the last checkpoint, unless it happens again and again.

    Args:
        most: times in a row.
    """

    def __init__(self, most: int) -> None:
        self._most, self._times, self._begun, self._furthest = most, 0, "", -1

    def next(self, checkpoints: Path, console: Console, error: WorkerError, furthest: int) -> Path:
        """The checkpoint to go on from; where that is done again waits a little, longer each time.

        Args:
            checkpoints: of the run.
            console: is told.
            error: what was lost.
            furthest: the latest update so far. A run that gets further each time is not stuck, though it may
                be hit again before its next checkpoint.

        Raises:
            WorkerError: the one given: there is no checkpoint, or it has been tried often enough.
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
    """The one to go on from; None if the run had not come so far."""
    if not begun(directory / CHECKPOINTS):
        console.say("there is no checkpoint yet: what is left of the run is begun from its warm start on")
        for name in (METRICS, EPISODES):
            (directory / name).unlink(missing_ok=True)
        shutil.rmtree(directory / "tensorboard", ignore_errors=True)
        return None
    path, passed = newest_whole(directory / CHECKPOINTS, wanted)
    for why in passed:
        console.say(f"passed over checkpoint {why}")
    return path


def _warm_started(config: RunConfig, directory: Path, console: Console) -> RunConfig:
    """Runs the warm start, unless it has been; what was left of one that was stopped is made anew."""
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
    return _improving(config, path)


def _going_on(config: RunConfig, directory: Path, checkpoint: Path, console: Console) -> RunConfig:
    """The run from its checkpoint on, which holds all that it takes, whatever has become of its start."""
    if config.policy.tuning.mode != "lora":
        return _improving(config, checkpoint / PRETRAINED)
    # A checkpoint has low-rank adapters merged; apart from what they adapt they are in the training state.
    start = _start(config, directory)
    if start is None:
        start = str(directory / BASE)
        if not Path(start).is_dir():
            from accerl_lerobot.policies.computed_back import compute_back

            with console.stage("the policy it began from is not here: computing it back, to rounding"):
                compute_back(config.policy, checkpoint, directory / BASE)
    return _improving(config, start)


def _start(config: RunConfig, directory: Path) -> str | None:
    """The policy that a run began from, in a folder or on the Hub; None if it is not here any more."""
    path, note = config.policy.path, directory / WARM_START
    if path is None:
        made = directory / json.loads(note.read_text())["policy"] if note.is_file() else None
        return str(made) if made is not None and made.is_dir() else None
    on_the_hub = not path.startswith((".", "/", "~", f"{AWAY}/")) and path.count("/") <= 1
    return path if on_the_hub or Path(path).expanduser().is_dir() else None


def _check_imagination(config: RunConfig, going_on: bool) -> None:
    if config.imagination.share:
        from accerl_lerobot.engine.imagination import check_imagination

        path = config.imagination.path
        if going_on and path is not None and not Path(path).expanduser().is_dir():
            remedy = (
                "no such folder; the world model of the start is not in the checkpoints: put a copy there"
            )
            raise InputError("imagination.path", path, remedy)
        check_imagination(config)


def _improving(config: RunConfig, path: Path | str) -> RunConfig:
    """The run as one that improves a checkpoint."""
    return replace(config, policy=replace(config.policy, path=str(path)), sft=replace(config.sft, steps=0))
