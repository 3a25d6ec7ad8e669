# SPDX-License-Identifier: Apache-2.0
"""Runs small enough for tests."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from accerl_lerobot.algorithms import ChunkCriticConfig
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.engines import Engine, Progress
from accerl_lerobot.engines.config import LaunchConfig, RunConfig
from accerl_lerobot.envs import SimulatedConfig, make_environment
from accerl_lerobot.evaluation import EvaluationConfig
from accerl_lerobot.metrics import METRICS
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.replay.buffer import ReplayConfig
from accerl_lerobot.rollout.runner import EpisodeResult, RolloutConfig
from accerl_lerobot.run.train import make_engine

if TYPE_CHECKING:
    from accerl_lerobot.engines.local import LocalEngine

HANGS_S = 240.0


def pip_installed(site: Path, *sources: Path) -> dict[str, str]:
    """Installs packages' source folders into `site`; the environment of processes that find them there."""
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, f"--target={site}", *map(str, sources)], check=True)
    path = os.pathsep.join([str(site), *filter(None, [os.environ.get("PYTHONPATH")])])
    return os.environ | {"PYTHONPATH": path}


def replacing(arguments: list[str], *more: str) -> list[str]:
    """A command line in which `more` replaces flags of the same names."""
    names = {argument.partition("=")[0] for argument in more}
    return [a for a in arguments if a.partition("=")[0] not in names] + list(more)


def changed(config: RunConfig, **sections: Any) -> RunConfig:
    """The config with other sections, or with other fields of a section where a dict is given."""
    given = {k: replace(getattr(config, k), **v) if isinstance(v, dict) else v for k, v in sections.items()}
    return replace(config, **given)


def tiny_run(checkpoint: Path, **sections: Any) -> RunConfig:
    """A run on the simulated environment from `checkpoint`, `changed` by `sections`."""
    config = RunConfig(
        env=SimulatedConfig(max_steps=16),
        policy=PolicyConfig(path=str(checkpoint), device="cpu"),
        rollout=RolloutConfig(environments=4, segment_length=3),
        replay=ReplayConfig(
            capacity=64, min_decisions=16, max_unlearned_decisions=32, samples_per_insert=2.0
        ),
        trainer=TrainerConfig(updates=12, batch_decisions=16, warmup_updates=2, value_warmup_updates=2),
        evaluation=EvaluationConfig(episodes=6, videos=1),
        launch=LaunchConfig(stall_s=120),
    )
    return changed(config, **sections)


def off_policy_run(checkpoint: Path, **sections: Any) -> RunConfig:
    """The same for an algorithm that keeps whole episodes in its own memory: by default the chunk critic."""
    in_memory = {"rollout": {"segment_length": 4}, "replay": {"samples_per_insert": 1.0}}
    return changed(tiny_run(checkpoint, algorithm=ChunkCriticConfig(), **in_memory), **sections)


def polls(engine: Engine) -> Iterator[Progress]:
    """Polls again and again; a test that waits for minutes hangs."""
    deadline = time.monotonic() + HANGS_S
    while time.monotonic() < deadline:
        yield engine.poll()
    raise AssertionError(f"what was waited for did not happen within {HANGS_S:.0f} s")


def collect(engine: Engine, group: str, count: int) -> list[EpisodeResult]:
    results: list[EpisodeResult] = []
    for progress in polls(engine):
        results += [e for e in progress.episodes if e.plan.group == group]
        if len(results) >= count:
            break
    return results


def drive(engine: Engine) -> list[Progress]:
    """Polls until the training is done; everything that was reported."""
    return until(engine, None)


def until(engine: Engine, version: int | None) -> list[Progress]:
    """Polls until so many updates have been made, or all; everything that was reported."""
    history: list[Progress] = []
    for progress in polls(engine):
        history.append(progress)
        if progress.done if version is None else progress.version >= version:
            break
    return history


def local_engine(config: RunConfig, tasks: tuple[str, ...] = ("match",), state: Any = None) -> LocalEngine:
    """The engine in one process, as a run makes it."""
    local = replace(config, launch=replace(config.launch, engine="local"))
    spec = replace(make_environment(config.env).spec, tasks=tasks)
    return make_engine(local, spec, history=1, state=state)


def trained(config: RunConfig) -> tuple[list[Progress], LocalEngine]:
    """A run in one process from beginning to end: everything that was reported, and its engine."""
    with closing(local_engine(config)) as engine:
        engine.train()
        return drive(engine), engine


def updates(history: Sequence[Progress]) -> list[dict[str, float]]:
    return [update for progress in history for update in progress.updates]


def records(run: Path, kind: str = "") -> list[dict[str, Any]]:
    """The lines of a run's ``metrics.jsonl``, or those of a kind; all that JSON does not know is an error."""
    lines = (run / METRICS).read_text().splitlines()
    found = [json.loads(line, parse_constant=pytest.fail) for line in lines]
    return [record for record in found if not kind or record["kind"] == kind]


def eventually(happened: Callable[[], Any], seconds: float = 120.0) -> bool:
    """True once something comes about, on a machine that may be busy."""
    deadline = time.monotonic() + seconds
    while not (done := happened()) and time.monotonic() < deadline:
        time.sleep(0.05)
    return bool(done)
