# SPDX-License-Identifier: Apache-2.0
"""The rollout process: steps its worlds while other observations wait for a decision.

    consumes    decisions from inference
    produces    segments for replay, results of episodes for the driver
    waits for   a decision, only when every world has an observation under way
    pauses      exploring worlds while replay keeps segments at the door; evaluation goes on
    ends        never unasked: a world that raises ends the process's `run`, and `launch` starts another
    outlives    inference: its successor is asked again what has not been answered

Imports neither torch nor LeRobot (unless its world does).
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from accerl_lerobot.envs import EnvConfig, make_world
from accerl_lerobot.experience import Decision, Request, Segment
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.rollout.runner import (
    EpisodePlan,
    EpisodePlans,
    EpisodeResult,
    RolloutConfig,
    RolloutRunner,
)
from accerl_lerobot.timeline import COMPUTE, TRANSPORT, WAIT_IN, WAIT_OUT, open_clock
from accerl_lerobot.transport.endpoint import Endpoint, ReconnectingClient

PARTS = 2
"""A worker's worlds are asked for in so many parts: one is stepped while the other's decisions are made."""
AT_THE_DOOR = 2
"""Messages to replay that may be waiting before exploring worlds pause."""
PAUSE_S = 0.005
"""Between two looks at whether there is something to do."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """A rollout worker's answer when it is asked how it is."""

    episodes: list[EpisodeResult]
    """Finished since the last report."""
    counters: dict[str, float]
    """Since this process began."""
    in_world_s: float
    """Seconds for which the world has been at what it does now; 0 while none is stepped."""
    stuck_s: float = 0.0
    """Seconds since the thread that steps worlds last did anything; 0 while one is stepped."""
    spent: bool = False
    """Every exploring episode that was paid for has been played, and replay has it."""
    starts: int = 0
    """See `EpisodePlans.starts`."""
    away_s: float = 0.0
    """Seconds for which inference has not been where it was last said to be."""
    away_why: str = ""


class RolloutWorker:
    """Becomes a threaded Ray actor in `launch`: `run` on one thread, `report` on another.

    `incarnation` is how often it has been restarted, part of the segments' keys and of the seeds; `budget`
    limits the exploring episodes.
    """

    def __init__(
        self,
        env: EnvConfig,
        config: RolloutConfig,
        tasks: tuple[str, ...],
        seed: int,
        index: int = 0,
        incarnation: int = 0,
        budget: int | None = None,
        history: int = 1,
        timeline: Path | None = None,
    ) -> None:
        self._clock = open_clock(timeline, f"rollout {index}")
        self._plans = EpisodePlans(tasks, seed, budget, index, incarnation)
        self._spent = False
        self._at_the_door = AT_THE_DOOR
        # Shared by the two threads: appending to and popping from a deque is atomic.
        self._results: deque[EpisodeResult] = deque()
        self._training = threading.Event()
        self._entered: float | None = None
        self._moved: float | None = None
        self._outbox: list[Segment] = []
        self._deciding = ReconnectingClient("inference")
        worlds = [make_world(env, history, config.reward_model) for _ in range(config.worlds)]
        callbacks = self._outbox.append, self._results.append
        self._runner = RolloutRunner(worlds, self._next, config, f"rollout{index}.{incarnation}", *callbacks)
        self._clock.enter(WAIT_IN)

    def ready(self) -> int:
        return os.getpid()

    def report(
        self,
        training: bool,
        plans: list[EpisodePlan],
        in_turn: bool = False,
        inference: Endpoint | None = None,
    ) -> Report:
        """Takes orders and reports. One call at a time, so that orders cannot overtake each other.

        Args:
            training: training episodes are run between planned ones, from now on.
            plans: evaluation episodes to queue; they are taken before any training episode.
            in_turn: exploring worlds pause until replay lets them go on after each segment, from now on.
            inference: its endpoint from now on; None: unchanged.
        """
        self._clock.beat()
        if inference is not None:
            self._deciding.move(inference)
        self._plans.queue(plans)
        self._at_the_door = 1 if in_turn else AT_THE_DOOR
        (self._training.set if training else self._training.clear)()
        episodes = [self._results.popleft() for _ in range(len(self._results))]
        entered, moved, now = self._entered, self._moved, time.monotonic()
        return Report(
            episodes=episodes,
            counters={k: float(v) for k, v in vars(self._runner.counters).items()},
            in_world_s=0.0 if entered is None else now - entered,
            stuck_s=0.0 if moved is None or entered is not None else now - moved,
            spent=self._spent,
            starts=self._plans.starts,
            away_s=self._deciding.away_s,
            away_why=self._deciding.why,
        )

    def run(self, inference: Endpoint, replay: Endpoint) -> None:
        """Steps worlds until the process ends."""
        deciding, door = self._deciding, replay.connect()
        deciding.move(inference)
        idle = list(range(len(self._runner)))
        due: dict[int, Request] = {}
        under_way: dict[int, list[int]] = {}
        at_the_door: set[int] = set()
        size = max(1, len(self._runner) // PARTS)
        patience = 0.0
        while True:
            self._moved = time.monotonic()
            at_the_door -= {ticket for ticket, _ in door.done(patience)}
            while self._outbox:
                self._clock.enter(TRANSPORT)
                if fault_point("rollout.send"):
                    self._outbox[0].reward = self._outbox[0].reward * np.float32(np.nan)
                at_the_door.add(door.send(self._outbox[:size]))
                del self._outbox[:size]
            self._spent = self._plans.spent and not self._runner.exploring and not at_the_door
            if not self._training.is_set():  # so that planned episodes need not wait for exploring ones
                idle += [slot for slot, request in due.items() if request.explore]
                due = {slot: request for slot, request in due.items() if not request.explore}
            idle = [slot for slot in idle if not self._begin(slot, due)]
            sendable = [slot for slot in due if len(at_the_door) < self._at_the_door or not due[slot].explore]
            for start in range(0, len(sendable), size):
                self._clock.enter(TRANSPORT)
                slots = sendable[start : start + size]
                under_way[deciding.send([due.pop(slot) for slot in slots])] = slots
            # Where no decision is awaited, there is nothing to wait for but the door, and orders.
            patience = 0.0 if under_way else PAUSE_S
            self._clock.enter(WAIT_IN if under_way or not due else WAIT_OUT)
            for ticket, decisions in deciding.done(0.5) if under_way else ():
                for slot, decision in zip(under_way.pop(ticket), decisions, strict=True):
                    self._advance(slot, decision, due, idle)

    def _next(self) -> EpisodePlan | None:
        plan = self._plans.next(exploring=self._training.is_set())
        if plan is not None:
            self._clock.enter(COMPUTE)
        return plan

    def _begin(self, slot: int, due: dict[int, Request]) -> bool:
        with self._in_world():
            request = self._runner.start(slot)
        if request is not None:
            due[slot] = request
        return request is not None

    def _advance(self, slot: int, decision: Decision, due: dict[int, Request], idle: list[int]) -> None:
        self._clock.enter(COMPUTE)
        fault_point("rollout.decided")
        with self._in_world():
            fault_point("rollout.step")
            request = self._runner.advance(slot, decision)
        if request is None:
            idle.append(slot)
        else:
            due[slot] = request

    @contextmanager
    def _in_world(self) -> Iterator[None]:
        """Lets `report` tell a world that hangs from a worker that waits."""
        self._entered = time.monotonic()
        yield
        self._moved, self._entered = time.monotonic(), None
