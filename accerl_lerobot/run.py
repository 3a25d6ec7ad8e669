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
"""One run from start to summary: demonstrations → SFT → evaluation → asynchronous RL → evaluation.

outputs/<run>/
  config.yaml            the resolved config; `accerl train --config_path=…/config.yaml` repeats the run
  demos/                 a LeRobotDataset, if this run recorded one
  sft/                   LeRobot's own training output, sft.log beside it
  checkpoints/NNNNNN/    LeRobot's layout; `last` is the newest
  metrics.jsonl          and tensorboard/
  success_curve.png, summary.json, and before_after.mp4 unless evaluation.before=false
"""

from __future__ import annotations

import contextlib
import datetime
import json
import logging
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import yaml

from accerl_lerobot import ray_environment
from accerl_lerobot.checkpoint import PRETRAINED, save_checkpoint
from accerl_lerobot.config import RunConfig, encode
from accerl_lerobot.console import Console
from accerl_lerobot.engine import Engine, Progress
from accerl_lerobot.envs import make_world
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation.config import evaluation_plans
from accerl_lerobot.evaluation.pictures import before_after, success_curve
from accerl_lerobot.evaluation.summary import summarise
from accerl_lerobot.metrics import MetricsLog, plain
from accerl_lerobot.rollout.runner import EpisodeResult

logger = logging.getLogger(__name__)

FRUITLESS_GROUPS = 50
"""So many groups thrown away in a row are said aloud: no update is made of them."""
DREAMT = 10
"""Updates between two records of the workers' counters when no episode ends."""
RECENT = 100
"""Exploring episodes over which the training success of the curve is averaged."""


class Placed(Protocol):
    """A config that says where its results go."""

    @property
    def output_dir(self) -> str | None:
        """The folder, which must not exist; None: one named after date, time and job."""

    @property
    def job_name(self) -> str:
        """What the folder is called then."""


def make_output_dir(config: Placed) -> Path:
    """Creates the folder of a run.

    Raises:
        InputError: it exists.
    """
    if config.output_dir is None:
        now = datetime.datetime.now()
        path = Path("outputs") / f"{now:%Y-%m-%d}" / f"{now:%H-%M-%S}_{config.job_name}"
    else:
        path = Path(config.output_dir).expanduser()
    if path.exists():
        raise InputError("output_dir", str(path), "the folder exists; choose another or remove it")
    path.mkdir(parents=True)
    return path


def make_engine(config: RunConfig, tasks: tuple[str, ...], history: int) -> Engine:
    """The engine that ``launch.engine`` names, for a policy that sees `history` env steps at a time."""
    if config.launch.engine == "local":
        from accerl_lerobot.local import LocalEngine

        return LocalEngine(config, tasks, history)
    ray_environment.prepare()
    from accerl_lerobot.launch import RayEngine

    return RayEngine(config, tasks, history)


def warm_start(config: RunConfig, directory: Path, console: Console) -> RunConfig:
    """Records demonstrations and runs SFT where the config asks for it; sets ``policy.path``."""
    from accerl_lerobot.demos.record import record_demos
    from accerl_lerobot.demos.sft import run_sft
    from accerl_lerobot.demos.windows import check_dataset, task_texts
    from accerl_lerobot.policies.loading import resolve_device

    if config.policy.path is not None:
        return config
    if not config.sft.steps:
        remedy = "give a LeRobot checkpoint, or sft.steps > 0 to make one from demonstrations"
        raise InputError("policy.path", None, remedy)
    dataset = config.dataset
    if dataset.repo_id is None:
        root = directory / "demos"
        with console.stage("demonstrations"):
            record_demos(config.env, replace(config.demos, root=str(root), seed=config.seed))
        dataset = replace(dataset, repo_id=config.demos.repo_id, root=str(root))
    meta = check_dataset(dataset, config.env, config.policy.rename_map)
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
    # From here on the run is one that improves a checkpoint.
    return replace(config, policy=replace(config.policy, path=str(path)), sft=replace(config.sft, steps=0))


def train(config: RunConfig, directory: Path, console: Console) -> dict[str, Any]:
    """Runs everything and returns the summary, which is also in ``summary.json``.

    Args:
        config: the run.
        directory: its folder, empty.
        console: progress for people.
    """
    started = time.monotonic()
    (directory / "config.yaml").write_text(yaml.safe_dump(encode(config), sort_keys=False))
    tasks = check_world(config)
    if config.imagination.share:
        from accerl_lerobot.world_model.dreaming import check_imagination

        check_imagination(config)
    config = warm_start(config, directory, console)
    warm_s = time.monotonic() - started
    history = check_policy(config)
    with contextlib.ExitStack() as stack:  # ends the workers and flushes the log, whatever fails
        log = stack.enter_context(contextlib.closing(MetricsLog(directory, config.wandb, encode(config))))
        with console.stage("starting workers"):
            engine = stack.enter_context(contextlib.closing(make_engine(config, tasks, history)))
        return _Loop(config, directory, console, engine, log, tasks).run(started, warm_s)


