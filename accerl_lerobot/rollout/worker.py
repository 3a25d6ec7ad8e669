# SPDX-License-Identifier: Apache-2.0
"""The rollout process: steps its environments while other observations wait for a decision.

consumes    decisions, and orders: planned episodes, and whether to explore; versions of the world model that
            its imagined environments predict by, where there are any
produces    segments of exploring episodes for replay, and results of episodes
waits for   decisions, if every environment has an observation under way; pauses exploring while replay does
            not take segments
ends        with the run; an environment that raises ends `run`; the driver then kills
            the process, and Ray starts another

It outlives inference, whose successor is asked again what has not been answered. Imports neither torch nor
LeRobot, unless its environment does.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from accerl_lerobot import errors
from accerl_lerobot.envs import EnvConfig, make_environment
from accerl_lerobot.experience import REAL, Decision, Request
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.rollout.runner import (
    MOST_STARTS,
    EpisodePlan,
    EpisodePlans,
    EpisodeResult,
    FirstObservations,
    RolloutConfig,
    RolloutRunner,
)
from accerl_lerobot.timeline import COMPUTE, TRANSPORT, WAIT_IN, WAIT_OUT, WEIGHT_SYNC, open_clock
from accerl_lerobot.transport import Client, Endpoint, ReconnectingClient

if TYPE_CHECKING:
    from accerl_lerobot.world_model.config import ImaginationConfig

PARTS = 2
"""A worker's environments are asked for in so many parts: one is stepped while the other's decisions are
made."""
MAX_PENDING = 2  # messages to replay that may be pending before exploring environments pause
PAUSE_S = 0.005  # between two looks at whether there is something to do
DECISION_S = 0.5  # longest wait for a decision before orders and replay are looked at


@dataclass(frozen=True, kw_only=True)
class Report:
    """A rollout worker's answer when it is asked how it is."""

    episodes: list[EpisodeResult]  # finished since the last report
    counters: dict[str, float]  # since this process began
    busy_s: float = 0.0
    """Seconds for which its thread has been at what it does now; 0 before `RolloutWorker.run`."""
    in_environment: bool = False  # True if that is to step or reset an environment
    moves: int = 0  # resets and executed chunks of its environments
    spent: bool = False  # every exploring episode of ``rollout.episodes`` has been played, and replay has it
    seeds_used: int = 0  # see `EpisodePlans`


