# SPDX-License-Identifier: Apache-2.0
"""The rollout workers of an asynchronous run: seats that outlive the processes that take them in turn.

A worker that died or hangs is started again, with a new incarnation number in its seeds and in the keys of
its segments. With it go its unfinished segments and groups, nothing else: planned episodes without a result
are run by whoever sits there next. So it is when a run is gone on with.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import ray
from ray.exceptions import ActorUnavailableError, RayActorError, RayError

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.engine.cluster import alive, on
from accerl_lerobot.engine.config import RunConfig, timeline_folder
from accerl_lerobot.engine.contract import WorkerError, check_new, episode_key
from accerl_lerobot.engine.placement import Plan
from accerl_lerobot.engine.ray_environment import TOKENLESS
from accerl_lerobot.engine.watched import Watched
from accerl_lerobot.errors import InputError
from accerl_lerobot.rollout.plans import budgets, incarnation_after, whole_groups
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodeResult
from accerl_lerobot.transport.endpoint import Endpoint

logger = logging.getLogger(__name__)

START_S = 600.0
"""How long a worker may take to start; `LaunchConfig.stall_s` counts from its first answer."""
AWAY_S = 10.0
"""How long a worker may do without an inference service that is there, before it counts as lost."""
MISSED_S = 60.0
"""How long a process on another node may be out of reach before it is started again, unless its node is found
to have left, of which Ray is certain after half of that."""
ROLLOUT = "rollout"
"""Name of their state."""


@dataclass(kw_only=True)
class Seat:
    """A rollout worker's place."""

    index: int
    incarnation: int = 0
    """Grows with every process that sits here; part of its seeds and keys."""
    starts: int = 0
    """Where it is in the worker's seeds."""
    restarts: int = 0
    """Restarts of workers, since the run was begun or gone on with."""
    outstanding: dict[tuple[str, int], EpisodePlan] = field(default_factory=dict)
    """Planned episodes without a result."""
    unsent: list[EpisodePlan] = field(default_factory=list)
    counters: dict[str, float] = field(default_factory=dict)
    in_world_s: float = 0.0
    stuck_s: float = 0.0
    away: tuple[float, str] = (0.0, "")
    """For how long it has not found inference where it was told, in seconds, and why."""
    moved: Endpoint | None = None
    """Where inference is now, until it has been told."""
    budget: int | None = None
    """Exploring episodes that are still to be played; None: no end."""
    spent: bool = False
    """True if all of them are in replay."""
    unreachable: tuple[float, Exception] | None = None
    """Since when its process cannot be reached, on `time.monotonic`, and how that was found."""
    worker: Watched = field(init=False)