def check_policy(config: RunConfig) -> int:
    """Refuses a policy that does not fit the world, before workers are started; gives its ``n_obs_steps``."""
    from accerl_lerobot.policies.base import check_fit
    from accerl_lerobot.policies.loading import load_lerobot_config

    world = make_world(config.env)
    try:
        policy = load_lerobot_config(config.policy)
        check_fit(policy, world.spec, config.policy.rename_map)
    finally:
        world.close()
    return int(policy.n_obs_steps)


def run_plans(
    engine: Engine,
    count: int,
    group: str,
    console: Console,
    on_progress: Callable[[Progress], None] = lambda progress: None,
) -> list[EpisodeResult]:
    """Waits for `count` planned episodes of `group`; `on_progress` sees what else happens meanwhile."""
    results: list[EpisodeResult] = []
    with console.stage(f"evaluation ({group})", total=count) as stage:
        while len(results) < count:
            progress = engine.poll()
            results += [e for e in progress.episodes if e.plan.group == group]
            on_progress(progress)
            stage.update(len(results), f"{np.mean([r.success for r in results]):.0%}" if results else "")
    return sorted(results, key=lambda r: r.plan.index)


class _Loop:
    """The run once its engine stands: evaluates, trains, and writes what came of it."""

    def __init__(
        self,
        config: RunConfig,
        directory: Path,
        console: Console,
        engine: Engine,
        log: MetricsLog,
        tasks: tuple[str, ...],
    ) -> None:
        self.config, self.directory, self.console = config, directory, console
        self.engine, self.log, self.tasks = engine, log, tasks
        self.evaluations: list[dict[str, Any]] = []
        self.curve: list[tuple[float, float]] = []
        self.recent: list[bool] = []
        self.explored = 0
        """Exploring episodes that have ended."""
        self.lags: list[float] = []
        self.lag_max = 0.0
        self.mismatch_max = 0.0
        self.during: dict[str, list[EpisodeResult]] = {}
        self.base: dict[str, float] = {}
        self.groups = (0.0, 0.0)
        """Kept so far, and thrown away when that was last said or one was kept."""
        self.steps = math.inf
        """Env steps of the training, once it has ended."""

    def run(self, started: float, warm_s: float) -> dict[str, Any]:
        evaluation = self.config.evaluation
        before = self._evaluate("before", evaluation.episodes, 0.0) if evaluation.before else None
        self.base = self.engine.poll().rollout
        rl_started = time.monotonic()
        last = self._train()
        rl_s = time.monotonic() - rl_started
        self.steps = self._steps(last)
        self._save(last.version)
        after = self._evaluate("after", evaluation.episodes, self.steps)
        if before is not None:
            before_after(self.directory / "before_after.mp4", before[1], after[1], fps=20)
        success_curve(self.directory / "success_curve.png", self.evaluations, self.curve)
        times = (time.monotonic() - started, warm_s, rl_s)
        summary = self._summary(None if before is None else before[0], after[0], last, times)
        (self.directory / "summary.json").write_text(json.dumps(plain(summary), indent=2) + "\n")
        return summary

    def _summary(
        self,
        before: dict[str, Any] | None,
        after: dict[str, Any],
        last: Progress,
        times: tuple[float, float, float],
    ) -> dict[str, Any]:
        before = before or {}
        summary = {
            "success_before": before.get("success"),
            "success_after": after["success"],
            "n": after["n"],
            "ci95": {"before": before.get("ci95"), "after": after["ci95"]},
            "n_before": before.get("n"),
            "n_after": after["n"],
            "ci95_before": before.get("ci95"),
            "ci95_after": after["ci95"],
            "tasks_before": before.get("tasks"),
            "tasks_after": after["tasks"],
            "env_steps": int(self.steps),
            "decisions": int(self._since(last, "decisions")),
            "episodes": int(self._since(last, "episodes")),
            "updates": last.version,
            "trained_decisions": int(last.replay.get("trained_decisions", 0)),
            "unique_decisions": int(last.replay.get("unique_decisions", 0)),
            "dropped_nonfinite": int(self._since(last, "dropped_nonfinite")),
            "restarts": int(last.rollout.get("restarts", 0)),
            "lag_mean": float(np.mean(self.lags)) if self.lags else 0.0,
            "lag_max": self.lag_max,
            "ratio_max_dev": self.mismatch_max,
            "wall_s": times[0],
            "warm_start_s": times[1],
            "rl_s": times[2],
            "episodes_explored": self.explored,
            "imagination": last.imagination,
            "algorithm": self.config.algorithm.type,
            "tasks": list(self.tasks),
            "seed": self.config.seed,
        }
        return summary

    def _train(self) -> Progress:
        config = self.config
        self.engine.train()
        evaluated = saved = 0
        with self.console.stage(f"RL ({config.algorithm.type})", total=config.trainer.updates) as stage:
            while True:
                progress = self.engine.poll()
                self._record(progress)
                stage.update(progress.version, self._status(progress))
                if progress.done:
                    return progress
                self._heed_groups(progress.rollout)
                every = config.evaluation.every_updates
                if every and progress.version // every > evaluated:
                    evaluated = progress.version // every
                    self._plan_during(evaluated)
                if config.save_every_updates and progress.version // config.save_every_updates > saved:
                    saved = progress.version // config.save_every_updates
                    self._save(progress.version)

    def _record(self, progress: Progress) -> None:
        for metrics in progress.updates:
            self.lags.append(metrics["lag_mean"])
            self.lag_max = max(self.lag_max, metrics["lag_max"])
            self.mismatch_max = max(self.mismatch_max, metrics["ratio_max_dev"])
            self.log.write("train", int(metrics["update"]), metrics)
        explored = [e for e in progress.episodes if e.plan.explore]
        self.explored += len(explored)
        self.recent = (self.recent + [e.success for e in explored])[-RECENT:]
        share = float(np.mean(self.recent)) if self.recent else math.nan
        # The first episodes to end are the short ones, which are successes.
        if explored and len(self.recent) >= RECENT // 4:
            self.curve.append((self._steps(progress), share))
        # Once all real episodes have been played, dreams and the learning from them go on.
        if explored or any(metrics["update"] % DREAMT == 0 for metrics in progress.updates):
            values = progress.rollout | {"success_exploring": share}
            values |= {f"replay_{k}": v for k, v in progress.replay.items()}
            values |= {f"inference_{k}": v for k, v in progress.inference.items()}
            values |= {f"imagination_{k}": v for k, v in progress.imagination.items()}
            self.log.write("rollout", progress.version, values)
        for episode in progress.episodes:
            results = self.during.get(episode.plan.group)
            if results is not None:
                results.append(episode)
                if len(results) == self.config.evaluation.episodes_during:
                    self._report(episode.plan.group, results, self._steps(progress), progress.version)

    def _heed_groups(self, counters: dict[str, float]) -> None:
        """Says so when groups of equal starts have nothing to compare, or the run would seem to hang."""
        kept, dropped = counters.get("groups_kept", 0.0), counters.get("groups_dropped", 0.0)
        if kept > self.groups[0]:
            self.groups = (kept, dropped)
        elif dropped - self.groups[1] >= FRUITLESS_GROUPS:
            self.groups = (kept, dropped)
            success = f"{np.mean(self.recent):.0%}" if self.recent else "unknown"
            self.console.say(
                f"{FRUITLESS_GROUPS} groups in a row were thrown away, and nothing is learnt from them: they "
                f"had nothing to compare under rollout.group_filter={self.config.rollout.group_filter} "
                f"(success while exploring {success}); stop the run, or choose tasks that succeed sometimes"
            )

    def _plan_during(self, number: int) -> None:
        group = f"during-{number}"
        self.during[group] = []
        self.engine.plan(evaluation_plans(self.tasks, self.config.evaluation.episodes_during, group))

    def _evaluate(
        self, group: str, episodes: int, steps: float
    ) -> tuple[dict[str, Any], list[EpisodeResult]]:
        self.engine.plan(evaluation_plans(self.tasks, episodes, group, self.config.evaluation.videos))
        # An evaluation planned while training may end only now.
        results = run_plans(self.engine, episodes, group, self.console, self._record)
        return self._report(group, results, steps, results[0].versions[1]), results

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

    def _save(self, version: int) -> None:
        path = save_checkpoint(
            self.directory / "checkpoints", self.engine.save, {"algorithm": self.config.algorithm.type}
        )
        self.console.say(f"checkpoint {path / PRETRAINED}")

    def _since(self, progress: Progress, key: str) -> float:
        """A rollout counter since training began, evaluation episodes while training included."""
        return progress.rollout.get(key, 0.0) - self.base.get(key, 0.0)

    def _steps(self, progress: Progress) -> float:
        return min(self.steps, self._since(progress, "env_steps"))

    def _status(self, progress: Progress) -> str:
        success = f"{np.mean(self.recent):.0%}" if self.recent else "…"
        lag = f"{self.lags[-1]:.0f}" if self.lags else "…"
        return f"exploring success {success} · lag {lag} · {self._since(progress, 'decisions'):.0f} decisions"


def check_world(config: RunConfig) -> tuple[str, ...]:
    """Builds the world once, so that a bad environment fails before anything long; returns its tasks."""
    world = make_world(config.env)
    try:
        world.reset(0, world.spec.tasks[0])
        return world.spec.tasks
    finally:
        world.close()
