# SPDX-License-Identifier: Apache-2.0
"""Measurement of a running training engine, one block of time after another."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass
from typing import Any

from accerl_lerobot.bench.host import Processors
from accerl_lerobot.engine.config import RunConfig
from accerl_lerobot.engine.contract import Progress
from accerl_lerobot.policies.config import Load
from accerl_lerobot.replay.pacing import ASYNCHRONOUS, OVERLAP, SYNCHRONOUS, Schedule

SETTLE = 2
"""Updates after a change that are not counted, beside those that need nothing new."""
ARMS: tuple[Schedule, ...] = (ASYNCHRONOUS, OVERLAP, SYNCHRONOUS)
MOST_BUSY = 0.6
"""Share of all cores above which the processors, and not what is slept, may be what is measured."""


@dataclass(frozen=True, kw_only=True)
class Block:
    """Measurements over some seconds."""

    schedule: str
    seconds: float
    updates: int
    decisions_per_s: float
    """Decisions learned from, repetitions included."""
    env_steps_per_s: float
    lag_mean: float
    lag_max: float
    trainer_waits: float
    """Share of its time in which the trainer had no batch."""
    publishing: float
    """Share of its time in which it published weights."""
    batch_size: float
    """Observations of a forward pass."""
    request_wait_ms: float
    """Mean time from the arrival of a request to its forward pass."""
    inference_busy: float
    """Share of its time in which the inference worker decided."""
    processors: float
    """Busy share of all cores, whoever used them."""


class Measured:
    """An engine that has begun to train, as a context manager; for the arguments see `RayEngine`."""

    def __init__(
        self, config: RunConfig, tasks: tuple[str, ...], history: int = 1, load: Load | None = None
    ) -> None:
        from accerl_lerobot.engine import ray_session

        ray_session.prepare()
        from accerl_lerobot.engine.launch import RayEngine

        self.engine = RayEngine(config, tasks, history, load=load)
        # Each decision is learned from so often: a block has whole rounds of updates.
        self._round = math.ceil(config.replay.samples_per_insert)
        self.engine.train()

    def __enter__(self) -> Measured:
        return self

    def __exit__(self, *_: object) -> None:
        self.engine.close()

    def block(self, schedule: Schedule, seconds: float) -> Block:
        """Measures at least so many seconds of a schedule, in whole updates, after a change has settled."""
        self.engine.follow(schedule)
        self._updates(1, 0.0)  # updates made before are reported first
        self._updates(SETTLE + self._round, 0.0)
        processors, first, started = Processors(), self.engine.poll(), time.perf_counter()
        updates, polls = self._updates(1, seconds)
        wall = time.perf_counter() - started
        before, after = first.inference, polls[-1].inference
        steps = polls[-1].rollout["env_steps"] - first.rollout["env_steps"]
        total = sum(_seconds(u) for u in updates)
        batches = after["batches"] - before["batches"]
        requests = _observations(after) - _observations(before)
        return Block(
            schedule=schedule,
            seconds=total,
            updates=len(updates),
            decisions_per_s=sum(u["decisions"] for u in updates) / total,
            env_steps_per_s=steps / wall,
            lag_mean=sum(u["lag_mean"] for u in updates) / len(updates),
            lag_max=max(u["lag_max"] for u in updates),
            trainer_waits=sum(u["wait_s"] for u in updates) / total,
            publishing=sum(u["publish_s"] for u in updates) / total,
            batch_size=requests / batches if batches else 0.0,
            request_wait_ms=1000 * (_waited(after) - _waited(before)) / requests if requests else 0.0,
            inference_busy=sum(p.inference["busy_share"] for p in polls) / len(polls),
            processors=processors.share(),
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


def as_rows(blocks: list[Block]) -> list[dict[str, Any]]:
    """For JSON."""
    return [asdict(block) for block in blocks]


def _seconds(update: dict[str, float]) -> float:
    return update["wait_s"] + update["update_s"] + update["publish_s"]


def _observations(inference: dict[str, float]) -> int:
    """Requests so far; rounded, as a mean times its divisor need not be whole."""
    return round(inference["batches"] * inference["batch_size_mean"])


def _waited(inference: dict[str, float]) -> float:
    return inference["wait_mean_s"] * _observations(inference)
