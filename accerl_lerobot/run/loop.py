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

The four are processes in `launch`, and take turns in one process in `local`. Where a world model learns in
the run, it has a process too: `world_model.worker` for the state of critic and teacher, `world_model.online`
for imagined environments, which rollout workers step like real ones.
"""

from __future__ import annotations

import json
import logging
import math
import shutil
import time
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from accerl_lerobot.checkpoint import layout, snapshot
from accerl_lerobot.console import Console
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.engines.contract import Engine, Progress
from accerl_lerobot.engines.stopping import Stopping
from accerl_lerobot.errors import warn_once
from accerl_lerobot.evaluation import (
    before_after,
    evaluation_plans,
    notes,
    success_by_task,
    success_curve,
    summarise,
)
from accerl_lerobot.experience import IMAGINED, REAL
from accerl_lerobot.metrics import MetricsLog, plain
from accerl_lerobot.rollout.runner import EpisodeResult
from accerl_lerobot.timeline import CHECKPOINT, EVALUATION, TRAINING, Clock, NoClock

logger = logging.getLogger(__name__)

FILMED = ".before"  # name of the filmed episodes of the first evaluation, kept until the video is made
RECORD_EVERY = 10  # updates between two records of the workers' counters when no episode ends
HOPELESS = 50  # exploring episodes without a success after which the user is told
RECENT = 100  # exploring episodes over which the training success of the curve is averaged
COUNTERS = ("decisions", "episodes", "dropped_nonfinite", "dropped_episodes")  # of a runner, in the summary
_STATE = (
    "before", "evaluations", "curve", "recent", "imagined", "explored", "won", "note", "lags", "lag_max",
    "mismatch_max", "during", "base", "steps", "evaluated", "saved",
)  # fmt: skip


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
            ended = [e for e in progress.episodes if e.plan.group == group]
            _warn_of_notes(ended)
            results += ended
            on_progress(progress)
            stage.update(len(results), f"{np.mean([r.success for r in results]):.0%}" if results else "")
    for note in notes(results):  # their first words, as all of them were told with the first such episode
        logger.warning("evaluation (%s), %s", group, ": ".join(note.split(": ")[:2]))
    return sorted(results, key=lambda r: r.plan.index)


def _warn_of_notes(episodes: Iterable[EpisodeResult]) -> None:
    for episode in episodes:
        if episode.note:
            warn_once(episode.note)


@dataclass(kw_only=True)
class Times:
    """Seconds of a run; `started` is when this process began, on `time.monotonic`."""

    started: float
    warm_s: float = 0.0  # warm start
    rl_s: float = 0.0  # training, in earlier processes
    before_s: float | None = 0.0  # all, in earlier processes; None: the checkpoint has it
    furthest: int = 0  # latest update made in this process, lost or not
    clock: Clock = field(default_factory=NoClock)  # the driver's row of the timeline

    @property
    def wall_s(self) -> float:
        return (self.before_s or 0.0) + time.monotonic() - self.started


@dataclass(eq=False)
class Loop:
    """Evaluates, trains, saves checkpoints, and writes the results; `stop` tells when to save and end."""

    config: RunConfig
    directory: Path
    console: Console
    log: MetricsLog
    engine: Engine
    tasks: tuple[str, ...]
    times: Times
    stop: Stopping

    def __post_init__(self) -> None:
        self.before: dict[str, Any] | None = None  # the evaluation before training, where there was one
        self.evaluations: list[dict[str, Any]] = []
        self.curve: list[tuple[float, float]] = []
        self.recent: list[bool] = []
        self.imagined: list[bool] = []  # the same, of imagined episodes
        self.explored = self.won = 0  # exploring episodes that have ended, and successes among them
        self.note = ""  # of the last of them that had one, see `EpisodeResult`
        self.lags: list[float] = []
        self.lag_max = self.mismatch_max = 0.0
        self.during: dict[str, list[EpisodeResult]] = {}
        self.base: dict[str, float] = {}
        self.steps = math.inf  # env steps of the training, once it has ended
        self.evaluated = self.saved = 0  # evaluations and checkpoints that were due by the number of updates
        self._began_at: str | None = None
        self._training_since: float | None = None
        self._saved_at = time.monotonic()
        self._hopeless = False  # True once it has been said that no exploring episode succeeds

    def run(self, state: Path | None) -> dict[str, Any]:
        """Do the run, or the rest of it; returns the summary."""
        filmed = self._begin() if state is None else self._resume(state)
        self.engine.train()
        self.times.clock.enter(TRAINING)
        self._training_since = self._saved_at = time.monotonic()
        with self._training_stage() as stage:
            while True:
                progress = self.engine.poll()
                self._record(progress)
                stage.update(progress.version, self._status(progress))
                if progress.done:
                    break
                if self._evaluation_is_due(progress):
                    self._plan(self.config.evaluation.episodes_during, f"during-{self.evaluated}")
                if self._save_is_due(progress) or self.stop.asked is not None:
                    self._save()
                self.stop.check()
        self.times.rl_s, self._training_since = self._rl_s, None
        self.steps = self._steps(progress)
        self._save()
        self._check_hope(1)
        after, results = self._evaluate("after", self.steps)
        summary: dict[str, Any] = plain(self._summary(after, progress))
        layout.write_atomically(self.directory / layout.SUMMARY, json.dumps(summary, indent=2) + "\n")
        self._draw(after, filmed, results)
        layout.prune(self.directory / layout.CHECKPOINTS)  # it has ended
        return summary

    def _begin(self) -> list[EpisodeResult]:
        """Evaluate before training, and save; returns the episodes of the evaluation."""
        filmed: list[EpisodeResult] = []
        if self.config.evaluation.before:
            self.before, filmed = self._evaluate("before", 0.0)
            snapshot.save(self.directory / FILMED, [result for result in filmed if result.frames])
            self.base = self.engine.poll().rollout
        if self.config.save_every_updates or self.config.save_every_s:
            self._save()
        return filmed

    def _resume(self, state: Path) -> list[EpisodeResult]:
        """Restore what the checkpoint has; returns the filmed episodes of the evaluation before."""
        self._began_at = state.parent.name
        self._restore(snapshot.load(state / layout.RUN_STATE), layout.saved_version(state))
        if not (self.directory / f"{FILMED}.json").is_file():
            return []
        filmed: list[EpisodeResult] = snapshot.load(self.directory / FILMED)
        return filmed

    def _training_stage(self) -> AbstractContextManager[Any]:
        config = self.config
        return self.console.stage(f"RL ({config.algorithm.type})", total=config.trainer.updates)

    def _evaluation_is_due(self, progress: Progress) -> bool:
        """True once for each number of updates after which rollout workers evaluate beside exploring."""
        every = self.config.evaluation.every_updates
        if not every or progress.version // every <= self.evaluated:
            return False
        self.evaluated = progress.version // every
        self.during[f"during-{self.evaluated}"] = []
        return True

    def _save_is_due(self, progress: Progress) -> bool:
        updates, seconds = self.config.save_every_updates, self.config.save_every_s
        if seconds and time.monotonic() - self._saved_at > seconds:
            return True
        return bool(updates) and progress.version // updates > self.saved

    def _draw(self, after: dict[str, Any], filmed: list[EpisodeResult], results: list[EpisodeResult]) -> None:
        """Write the run's pictures and its film."""
        success_curve(self.directory / "success_curve.png", self.evaluations, self.curve)
        if len(after["tasks"]) > 1:
            ends = {"before": self.before, "after": after}
            arms = {
                name: {task: [of["success"]] for task, of in end["tasks"].items()}
                for name, end in ends.items()
                if end is not None
            }
            success_by_task(self.directory / "success_by_task.png", arms)
        if any(result.frames for result in filmed):
            film = self.directory / "before_after.mp4"
            before_after(film, (filmed, self.before), (results, after), fps=20)
        for left in self.directory.glob(f"{FILMED}.*"):
            left.unlink()

    def _state(self) -> dict[str, Any]:
        spent = {"rl_s": self._rl_s, "wall_s": self.times.wall_s, "warm_s": self.times.warm_s}
        return {name: getattr(self, name) for name in _STATE} | {"log": self.log.state(), "times": spent}

    def _restore(self, state: dict[str, Any], version: int) -> None:
        for name in _STATE:
            setattr(self, name, state[name])
        self.log.restore(state["log"], version)
        times = state["times"]
        self.times.rl_s, self.times.warm_s = times["rl_s"], times["warm_s"]
        if self.times.before_s is None:
            self.times.before_s = times["wall_s"]
        if version < self.config.trainer.updates:  # more are asked for than were when it ended
            self.steps = math.inf
        evaluate, save = self.config.evaluation.every_updates, self.config.save_every_updates
        self.evaluated = min(self.evaluated, version // evaluate if evaluate else 0)
        self.saved = min(self.saved, version // save if save else 0)

    def _summary(self, after: dict[str, Any], last: Progress) -> dict[str, Any]:
        before = self.before or {}
        return {
            **{f"{name}_before": before.get(name) for name in ("success", "n", "ci95", "tasks")},
            **{f"{name}_after": after[name] for name in ("success", "n", "ci95", "tasks")},
            "env_steps": int(self.steps),
            **{k: int(self._since(last, k)) for k in COUNTERS},
            "updates": last.version,
            **{k: int(last.replay.get(k, 0)) for k in ("trained_decisions", "unique_decisions")},
            "restarts": int(last.rollout.get("restarts", 0)),
            "lag_mean": float(np.mean(self.lags)) if self.lags else 0.0,
            "lag_max": self.lag_max,
            "ratio_max_dev": self.mismatch_max,
            "wall_s": self.times.wall_s,
            "warm_start_s": self.times.warm_s,
            "rl_s": self.times.rl_s,
            "episodes_explored": self.explored,
            "note": self.note,
            "imagined_decisions": int(self._since(last, "imagined_decisions")),
            "imagined_episodes": int(self._since(last, "imagined_episodes")),
            "algorithm": self.config.algorithm.type,
            "tasks": list(self.tasks),
            "seed": self.config.seed,
        }

    def _check_hope(self, episodes: int) -> None:
        """Tells once if none of at least so many exploring episodes has succeeded."""
        if self.won or self._hopeless or self.explored < episodes:
            return
        self._hopeless = True
        note = f" ({self.note})" if self.note else ""
        logger.warning(
            "none of %d exploring episodes succeeded%s; where success is the only reward there is nothing to "
            "learn from: see env.success, and docs/troubleshooting.md",
            self.explored, note,
        )  # fmt: skip

    @property
    def _rl_s(self) -> float:
        since = self._training_since
        return self.times.rl_s + (0.0 if since is None else time.monotonic() - since)

    def _record_updates(self, updates: list[dict[str, float]]) -> None:
        for metrics in updates:
            self.lags.append(metrics["lag_mean"])
            self.lag_max = max(self.lag_max, metrics["lag_max"])
            self.mismatch_max = max(self.mismatch_max, metrics.get("ratio_max_dev", 0.0))
            self.log.write("train", int(metrics["update"]), metrics)
            self.times.furthest = max(self.times.furthest, int(metrics["update"]))

    def _record(self, progress: Progress) -> None:
        self.times.clock.beat()
        self._record_updates(progress.updates)
        explored = [e for e in progress.episodes if e.plan.explore and e.plan.source == REAL]
        imagined = [e.success for e in progress.episodes if e.plan.source == IMAGINED]
        self.imagined = (self.imagined + imagined)[-RECENT:]
        self.explored += len(explored)
        self.won += sum(e.success for e in explored)
        _warn_of_notes(progress.episodes)
        self.note = next((e.note for e in reversed(explored) if e.note), self.note)
        self._check_hope(HOPELESS)
        self.recent = (self.recent + [e.success for e in explored])[-RECENT:]
        share = float(np.mean(self.recent)) if self.recent else math.nan
        # The first episodes to end are the short ones, which are successes.
        if explored and len(self.recent) >= RECENT // 4 and math.isinf(self.steps):  # it is training
            self.curve.append((self._steps(progress), share))
        # Imagined episodes and learning go on once all real episodes have been played.
        if explored or any(metrics["update"] % RECORD_EVERY == 0 for metrics in progress.updates):
            values = progress.rollout | {"success_exploring": share}
            if self.imagined:
                values["success_imagined"] = float(np.mean(self.imagined))
            if explored:
                sums = np.sum([(e.episode_return, e.steps, e.decisions) for e in explored], axis=0)
                names = ("episode_return", "episode_steps", "episode_decisions")
                values |= dict(zip(names, sums / len(explored), strict=True))
            for part in ("replay", "inference", "world_model"):
                values |= {f"{part}_{k}": v for k, v in getattr(progress, part).items()}
            self.log.write("rollout", progress.version, values)
        for episode in progress.episodes:
            if (results := self.during.get(group := episode.plan.group)) is not None:
                results.append(episode)
                if len(results) == self.config.evaluation.episodes_during:
                    self._report(group, results, self._steps(progress), progress.version)

    def _plan(self, episodes: int, group: str, filmed: int = 0) -> None:
        seed = self.config.seed
        self.engine.plan(evaluation_plans(self.tasks, episodes, group, seed=seed, filmed=filmed))

    def _evaluate(self, group: str, steps: float) -> tuple[dict[str, Any], list[EpisodeResult]]:
        self.times.clock.enter(EVALUATION)
        episodes = self.config.evaluation.episodes
        self._plan(episodes, group, filmed=self.config.evaluation.videos)
        # An evaluation planned while training may end only now.
        results = run_plans(self.engine, episodes, group, self.console, self._meanwhile)
        return self._report(group, results, steps, results[0].versions[1]), results

    def _meanwhile(self, progress: Progress) -> None:
        self._record(progress)
        self.stop.check()

    def _report(self, group: str, results: list[EpisodeResult], steps: float, version: int) -> dict[str, Any]:
        summary = summarise(results) | {"env_steps": steps, "group": group}
        self.evaluations.append(summary)
        self.log.write("evaluation", version, summary)
        low, high = summary["ci95"]
        self.console.say(
            f"{group}: success {summary['success']:.1%} [{low:.1%}, {high:.1%}] n={summary['n']} "
            f"weights {summary['version_min']}–{summary['version_max']}"
        )
        return summary

    def _save(self) -> None:
        def write(folder: Path) -> int:
            saved = self.engine.save(folder)
            self._record_updates(saved.updates)
            every = self.config.save_every_updates
            self.saved = saved.version // every if every else 0
            shutil.copyfile(self.directory / layout.CONFIG, folder / layout.CONFIG)
            snapshot.save(folder / layout.TRAINING_STATE / layout.RUN_STATE, self._state())
            return saved.version

        with self.times.clock.during(CHECKPOINT):
            path = layout.save_checkpoint(self.directory / layout.CHECKPOINTS, write)
        layout.prune(self.directory / layout.CHECKPOINTS, needed=self._began_at)
        self._saved_at = time.monotonic()
        self.console.say(f"checkpoint {path / layout.PRETRAINED}")

    def _since(self, progress: Progress, key: str) -> float:
        """A rollout counter since training began, evaluations meanwhile included."""
        return progress.rollout.get(key, 0.0) - self.base.get(key, 0.0)

    def _steps(self, progress: Progress) -> float:
        return min(self.steps, self._since(progress, "env_steps"))

    def _status(self, progress: Progress) -> str:
        success = f"{np.mean(self.recent):.0%} of {len(self.recent)}" if self.recent else "…"
        lag = f"{self.lags[-1]:.0f}" if self.lags else "…"
        decisions = f"{self._since(progress, 'decisions'):.0f} decisions"
        words = f"exploring success {success} · lag {lag} · {decisions}"
        if dropped := self._since(progress, "dropped_episodes"):
            words += f" · {dropped:.0f} episodes dropped"
        if self.evaluations:
            newest = self.evaluations[-1]
            words += f" · evaluation {newest['success']:.0%} at update {newest['version_max']}"
        return words
