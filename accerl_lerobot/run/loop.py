# SPDX-License-Identifier: Apache-2.0
"""The run: evaluate, train, save, evaluate again; by an engine that does the work.

    environments ◄──► rollout ◄──► inference ◄───── weights ─────┐
                         │                                       │
                         └──segments──► replay ──batches──► trainer

    loop        consumes              produces            waits for                   ends
    rollout     decisions, orders     segments, results   decisions; room in replay   with the run
    inference   requests, weights     decisions           a batch, or `max_wait_s`    with the run
    replay      segments              batches             new data; for rollouts,     with the trainer
                                                          the trainer to catch up
    trainer     batches               weights             a batch                     after its updates
    run         reports of the four   evaluations,        the next report             after the last
                                      checkpoints                                     evaluation

The four are processes in `ray_engine`, and take turns in one process in `local`. Where a world model learns
in the run, it has a process too: `world_model.worker` for the state of critic and teacher,
`world_model.training` for imagined environments, which rollout workers step like real ones.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from accerl_lerobot.checkpoint import layout, snapshot
from accerl_lerobot.console import Console, rate
from accerl_lerobot.engines import Engine, Progress
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.engines.stopping import Stopping
from accerl_lerobot.errors import warn_once
from accerl_lerobot.evaluation import before_after, evaluation_plans, success_curve, summarise
from accerl_lerobot.experience import IMAGINED
from accerl_lerobot.metrics import MetricsLog, plain
from accerl_lerobot.rollout.runner import EpisodeResult
from accerl_lerobot.timeline import CHECKPOINT, EVALUATION, TRAINING, Clock, NoClock

FILMED = ".before"  # name of the filmed episodes of the first evaluation, kept until the video is made
RECORD_EVERY = 10  # updates between two records of the workers' counters when no episode ends
HOPELESS = 50  # exploring episodes without a success after which the user is told
RECENT = 100  # exploring episodes over which the training success of the curve is averaged
RATE = ("success", "n", "ci95", "tasks")  # of an evaluation, in the summary
COUNTERS = ("decisions", "episodes", "dropped_nonfinite", "dropped_episodes", "imagined_decisions",
            "imagined_episodes")  # fmt: skip
"""Counters of the rollout workers in the summary."""


def run_plans(
    engine: Engine,
    count: int,
    group: str,
    console: Console,
    on_progress: Callable[[Progress], object] = lambda progress: None,
) -> list[EpisodeResult]:
    """Wait for `count` planned episodes of `group`; `on_progress` gets everything that is polled."""
    results: list[EpisodeResult] = []
    with console.stage(f"evaluation ({group})", total=count) as stage:
        while len(results) < count:
            progress = engine.poll()
            results += [episode for episode in progress.episodes if episode.plan.group == group]
            on_progress(progress)
            successes = [result.success for result in results]
            stage.update(len(results), f"{_mean(successes):.0%}" if successes else "")
    return sorted(results, key=lambda result: result.plan.index)


@dataclass(kw_only=True)
class Times:
    """Seconds of a run. Those since its workers began to start are in `MetricsLog`."""

    warm_s: float = 0.0  # before the workers began to start
    rl_s: float = 0.0  # training
    furthest: int = 0  # latest update made in this process, lost or not
    clock: Clock = field(default_factory=NoClock)  # the driver's row of the timeline


@dataclass(kw_only=True)
class RunState:
    """Progress of a run, as a checkpoint holds it."""

    before: dict[str, Any] | None = None  # the evaluation before training, where there was one
    evaluations: list[dict[str, Any]] = field(default_factory=list)
    during: dict[str, list[EpisodeResult]] = field(default_factory=dict)
    """Evaluations while training, and their episodes so far."""
    planned: dict[str, int] = field(default_factory=dict)  # number of the episodes of each
    curve: list[tuple[float, float]] = field(default_factory=list)  # env steps, success of exploring episodes
    recent: list[bool] = field(default_factory=list)  # success of the newest exploring episodes
    imagined: list[bool] = field(default_factory=list)  # the same, of imagined episodes
    explored: int = 0  # exploring episodes that have ended
    successes: int = 0  # of these
    note: str = ""  # of the last of them that had one, see `EpisodeResult`
    lags: list[float] = field(default_factory=list)
    lag_max: float = 0.0
    ratio_max_dev: float = 0.0
    counters_before: dict[str, float] = field(default_factory=dict)  # when training began
    training_steps: float | None = None  # env steps of the training, once it has ended
    evaluations_due: int = 0  # so far, by the number of updates
    checkpoints_due: int = 0


class Recorder:
    """Counts and logs the reports of an engine."""

    def __init__(self, config: RunConfig, log: MetricsLog, console: Console, times: Times) -> None:
        self.config = config
        self.log = log
        self.console = console
        self.times = times
        self.state = RunState()

    def record(self, progress: Progress) -> None:
        state = self.state
        self.times.clock.beat()
        self.record_updates(progress.updates)
        explored: list[EpisodeResult] = []
        for episode in progress.episodes:
            if episode.plan.source == IMAGINED:
                state.imagined.append(episode.success)
            elif episode.plan.explore:
                state.recent.append(episode.success)
                explored.append(episode)
        del state.imagined[:-RECENT]
        del state.recent[:-RECENT]
        for episode in explored:
            state.explored += 1
            state.successes += episode.success
            state.note = episode.note or state.note
        self.warn_if_hopeless(HOPELESS)
        # The first episodes to end are the short ones, which are successes.
        training = state.training_steps is None
        if explored and training and len(state.recent) >= RECENT // 4:
            point = (self.env_steps(progress), _mean(state.recent))
            state.curve.append(point)
        # Imagined episodes and learning go on once all real episodes have been played.
        due = any(metrics["update"] % RECORD_EVERY == 0 for metrics in progress.updates)
        if explored or due:
            self._log_counters(progress, explored)
        for episode in progress.episodes:
            group = episode.plan.group
            results = state.during.get(group)
            if results is not None:
                results.append(episode)
                if len(results) == state.planned[group]:
                    self.report(group, results, self.env_steps(progress), progress.version)

    def record_updates(self, updates: list[dict[str, float]]) -> None:
        state = self.state
        for metrics in updates:
            version = int(metrics["update"])
            state.lags.append(metrics["lag_mean"])
            state.lag_max = max(state.lag_max, metrics["lag_max"])
            state.ratio_max_dev = max(state.ratio_max_dev, metrics.get("ratio_max_dev", 0.0))
            self.log.write("train", version, metrics)
            self.times.furthest = max(self.times.furthest, version)

    def report(self, group: str, results: list[EpisodeResult], steps: float, version: int) -> dict[str, Any]:
        """Log an evaluation and print its success; returns its summary."""
        summary = summarise(results) | {"env_steps": steps, "group": group}
        self.state.evaluations.append(summary)
        self.log.write("evaluation", version, summary)
        success = rate(summary["success"], summary["ci95"])
        weights = f"weights {summary['version_min']}–{summary['version_max']}"
        self.console.say(f"{group}: success {success} of {summary['n']}, {weights}")
        return summary

    def since(self, progress: Progress, key: str) -> float:
        """A rollout counter since training began, evaluations meanwhile included."""
        return progress.rollout.get(key, 0.0) - self.state.counters_before.get(key, 0.0)

    def env_steps(self, progress: Progress) -> float:
        if self.state.training_steps is not None:
            return self.state.training_steps
        return self.since(progress, "env_steps")

    def status(self, progress: Progress) -> str:
        """The words beside the bar of training."""
        recent = self.state.recent
        lags = self.state.lags
        success = f"{_mean(recent):.0%} of {len(recent)}" if recent else "…"
        lag = f"{lags[-1]:.0f}" if lags else "…"
        decisions = self.since(progress, "decisions")
        return f"exploring success {success} · lag {lag} · {decisions:.0f} decisions"

    def warn_if_hopeless(self, least: int = 1) -> None:
        """Warn once if there were so many exploring episodes and none has succeeded."""
        if self.state.explored >= least and not self.state.successes:
            warn_once(
                "none of the exploring episodes has succeeded; where success is the only reward there is "
                "nothing to learn from: see env.success, and docs/troubleshooting.md"
            )

    def _log_counters(self, progress: Progress, explored: list[EpisodeResult]) -> None:
        state = self.state
        values = progress.rollout | {"success_exploring": _mean(state.recent)}
        if state.imagined:
            values["success_imagined"] = _mean(state.imagined)
        if explored:
            values["episode_return"] = _mean([episode.episode_return for episode in explored])
            values["episode_steps"] = _mean([episode.steps for episode in explored])
            values["episode_decisions"] = _mean([episode.decisions for episode in explored])
        for part in ("replay", "inference", "world_model"):
            for name, value in getattr(progress, part).items():
                values[f"{part}_{name}"] = value
        self.log.write("rollout", progress.version, values)


def _mean(values: Sequence[float]) -> float:
    """The mean; NaN for an empty sequence."""
    return float(np.mean(values)) if values else math.nan


class Loop:
    """Evaluates, trains, saves checkpoints, and writes the results; `stop` tells when to save and end."""

    def __init__(
        self,
        config: RunConfig,
        directory: Path,
        engine: Engine,
        tasks: tuple[str, ...],
        recorder: Recorder,
        stop: Stopping,
    ) -> None:
        self.config = config
        self.directory = directory
        self.engine = engine
        self.tasks = tasks
        self.stop = stop
        self.recorder = recorder
        self.state = recorder.state
        self.times = recorder.times
        self.console = recorder.console
        self._checkpoints = directory / layout.CHECKPOINTS
        self._began_at: str | None = None  # name of the checkpoint that this engine has begun from
        self._saved_at = time.monotonic()

    def run(self, training_state: Path | None) -> dict[str, Any]:
        """Do the run, or the rest of it from a ``training_state``; returns the summary."""
        filmed = self._begin() if training_state is None else self._resume(training_state)
        progress = self._train()
        self._save()
        self.recorder.warn_if_hopeless()
        after, results = self._evaluate("after", self.recorder.env_steps(progress))
        summary: dict[str, Any] = plain(self._summary(after, progress))
        layout.write_json(self.directory / layout.SUMMARY, summary)
        self._draw(filmed, results)
        self._prune()  # no replica restarts from `_began_at` any more
        return summary

    def _begin(self) -> list[EpisodeResult]:
        """Evaluate before training, and save; returns the filmed episodes of the evaluation."""
        filmed: list[EpisodeResult] = []
        if self.config.evaluation.before:
            self.state.before, results = self._evaluate("before", 0.0)
            filmed = [result for result in results if result.frames]
            snapshot.save(self.directory / FILMED, filmed)
            progress = self.engine.poll()  # nothing else is under way: only its counters are of use
            self.state.counters_before = progress.rollout
        if self.config.save_every_updates or self.config.save_every_s:
            self._save()
        return filmed

    def _resume(self, folder: Path) -> list[EpisodeResult]:
        """Restore the state of a checkpoint; returns the filmed episodes of the evaluation before."""
        state = self.state
        version = layout.saved_version(folder)
        self._began_at = folder.parent.name
        saved = snapshot.load(folder / layout.RUN_STATE)
        vars(state).update({name: saved[name] for name in vars(state)})
        self.recorder.log.restore(saved["log"], version)
        self.times.rl_s = saved["times"]["rl_s"]
        self.times.warm_s = saved["times"]["warm_s"]
        if version < self.config.trainer.updates:  # more are asked for than were when it ended
            state.training_steps = None
        # The config may now ask for fewer evaluations or checkpoints.
        evaluations = _multiples(version, self.config.evaluation.every_updates)
        checkpoints = _multiples(version, self.config.save_every_updates)
        state.evaluations_due = min(state.evaluations_due, evaluations)
        state.checkpoints_due = min(state.checkpoints_due, checkpoints)
        if not (self.directory / f"{FILMED}.json").is_file():
            return []
        filmed: list[EpisodeResult] = snapshot.load(self.directory / FILMED)
        return filmed

    def _train(self) -> Progress:
        """Poll until all updates are made, evaluate and save when it is due; returns the last report."""
        config = self.config
        times = self.times
        self.engine.train()
        times.clock.enter(TRAINING)
        self._saved_at = time.monotonic()
        began = self.recorder.log.wall_s - times.rl_s
        with self.console.stage(f"RL ({config.algorithm.type})", total=config.trainer.updates) as stage:
            while True:
                progress = self.engine.poll()
                times.rl_s = self.recorder.log.wall_s - began
                self.recorder.record(progress)
                stage.update(progress.version, self.recorder.status(progress))
                if progress.done:
                    break
                evaluations = _multiples(progress.version, config.evaluation.every_updates)
                if evaluations > self.state.evaluations_due:
                    self._evaluate_meanwhile(evaluations)
                if self._save_is_due(progress) or self.stop.asked is not None:
                    self._save()
                self.stop.check()
        self.state.training_steps = self.recorder.env_steps(progress)
        return progress

    def _plan(self, episodes: int, group: str, filmed: int = 0) -> None:
        """Queue the episodes of an evaluation."""
        self.state.planned[group] = episodes
        plans = evaluation_plans(self.tasks, episodes, group, seed=self.config.seed, filmed=filmed)
        self.engine.plan(plans)

    def _evaluate(self, group: str, steps: float) -> tuple[dict[str, Any], list[EpisodeResult]]:
        """Wait for an evaluation; its summary and episodes."""
        self.times.clock.enter(EVALUATION)
        episodes = self.config.evaluation.episodes
        self._plan(episodes, group, filmed=self.config.evaluation.videos)
        # An evaluation planned while training may end only now.
        results = run_plans(self.engine, episodes, group, self.console, self._meanwhile)
        return self.recorder.report(group, results, steps, results[0].versions[1]), results

    def _meanwhile(self, progress: Progress) -> None:
        self.recorder.record(progress)
        self.stop.check()

    def _evaluate_meanwhile(self, number: int) -> None:
        """Queue the evaluation of this number, which rollout workers play beside exploring."""
        self.state.evaluations_due = number
        group = f"during-{number}"
        self.state.during[group] = []
        self._plan(self.config.evaluation.episodes_during, group)

    def _save_is_due(self, progress: Progress) -> bool:
        seconds = self.config.save_every_s
        if seconds and time.monotonic() - self._saved_at > seconds:
            return True
        return _multiples(progress.version, self.config.save_every_updates) > self.state.checkpoints_due

    def _save(self) -> None:
        with self.times.clock.during(CHECKPOINT):
            path = layout.save_checkpoint(self._checkpoints, self._write)
        self._prune(self._began_at)
        self._saved_at = time.monotonic()
        self.console.say(f"checkpoint {path / layout.PRETRAINED}")

    def _prune(self, needed: str | None = None) -> None:
        layout.prune(self._checkpoints, needed=needed, every=self.config.save_every_updates)

    def _write(self, folder: Path) -> int:
        """Fill the folder of a checkpoint; returns its number of updates."""
        saved = self.engine.save(folder)
        self.recorder.record_updates(saved.updates)
        self.state.checkpoints_due = _multiples(saved.version, self.config.save_every_updates)
        shutil.copyfile(self.directory / layout.CONFIG, folder / layout.CONFIG)
        log = self.recorder.log.state()
        times = {"rl_s": self.times.rl_s, "warm_s": self.times.warm_s}
        state = vars(self.state) | {"log": log, "times": times}
        snapshot.save(folder / layout.TRAINING_STATE / layout.RUN_STATE, state)
        return saved.version

    def _draw(self, filmed: list[EpisodeResult], results: list[EpisodeResult]) -> None:
        """Write the run's pictures and its film."""
        success_curve(self.directory / "success_curve.png", self.state.evaluations, self.state.curve)
        film = self.directory / "before_after.mp4"
        film.unlink(missing_ok=True)  # it may be of an earlier end
        before_after(film, filmed, results, fps=20)
        for left in self.directory.glob(f"{FILMED}.*"):
            left.unlink()

    def _summary(self, after: dict[str, Any], last: Progress) -> dict[str, Any]:
        state = self.state
        before = state.before or {}
        return {
            **{f"{name}_before": before.get(name) for name in RATE},
            **{f"{name}_after": after[name] for name in RATE},
            "env_steps": int(self.recorder.env_steps(last)),
            **{name: int(self.recorder.since(last, name)) for name in COUNTERS},
            "updates": last.version,
            "trained_decisions": int(last.replay.get("trained_decisions", 0)),
            "unique_decisions": int(last.replay.get("unique_decisions", 0)),
            "restarts": int(last.rollout.get("restarts", 0)),
            "lag_mean": _mean(state.lags or [0.0]),
            "lag_max": state.lag_max,
            "ratio_max_dev": state.ratio_max_dev,
            "wall_s": self.times.warm_s + self.recorder.log.wall_s,
            "warm_start_s": self.times.warm_s,
            "rl_s": self.times.rl_s,
            "episodes_explored": state.explored,
            "note": state.note,
            "algorithm": self.config.algorithm.type,
            "tasks": list(self.tasks),
            "seed": self.config.seed,
        }


def _multiples(number: int, every: int) -> int:
    """How many multiples of `every` are not above `number`; 0 if `every` is 0."""
    return number // every if every else 0