class Seats:
    """All of them.

    Args:
        config: the run.
        tasks: the training tasks.
        history: env steps that an observation holds.
        state: the ``training_state`` to go on from; None: begin.

    Raises:
        InputError: the state is not of an asynchronous run with as many workers.
    """

    def __init__(
        self, config: RunConfig, tasks: tuple[str, ...], history: int, state: Path | None = None
    ) -> None:
        self._config, self._tasks, self._history = config, tasks, history
        self._past: dict[str, float] = {"restarts": 0.0}
        self._peers: tuple[list[Endpoint], Endpoint] | None = None
        self.in_turn = False
        """True if worlds wait for replay after each segment."""
        self._seats = [
            Seat(index=index, budget=budget, spent=budget == 0)
            for index, budget in enumerate(budgets(config.rollout))
        ]
        if state is not None:
            self._restore(state)

    def start(self, plan: Plan) -> None:
        """Starts a process for each, where the plan says."""
        self._plan = plan
        for seat in self._seats:
            seat.worker = self._new(seat)

    def set_to_work(self, inference: list[Endpoint], replay: Endpoint) -> None:
        """Has them step worlds, with these services."""
        self._peers = inference, replay
        for seat in self._seats:
            self._set_to_work(seat)

    def move(self, service: int, inference: Endpoint) -> None:
        """Tells those who ask an inference service where it is now.

        Args:
            service: its number.
            inference: where.
        """
        assert self._peers is not None
        services, _ = self._peers
        services[service] = inference
        for seat in self._seats[service :: len(services)]:
            seat.moved = inference

    def workers(self) -> Iterator[Watched]:
        """Workers that have been started."""
        return (seat.worker for seat in self._seats if hasattr(seat, "worker"))

    def plan(self, plans: list[EpisodePlan]) -> None:
        """See `Engine.plan`."""
        check_new(plans, {key for seat in self._seats for key in seat.outstanding})
        for seat in self._seats:
            self._hand(seat, plans[seat.index :: len(self._seats)])

    def ask(self, training: bool) -> None:
        """Has each report, unless it owes a report already."""
        for seat in self._seats:
            if seat.worker.ask("report", training, seat.unsent, self.in_turn, seat.moved):
                if seat.moved is not None:  # what it said before has been dealt with
                    seat.moved, seat.away = None, (0.0, "")
                seat.unsent = []

    def listen(self) -> list[EpisodeResult]:
        """Picks up the reports that have come; returns the episodes in them. Who fails is started again.

        Raises:
            WorkerError: see `restart_worker`.
        """
        episodes: list[EpisodeResult] = []
        for seat in self._seats:
            try:
                report = seat.worker.answer()
            except RayActorError:
                continue  # its `run` has ended as well, and the engine deals with that
            except RayError as error:
                self._restart(seat, error)
                continue
            if report is None:
                continue
            seat.counters, seat.spent, seat.starts = report.counters, report.spent, report.starts
            seat.in_world_s, seat.stuck_s = report.in_world_s, report.stuck_s
            seat.away = report.away_s, report.away_why
            if seat.budget is not None:
                seat.budget -= sum(e.plan.explore for e in report.episodes)
            for episode in report.episodes:
                planned = seat.outstanding.pop(episode_key(episode.plan), None)
                if episode.plan.explore or planned is not None:
                    episodes.append(episode)
        return episodes

    def counters(self) -> dict[str, float]:
        """Over all of them, and those before them, since the run began."""
        totals = dict(self._past)
        for seat in self._seats:
            for key, value in seat.counters.items():
                totals[key] = totals.get(key, 0.0) + value
        return totals

    @property
    def outstanding(self) -> bool:
        """True if a planned episode has no result yet."""
        return any(seat.outstanding for seat in self._seats)

    @property
    def spent(self) -> bool:
        """True if all exploring episodes that were paid for are in replay."""
        return all(seat.spent for seat in self._seats)

    @property
    def stuck_s(self) -> float:
        """How long the slowest of them, or of their worlds, has been at what it does now."""
        return max(max(seat.in_world_s, seat.stuck_s) for seat in self._seats)

    def restart_worker(self, worker: Watched, error: Exception) -> bool:
        """Starts a worker again that has failed; False if it is none of these.

        Raises:
            WorkerError: it has been done `RolloutConfig.max_restarts` times; carries the worker's traceback.
        """
        for seat in self._seats:
            if seat.worker is worker:
                if isinstance(error, ActorUnavailableError) and self._plan.places[worker.name].node.number:
                    seat.unreachable = (time.monotonic(), error)  # `check_hung` finds out what it is
                else:
                    self._restart(seat, error)
                return True
        return False

    def check_hung(self, served: list[bool]) -> None:
        """Starts those again that do not answer, do nothing, whose world does not return, or who do not find
        inference.

        Args:
            served: of each inference service, whether it is there.

        Raises:
            WorkerError: see `restart_worker`.
        """
        limit = self._config.launch.stall_s
        there = alive() if any(seat.unreachable for seat in self._seats) else frozenset()
        for seat in self._seats:
            away_s, why = seat.away
            if seat.unreachable is not None:
                since, error = seat.unreachable
                left = self._plan.places[seat.worker.name].node.key not in there
                if left or time.monotonic() - since > MISSED_S:
                    self._restart(seat, error)
                continue
            silent = seat.worker.silent_s()
            if silent > (limit if seat.worker.answered else max(START_S, limit)):
                self._restart(seat, RuntimeError(f"no answer for {silent:.0f} s"))
            elif seat.in_world_s > limit:
                self._restart(seat, RuntimeError(f"its world has not returned for {seat.in_world_s:.0f} s"))
            elif seat.stuck_s > limit:
                self._restart(seat, RuntimeError(f"it has done nothing for {seat.stuck_s:.0f} s"))
            elif away_s > AWAY_S and seat.moved is None and served[seat.index % len(served)]:
                self._restart(
                    seat, RuntimeError(f"without inference, which is there, for {away_s:.0f} s: {why}")
                )

    def save(self, directory: Path) -> None:
        """Writes their part of ``training_state``."""
        seats = [
            {
                "incarnation": incarnation_after(seat.incarnation, seat.starts) - 1,
                "budget": seat.budget,
                "outstanding": list(seat.outstanding.values()),
            }
            for seat in self._seats
        ]
        snapshot.save(directory / ROLLOUT, {"past": self.counters(), "seats": seats})

    def _restore(self, directory: Path) -> None:
        if not (directory / f"{ROLLOUT}.json").is_file():
            remedy = "this run was in one process; go on with launch.engine=local"
            raise InputError("launch.engine", self._config.launch.engine, remedy)
        saved = snapshot.load(directory / ROLLOUT)
        if len(saved["seats"]) != len(self._seats):
            remedy = f"this run has {len(saved['seats'])}; leave the field out"
            raise InputError("rollout.workers", len(self._seats), remedy)
        self._past = saved["past"]
        for seat, was in zip(self._seats, saved["seats"], strict=True):
            seat.incarnation, seat.budget = was["incarnation"] + 1, was["budget"]
            if seat.budget is not None:
                seat.budget = whole_groups(seat.budget, self._config.rollout)
                seat.spent = seat.budget == 0
            self._hand(seat, was["outstanding"])

    def _hand(self, seat: Seat, plans: list[EpisodePlan]) -> None:
        seat.outstanding |= {episode_key(plan): plan for plan in plans}
        seat.unsent += plans

    def _new(self, seat: Seat) -> Watched:
        from accerl_lerobot.rollout.worker import RolloutWorker

        c = self._config
        film = (c.evaluation.video_size, c.evaluation.video_every)
        name = f"rollout {seat.index}"
        place = self._plan.places[name]
        actor = ray.remote(RolloutWorker).options(**on(place), max_concurrency=4, **TOKENLESS)
        who = (c.seed, seat.index, seat.incarnation)
        # A node that does not see the run's folder would write a timeline that nobody finds.
        rest = (film, self._history, seat.budget, None if place.node.unseen else timeline_folder(c))
        made = actor.remote(c.env, c.rollout, self._tasks, *who, *rest)
        return Watched(name, made)

    def _restart(self, seat: Seat, error: Exception) -> None:
        """Puts a new process into a seat."""
        name = seat.worker.name
        moved = self._move(name)
        if seat.restarts >= self._config.rollout.max_restarts and not moved:
            times = f" after {seat.restarts} restarts" if seat.restarts else ""
            raise WorkerError(f"{name} worker failed for good{times}:\n{error}") from error
        reason = str(error).strip().splitlines()[-1][:200]
        logger.warning("%s worker is started again: %s", name, reason)
        ray.kill(seat.worker.actor)
        self._past["restarts"] += 1
        for key, value in seat.counters.items():
            self._past[key] = self._past.get(key, 0.0) + value
        seat.counters, seat.in_world_s, seat.stuck_s = {}, 0.0, 0.0
        seat.away, seat.moved, seat.unreachable = (0.0, ""), None, None
        seat.incarnation = incarnation_after(seat.incarnation, seat.starts)
        seat.restarts += not moved  # that its node has left is no fault of its own
        if seat.budget is not None:
            seat.budget = whole_groups(seat.budget, self._config.rollout)
        seat.worker = self._new(seat)
        seat.unsent = list(seat.outstanding.values())
        self._set_to_work(seat)

    def _move(self, name: str) -> bool:
        """Plans another node for a worker whose own has left; False if that is still there."""
        there, node = alive(), self._plan.places[name].node
        if node.key in there:
            return False
        place = self._plan.instead(name, there)
        self._plan = self._plan.moved(name, place)
        self._past["moved"] = self._past.get("moved", 0.0) + 1
        logger.warning("%s has left; its %s worker goes to %s", node, name, place.node)
        return True

    def _set_to_work(self, seat: Seat) -> None:
        assert self._peers is not None
        inference, replay = self._peers
        deciding = inference[seat.index % len(inference)]
        seat.worker.work = seat.worker.actor.run.remote(deciding, replay)