class RolloutWorker:
    """Becomes a threaded Ray actor in `engines.ray_engine`: `run` on one thread, `report` on another."""

    def __init__(
        self,
        env: EnvConfig,
        config: RolloutConfig,
        name: str = "rollout 0",
        history: int = 1,
        timeline: Path | None = None,
        imagination: ImaginationConfig | None = None,
    ) -> None:
        errors.collect_warnings()
        # A node that does not see the run's folder would write a timeline where it is not looked for.
        seen = timeline is not None and timeline.parent.is_dir()
        self._clock = open_clock(timeline if seen else None, name)
        self._config = config
        self._spent = False
        self._max_pending = MAX_PENDING
        self._active: tuple[float, bool] | None = None  # since when the thread does what, see `Report`
        self._moves = 0
        self._idle: list[int] = []  # slots without an episode
        self._due: dict[int, Request] = {}  # slot → request to be sent
        self._asked: dict[int, list[int]] = {}  # ticket of a message to inference → its slots
        self._pending: dict[int, bool] = {}  # ticket of a message to replay → it has real segments
        self._environments = [
            make_environment(env, history, config.reward_model) for _ in range(config.environments)
        ]
        self._first: FirstObservations = deque(maxlen=MOST_STARTS)
        self._world: Any = None  # an `imagined.World`
        self._new_world: deque[tuple[int, Any]] = deque(maxlen=1)
        if imagination is not None and imagination.environments:
            self._imagine(imagination)
        self._together = max(1, len(self._environments) // PARTS)  # requests in a message
        self._clock.enter(WAIT_IN)

    def ready(self, plans: EpisodePlans | None = None, begun: Sequence[tuple[str, int]] = ()) -> int:
        """Take the episodes of this process, before `report` and `run` are called; its id.

        `begun` are tasks and seeds of real episodes of the process before, where imagined ones may begin.
        """
        if plans is not None:
            self._plans = plans
            self._first.clear()
            if self._world is not None:
                for task, seed in begun:
                    observation = self._environments[0].reset(seed, task)
                    self._first.append((task, observation))
            self._runner = RolloutRunner(self._environments, plans, self._config, self._first, self._clock)
        return os.getpid()

    def imagine_with(self, newest: tuple[int, Any]) -> None:
        """Use this version of the world model, and its weights, from the next chunk on."""
        self._new_world.append(newest)

    def report(self, training: bool, plans: list[EpisodePlan], in_turn: bool = False) -> Report:
        """Takes orders and reports. One call at a time, so that orders cannot overtake each other.

        From now on it explores if `training`, once the `plans` have been played, and waits for replay after
        each segment if `in_turn`.
        """
        self._clock.beat()
        self._plans.queue(plans)
        self._max_pending = 1 if in_turn else MAX_PENDING
        self._plans.exploring = training
        now = time.monotonic()
        since, in_environment = self._active or (now, False)
        ended = self._runner.results
        return Report(
            episodes=[ended.popleft() for _ in range(len(ended))],
            counters=asdict(self._runner.counters),
            busy_s=now - since,
            in_environment=in_environment,
            moves=self._moves,
            spent=self._spent,
            seeds_used=max(self._plans.seeds_used, self._plans.imagined_seeds_used),
        )

    def run(self, inference: Endpoint, replay: Endpoint) -> None:
        """Steps environments until the process ends."""
        deciding = ReconnectingClient(inference)
        storing = replay.connect()
        self._idle = list(range(len(self._runner)))
        pause = 0.0
        while True:
            self._active = time.monotonic(), False
            for ticket, _ in storing.done(pause):
                del self._pending[ticket]
            self._send_segments(storing)
            if self._new_world:
                self._clock.enter(WEIGHT_SYNC)
                self._world.load(*self._new_world.popleft())
            self._begin_episodes()
            self._send_requests(deciding)
            # Where no decision is awaited, there is nothing to wait for but replay, and orders.
            pause = 0.0 if self._asked else PAUSE_S
            self._execute_decisions(deciding)

    def _send_segments(self, storing: Client) -> None:
        outbox = self._runner.segments
        while outbox:
            self._clock.enter(TRANSPORT)
            segments = [outbox.popleft() for _ in range(min(len(outbox), self._together))]
            if fault_point("rollout.send"):
                segments[0].reward = segments[0].reward * np.float32(np.nan)
            ticket = storing.send(segments)
            self._pending[ticket] = any(segment.source == REAL for segment in segments)
        unstored = any(self._pending.values())
        self._spent = self._plans.spent and not self._runner.exploring and not unstored

    def _begin_episodes(self) -> None:
        """In every idle slot; once training has ended, also where an exploring episode is under way."""
        if not self._plans.exploring:
            for slot, request in list(self._due.items()):
                if request.explore:
                    del self._due[slot]
                    self._idle.append(slot)
        self._idle = [slot for slot in self._idle if not self._step(slot, None)]

    def _send_requests(self, deciding: ReconnectingClient) -> None:
        """Ask for decisions; not for exploring ones while replay does not take segments."""
        paused = len(self._pending) >= self._max_pending
        slots = [slot for slot, request in self._due.items() if not (paused and request.explore)]
        for start in range(0, len(slots), self._together):
            self._clock.enter(TRANSPORT)
            part = slots[start : start + self._together]
            requests = [self._due.pop(slot) for slot in part]
            ticket = deciding.send(requests)
            self._asked[ticket] = part

    def _execute_decisions(self, deciding: ReconnectingClient) -> None:
        """Wait for decisions, if any is under way, and execute them."""
        if not self._asked:
            self._clock.enter(WAIT_OUT if self._due else WAIT_IN)
            return
        self._clock.enter(WAIT_IN)
        for ticket, decisions in deciding.done(DECISION_S):
            for slot, decision in zip(self._asked.pop(ticket), decisions, strict=True):
                self._clock.enter(COMPUTE)
                fault_point("rollout.decided")
                if not self._step(slot, decision):
                    self._idle.append(slot)

    def _imagine(self, config: ImaginationConfig) -> None:
        """Add the imagined environments."""
        import torch

        from accerl_lerobot.world_model.imagined import imagined_environments

        torch.set_num_threads(1)
        spec = self._environments[0].spec
        self._world, imagined = imagined_environments(config, config.environments, spec, self._first)
        self._environments += imagined

    def _step(self, slot: int, decision: Decision | None) -> bool:
        """Begin an episode, or execute a decision; False if nothing is due in this slot then."""
        self._active = time.monotonic(), True
        if decision is None:
            request = self._runner.begin_episode(slot)
        else:
            fault_point("rollout.step")
            request = self._runner.advance(slot, decision)
        self._active = time.monotonic(), False
        self._moves += decision is not None or request is not None
        if request is not None:
            self._due[slot] = request
        return request is not None
