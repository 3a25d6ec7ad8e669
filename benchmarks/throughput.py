# SPDX-License-Identifier: Apache-2.0
"""Speed of a recipe on this machine, collecting and learning, under each schedule.

Environments, policy and engine are those of the run.
"""

from __future__ import annotations

import math
import statistics
import time
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from typing import Any

import psutil
from rich.table import Table

from accerl_lerobot.config.ranges import Positive, Repeats, Section
from accerl_lerobot.console import Console
from accerl_lerobot.engines import Progress
from accerl_lerobot.engines.config import RunConfig, parse
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import Load
from accerl_lerobot.replay.buffer import ASYNCHRONOUS, OVERLAP, SYNCHRONOUS, Schedule
from benchmarks.tables import as_table, host, ranged, spread

SETTLE = 2  # updates after a change that are not counted, beside those that need nothing new
ARMS: tuple[Schedule, ...] = (ASYNCHRONOUS, OVERLAP, SYNCHRONOUS)


@dataclass(frozen=True, kw_only=True)
class Block:
    """Measurements over some seconds."""

    schedule: str
    seconds: float
    updates: int
    decisions_per_s: float  # decisions learned from, repetitions included
    env_steps_per_s: float
    lag_mean: float
    trainer_waits: float  # share of its time in which the trainer had no batch
    batch_size: float  # observations of a forward pass
    inference_busy: float
    processors: float  # busy share of all cores, whoever uses them


