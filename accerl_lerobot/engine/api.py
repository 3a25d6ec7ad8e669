# SPDX-License-Identifier: Apache-2.0
"""The Python interface: what ``accerl train`` and ``accerl eval`` do, with results as objects.

Everything is imported from `accerl_lerobot` itself. Recording and Ray start processes that import the main
module again, so a script calls `train` under ``if __name__ == "__main__":``. Progress goes to the standard
error. A mistake in the settings raises `InputError` before any work begins: one line with the field, its
value and the remedy.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from accerl_lerobot.checkpoint.layout import CHECKPOINTS, CONFIG, LAST, PRETRAINED
from accerl_lerobot.console import Console
from accerl_lerobot.engine import run
from accerl_lerobot.engine.config import RunConfig, parse
from accerl_lerobot.engine.preflight import check_start
from accerl_lerobot.engine.stopping import locked, resumed_run
from accerl_lerobot.errors import InputError, kept_traceback
from accerl_lerobot.evaluation import Rate
from accerl_lerobot.experience import Observation, Request
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.rollout.runner import EpisodeResult

if TYPE_CHECKING:
    from accerl_lerobot.policies.adapter import LeRobotAdapter


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """Outcome of a run."""

    directory: Path
    """Everything of the run; see `engine.run`."""
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
    """A LeRobot policy with its processors.

    Args:
        adapter: see `load_policy`.
    """

    def __init__(self, adapter: LeRobotAdapter) -> None:
        self.adapter = adapter
        self.history: int = adapter.policy.config.n_obs_steps
        self._decisions = 0

    def act(self, observation: Observation) -> np.ndarray:
        """One decision, with LeRobot's own sampler.

        Args:
            observation: ``observation.images.<camera>`` uint8 (H, W, 3), ``observation.state`` float32 (S,)
                and ``task``, the instruction. For a policy with ``n_obs_steps`` above 1 each array begins
                with that dimension, oldest first, as ``make_world(config, policy.history)`` gives them.

        Returns:
            float32 (K, A): the next K actions, in the environment's units.
        """
        self._decisions += 1
        request = Request(observation=observation, noise_seed=self._decisions, explore=False)
        return self.adapter.decide([request], version=0)[0].chunk


def load_config(recipe: str | Path | None = None, changes: Mapping[str, Any] | None = None) -> RunConfig:
    """Settings of a run, as ``accerl train`` reads them.

    Args:
        recipe: a YAML file; None: the defaults.
        changes: field → value, such as ``{"env.task": "door-open-v3", "trainer.updates": 100}``.

    Raises:
        InputError: a field does not exist, or a value does not fit.
    """
    path = [] if recipe is None else [f"--config_path={recipe}"]
    fields = [f"--{name}={_written(value)}" for name, value in (changes or {}).items()]
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
    check_start(config)  # before there is a folder
    directory = run.make_output_dir(config)
    try:
        return _result(config, directory, None)
    except InputError:
        run.discard_unused(directory)
        raise


def resume(directory: str | Path, changes: Mapping[str, Any] | None = None) -> TrainResult:
    """Goes on with a run that was stopped, from its last whole checkpoint.

    Args:
        directory: of the run.
        changes: see `load_config`; such as more ``trainer.updates``.
    """
    recipe = Path(directory) / CONFIG
    config = load_config(recipe, {**(changes or {}), "resume": True})
    begun = resumed_run(recipe, config)
    return _result(config, begun.directory, begun.checkpoint)


def evaluate(
    config: RunConfig,
    policy: str | Path | None = None,
    episodes: int | None = None,
    revision: str | None = None,
) -> EvaluationResult:
    """Success of a policy with LeRobot's own sampler, on starts that no run of this seed trains on.

    Args:
        config: its environment, seed and workers are used.
        policy: a LeRobot checkpoint, on disk or the Hub; None: ``config.policy.path``.
        episodes: how many; None: ``config.evaluation.episodes``.
        revision: commit of `policy` on the Hub.
    """
    if policy is not None:
        config = run.improving(config, policy)
        config = replace(config, policy=replace(config.policy, revision=revision))
    if episodes is not None:
        config = replace(config, evaluation=replace(config.evaluation, episodes=episodes))
    with redirect_stdout(sys.stderr):
        results = run.evaluate(config, Console())
    tasks = {
        name: [r for r in results if r.plan.task == name] for name in sorted({r.plan.task for r in results})
    }
    return EvaluationResult(
        success=_rate(results), tasks={name: _rate(of) for name, of in tasks.items()}, episodes=results
    )


def load_policy(path: str | Path, revision: str | None = None, device: str = "auto") -> ActingPolicy:
    """A LeRobot checkpoint, on disk or the Hub, ready to act; runs no code from it and unpickles nothing.

    Args:
        path: folder or Hub id.
        revision: commit on the Hub.
        device: cpu, cuda, or auto.
    """
    from accerl_lerobot.policies.loading import load_adapter

    with redirect_stdout(sys.stderr):
        return ActingPolicy(load_adapter(PolicyConfig(path=str(path), revision=revision, device=device)))


def _result(config: RunConfig, directory: Path, checkpoint: str | None) -> TrainResult:
    with (
        redirect_stdout(sys.stderr),
        kept_traceback(directory),
        locked(directory, "config_path", "another process resumes it"),
    ):
        summary = run.train(config, directory, Console(), checkpoint)
    before = None
    if summary["success_before"] is not None:
        before = Rate(successes=round(summary["success_before"] * summary["n_before"]), n=summary["n_before"])
    return TrainResult(
        directory=directory,
        policy=directory / CHECKPOINTS / LAST / PRETRAINED,
        before=before,
        after=Rate(successes=round(summary["success_after"] * summary["n_after"]), n=summary["n_after"]),
        summary=summary,
    )


def _rate(results: list[EpisodeResult]) -> Rate:
    return Rate(successes=sum(r.success for r in results), n=len(results))


def _written(value: Any) -> str:
    """A value as the command line has it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return f"[{','.join(map(_written, value))}]" if isinstance(value, list | tuple) else str(value)