class Measured(AbstractContextManager["Measured"]):
    """An engine that has begun to train, as a context manager; for the arguments see `RayEngine`."""

    def __init__(
        self, config: RunConfig, tasks: tuple[str, ...], history: int = 1, load: Load | None = None
    ) -> None:
        from accerl_lerobot.engines import ray_session

        ray_session.prepare()
        from accerl_lerobot.engines.ray_engine import RayEngine

        self.engine = RayEngine(config, tasks, history, load=load)
        # Each decision is learned from so often: a block has whole rounds of updates.
        self._round = math.ceil(config.replay.samples_per_insert)
        self.engine.train()

    def __exit__(self, *_: object) -> None:
        self.engine.close()

    def block(self, schedule: Schedule, seconds: float) -> Block:
        """Measures at least so many seconds of a schedule, in whole updates, after a change has settled."""
        self.engine.set_schedule(schedule)
        self._updates(1, 0.0)  # updates made before are reported first
        self._updates(SETTLE + self._round, 0.0)
        psutil.cpu_percent()  # begins to count
        first, started = self.engine.poll(), time.perf_counter()
        updates, polls = self._updates(1, seconds)
        wall = time.perf_counter() - started
        before, after = first.inference, polls[-1].inference
        steps = polls[-1].rollout["env_steps"] - first.rollout["env_steps"]
        total = sum(_seconds(u) for u in updates)
        batches = after["batches"] - before["batches"]
        # Rounded, as a mean times its divisor need not be whole.
        then, now = (round(each["batches"] * each["batch_size_mean"]) for each in (before, after))
        return Block(
            schedule=schedule,
            seconds=total,
            updates=len(updates),
            decisions_per_s=sum(u["decisions"] for u in updates) / total,
            env_steps_per_s=steps / wall,
            lag_mean=sum(u["lag_mean"] for u in updates) / len(updates),
            trainer_waits=sum(u["wait_s"] for u in updates) / total,
            batch_size=(now - then) / max(batches, 1.0),
            inference_busy=sum(p.inference["busy_share"] for p in polls) / len(polls),
            processors=psutil.cpu_percent() / 100,
        )

    def _updates(self, count: int, seconds: float) -> tuple[list[dict[str, float]], list[Progress]]:
        """Polls until there are so many updates, in whole rounds, which took so long."""
        updates: list[dict[str, float]] = []
        polls: list[Progress] = []
        while True:
            progress = self.engine.poll()
            updates += progress.updates
            polls.append(progress)
            whole = updates[: len(updates) // self._round * self._round]
            if len(whole) >= count and sum(_seconds(u) for u in whole) >= seconds:
                return whole, polls
            if progress.done:
                raise RuntimeError("the measured run has ended: its number of episodes is limited")


def _seconds(update: dict[str, float]) -> float:
    return update["wait_s"] + update["update_s"] + update["publish_s"]


@dataclass(frozen=True, kw_only=True)
class BenchThroughputConfig(Section):
    """Speed of a recipe on this machine under each schedule."""

    recipe: str = "recipes/gipo.yaml"
    """The run."""
    policy_path: str | None = None
    """The LeRobot checkpoint that acts and learns."""
    schedules: tuple[Schedule, ...] = ARMS
    """Which ones, by turns in one run."""
    seconds: Positive = 20.0
    """Shortest duration of a block."""
    rounds: Repeats = 3
    """Times each schedule is measured twice, forth and back."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.policy_path is None:
            hint = "name a LeRobot checkpoint, such as RUN/checkpoints/last/pretrained_model"
            raise InputError("policy_path", None, hint)
        if not self.schedules:
            raise InputError("schedules", self.schedules, f"name some of {', '.join(ARMS)}")


def bench_throughput(config: BenchThroughputConfig) -> dict[str, Any]:
    """Measures all schedules: env steps, decisions and updates per second, and the rest of `Block`."""
    from accerl_lerobot.run.preflight import check_environment, check_policy

    console = Console()
    fixed = ["--sft.steps=0", "--trainer.updates=1000000", "--trainer.final_lr_share=1"]
    named = [f"--config_path={config.recipe}", f"--policy.path={config.policy_path}"]
    run: RunConfig = parse(RunConfig, named + fixed)
    for schedule in config.schedules:  # a recipe that one of them does not allow is refused
        replace(run, launch=replace(run.launch, schedule=schedule))
    spec = check_environment(run.env)
    tasks, history = spec.tasks, check_policy(run, spec)
    result: dict[str, Any] = {"config": asdict(config), "host": host()}
    order = config.rounds * (*config.schedules, *reversed(config.schedules))
    blocks: list[Block] = []
    with Measured(run, tasks, history) as engine, console.stage("blocks", total=len(order)) as stage:
        for schedule in order:
            blocks.append(engine.block(schedule, config.seconds))
            stage.update(len(blocks), f"{schedule}: {blocks[-1].env_steps_per_s:.0f} env steps/s")
    schedules = {name: [b for b in blocks if b.schedule == name] for name in config.schedules}
    result["schedules"] = {name: _summarised(own) for name, own in schedules.items()}
    result["host_after"] = host()
    return result


def table(result: dict[str, Any]) -> Table:
    columns = ("schedule", "env steps/s", "decisions/s learned from", "updates/s", "lag", "trainer waits")
    rows = []
    for name, one in result["schedules"].items():
        counts = (ranged(one[key], ".0f") for key in ("env_steps_per_s", "decisions_per_s"))
        shares = (f"{one[key]:.0%}" for key in ("trainer_waits", "inference_busy", "processors"))
        rows.append([name, *counts, f"{one['updates_per_s']:.2f}", f"{one['lag_mean']:.1f}", *shares])
    return as_table(result["config"]["recipe"], (*columns, "inference busy", "processors"), rows)


def _summarised(blocks: list[Block]) -> dict[str, Any]:
    median = {
        key: statistics.median(getattr(b, key) for b in blocks)
        for key in ("lag_mean", "trainer_waits", "inference_busy", "processors", "batch_size")
    }
    return median | {
        "env_steps_per_s": spread([b.env_steps_per_s for b in blocks]),
        "decisions_per_s": spread([b.decisions_per_s for b in blocks]),
        "updates_per_s": statistics.median(b.updates / b.seconds for b in blocks),
        "blocks": [asdict(block) for block in blocks],
    }
