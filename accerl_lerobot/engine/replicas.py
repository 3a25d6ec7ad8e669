# SPDX-License-Identifier: Apache-2.0
"""The workers that are restarted alone.

    RolloutWorkers       lose unfinished segments and groups with a process; planned episodes are re-run
    InferenceReplicas    lose nothing: a request carries its noise, and clients ask the successor again

Resuming a run works the same way.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Generator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import ActorUnavailableError, RayError

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.engine.config import RunConfig, timeline_folder
from accerl_lerobot.engine.contract import WorkerError, check_new, episode_key, pause_s
from accerl_lerobot.engine.placement import actor_options, alive_nodes
from accerl_lerobot.engine.ray_session import NO_HUB_TOKEN
from accerl_lerobot.engine.supervisor import ActorHandle, ReplicaSet, WorkerSlot
from accerl_lerobot.errors import InputError
from accerl_lerobot.inference.batcher import BatcherStats, dealt, merge_metrics, merge_stats
from accerl_lerobot.metrics import numbered
from accerl_lerobot.policies.config import Load
from accerl_lerobot.rollout.plans import budgets, incarnation_after, whole_groups
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodeResult
from accerl_lerobot.rollout.worker import Report
from accerl_lerobot.transport.endpoint import Endpoint, uses_shared_memory

logger = logging.getLogger(__name__)

START_S = 600.0
"""Timeout for the start of a worker; `LaunchConfig.stall_s` counts from its first answer."""
AWAY_S = 10.0
"""How long a rollout worker may fail to connect to an inference replica that is up."""
UNREACHABLE_S = 60.0
"""How long a process on another node may be out of reach before it is restarted, unless its node is found to
have left, which Ray takes half of that to decide."""
STEADY_S = 30.0
"""An inference replica that has served for so long starts counting restarts anew."""
QUICK_S = 0.2
"""How long to wait for an answer that usually comes at once."""
ROLLOUT = "rollout"
"""Name of the rollout workers' part of a checkpoint."""


@dataclass(kw_only=True)
class RolloutSlot(WorkerSlot):
    """A rollout worker's place."""

    incarnation: int = 0
    """Grows with every process; part of its seeds and of its segments' keys."""
    outstanding: dict[tuple[str, int], EpisodePlan] = field(default_factory=dict)
    """Planned episodes without a result."""
    unsent: list[EpisodePlan] = field(default_factory=list)
    report: Report | None = None
    """Last report of the process."""
    moved: Endpoint | None = None
    """New endpoint of its inference replica, until the process has been told."""
    budget: int | None = None
    """Exploring episodes left; None: no end."""
    spent: bool = False
    """True if replay has all of them."""
    unreachable: tuple[float, Exception] | None = None
    """Since when the process cannot be reached, on `time.monotonic`, and the error."""

    @property
    def starts(self) -> int:
        """Position in the worker's seeds, see `EpisodePlans.starts`."""
        return 0 if self.report is None else self.report.starts

    @property
    def stuck_s(self) -> float:
        """How long the worker or its world has been at what it does now."""
        return 0.0 if self.report is None else max(self.report.in_world_s, self.report.stuck_s)


class RolloutWorkers(ReplicaSet[RolloutSlot]):
    """The rollout workers of a run.

    Args:
        config: the run.
        tasks: the training tasks.
        history: env steps that an observation holds.
        state: the ``training_state`` to resume from; None: begin.

    Raises:
        InputError: the state is not of an asynchronous run with as many workers.
    """

    def __init__(
        self, config: RunConfig, tasks: tuple[str, ...], history: int, state: Path | None = None
    ) -> None:
        slots = [
            RolloutSlot(index=index, name=f"rollout {index}", budget=budget, spent=budget == 0)
            for index, budget in enumerate(budgets(config.rollout))
        ]
        super().__init__(config, slots, config.rollout.max_restarts)
        self._tasks, self._history = tasks, history
        self._past: dict[str, float] = {"restarts": 0.0}
        """Counters of processes that have ended."""
        self._inference: list[Endpoint] = []
        self._replay: Endpoint | None = None
        self.in_turn = False
        """True if worlds wait for replay after each segment."""
        if state is not None:
            self._restore(state)

    def run(self, inference: list[Endpoint], replay: Endpoint) -> None:
        """Have all workers step their worlds."""
        self._inference, self._replay = inference, replay
        for slot in self._slots:
            self._run(slot)

    def move(self, replica: int, inference: Endpoint) -> None:
        """Tell the clients of an inference replica its new endpoint."""
        self._inference[replica] = inference
        for slot in self._slots[replica :: len(self._inference)]:
            slot.moved = inference

    def plan(self, plans: list[EpisodePlan]) -> None:
        """See `Engine.plan`."""
        check_new(plans, {key for slot in self._slots for key in slot.outstanding})
        for slot in self._slots:
            self._assign(slot, plans[slot.index :: len(self._slots)])

    def ask(self, training: bool) -> None:
        """Ask each worker for a report, unless one is outstanding."""
        for slot in self._slots:
            assert slot.worker is not None
            if slot.worker.ask("report", training, slot.unsent, self.in_turn, slot.moved):
                slot.unsent = []
                if slot.moved is not None and slot.report is not None:
                    slot.report = replace(slot.report, away_s=0.0)  # that was about the old endpoint
                slot.moved = None

    def listen(self) -> list[EpisodeResult]:
        """Pick up reports; returns the episodes in them."""
        episodes: list[EpisodeResult] = []
        for slot, report in self._answers():
            slot.report, slot.spent = report, report.spent
            if slot.budget is not None:
                slot.budget -= sum(e.plan.explore for e in report.episodes)
            for episode in report.episodes:
                planned = slot.outstanding.pop(episode_key(episode.plan), None)
                if episode.plan.explore or planned is not None:
                    episodes.append(episode)
        return episodes

    def counters(self) -> dict[str, float]:
        """Sums over all processes since the run began."""
        totals = dict(self._past)
        for slot in self._slots:
            for key, value in (slot.report.counters if slot.report is not None else {}).items():
                totals[key] = totals.get(key, 0.0) + value
        return totals

    @property
    def outstanding(self) -> bool:
        """True if a planned episode has no result yet."""
        return any(slot.outstanding for slot in self._slots)

    @property
    def spent(self) -> bool:
        """True if replay has all exploring episodes of the budget."""
        return all(slot.spent for slot in self._slots)

    @property
    def stuck_s(self) -> float:
        """How long the slowest worker or world has been at what it does now."""
        return max(slot.stuck_s for slot in self._slots)

    def restart_worker(self, worker: ActorHandle, error: Exception) -> bool:
        for slot in self._slots:
            remote = slot.worker is worker and self._plan.places[slot.name].node.number
            if remote and isinstance(error, ActorUnavailableError):
                slot.unreachable = (time.monotonic(), error)  # `check_hung` finds out what has happened
                return True
        return super().restart_worker(worker, error)

    def check_hung(self, served: list[bool]) -> None:
        """Restart workers that do not answer, do nothing, whose world does not return or who do not find
        inference.

        Args:
            served: of each inference replica, True if it is up."""
        there = alive_nodes() if any(slot.unreachable for slot in self._slots) else frozenset()
        for slot in self._slots:
            if slot.unreachable is not None:
                since, error = slot.unreachable
                left = self._plan.places[slot.name].node.key not in there
                if left or time.monotonic() - since > UNREACHABLE_S:
                    self._restart(slot, error)
            elif why := self._hung(slot, served[slot.index % len(served)]):
                self._restart(slot, RuntimeError(why))

    def save(self, directory: Path) -> None:
        """Write the rollout workers' part of ``training_state``."""
        slots = [
            {
                "incarnation": incarnation_after(slot.incarnation, slot.starts) - 1,
                "budget": slot.budget,
                "outstanding": list(slot.outstanding.values()),
            }
            for slot in self._slots
        ]
        snapshot.save(directory / ROLLOUT, {"past": self.counters(), "slots": slots})

    def _restore(self, directory: Path) -> None:
        if not (directory / f"{ROLLOUT}.json").is_file():
            remedy = "this run was in one process; resume it with launch.engine=local"
            raise InputError("launch.engine", self._config.launch.engine, remedy)
        saved = snapshot.load(directory / ROLLOUT)
        if len(saved["slots"]) != len(self._slots):
            remedy = f"this run has {len(saved['slots'])}; leave the field out"
            raise InputError("rollout.workers", len(self._slots), remedy)
        self._past = saved["past"]
        for slot, was in zip(self._slots, saved["slots"], strict=True):
            slot.incarnation, slot.budget = was["incarnation"] + 1, was["budget"]
            if slot.budget is not None:
                slot.budget = whole_groups(slot.budget, self._config.rollout)
                slot.spent = slot.budget == 0
            self._assign(slot, was["outstanding"])

    def _assign(self, slot: RolloutSlot, plans: list[EpisodePlan]) -> None:
        slot.outstanding |= {episode_key(plan): plan for plan in plans}
        slot.unsent += plans

    def _hung(self, slot: RolloutSlot, served: bool) -> str:
        """Reason to restart a worker; empty: none."""
        assert slot.worker is not None
        limit, silent, report = self._config.launch.stall_s, slot.worker.silent_s(), slot.report
        if silent > (limit if slot.worker.answered else max(START_S, limit)):
            return f"no answer for {silent:.0f} s"
        if report is None:
            return ""
        if report.in_world_s > limit:
            return f"its world has not returned for {report.in_world_s:.0f} s"
        if report.stuck_s > limit:
            return f"it has done nothing for {report.stuck_s:.0f} s"
        if report.away_s > AWAY_S and slot.moved is None and served:
            return f"without inference, which is up, for {report.away_s:.0f} s: {report.away_why}"
        return ""

    def _new(self, slot: RolloutSlot) -> ActorHandle:
        from accerl_lerobot.rollout.worker import RolloutWorker, WorkerShare

        c, place = self._config, self._plan.places[slot.name]
        actor = ray.remote(RolloutWorker).options(**actor_options(place), max_concurrency=4, **NO_HUB_TOKEN)
        # A node that does not see the run's folder would write a timeline that nobody finds.
        timeline = None if place.node.unseen else timeline_folder(c)
        share = WorkerShare(slot.index, slot.incarnation, slot.budget)
        made = actor.remote(c.env, c.rollout, self._tasks, c.seed, share, self._history, timeline)
        return ActorHandle(slot.name, made)

    def _restart(self, slot: RolloutSlot, error: Exception) -> None:
        moved = self._move(slot.name)
        self._end_process(slot, error, free=moved)  # that its node has left is not the worker's fault
        self._past["restarts"] += 1
        for key, value in (slot.report.counters if slot.report is not None else {}).items():
            self._past[key] = self._past.get(key, 0.0) + value
        slot.incarnation = incarnation_after(slot.incarnation, slot.starts)
        slot.report, slot.moved, slot.unreachable = None, None, None
        if slot.budget is not None:
            slot.budget = whole_groups(slot.budget, self._config.rollout)
        slot.worker = self._new(slot)
        slot.unsent = list(slot.outstanding.values())
        self._run(slot)

    def _move(self, name: str) -> bool:
        """Plan another node for a worker whose own has left; False if that is still there."""
        there, node = alive_nodes(), self._plan.places[name].node
        if node.key in there:
            return False
        self._plan = self._plan.moved(name, there)
        self._past["moved"] = self._past.get("moved", 0.0) + 1
        logger.warning("%s has left; its %s worker goes to %s", node, name, self._plan.places[name].node)
        return True

    def _run(self, slot: RolloutSlot) -> None:
        assert slot.worker is not None
        inference = self._inference[slot.index % len(self._inference)]
        slot.worker.work = slot.worker.actor.run.remote(inference, self._replay)


@dataclass(kw_only=True)
class InferenceSlot(WorkerSlot):
    """An inference replica's place."""

    up: bool = True
    """True if its clients have been told where it is."""
    since: float = 0.0
    """Start of its service, on `time.monotonic`."""
    metrics: dict[str, float] = field(default_factory=dict)
    due: float = 0.0
    """When the next process is to be started, while there is none."""
    steps: Generator[Any, Any, Endpoint] | None = None
    """Remaining steps of a process that is not up yet."""
    awaited: Any = None
    """Reference that `steps` waits for."""
    deadline: float = 0.0


class InferenceReplicas(ReplicaSet[InferenceSlot]):
    """The inference replicas of a run; rollout worker i asks replica i modulo their number.

        started ─► ready ─► listens and serves ─► has the trainer's newest weights ─► its clients are told

    Args:
        config: the run.
        version: of the first weights.
        state: the ``training_state`` that holds these; None: they are the policy's.
        load: makes the policy's adapter; None: of LeRobot's checkpoint.
    """

    def __init__(self, config: RunConfig, version: int, state: Path | None, load: Load | None) -> None:
        names = numbered("inference", config.inference.workers)
        slots = [InferenceSlot(index=index, name=name) for index, name in enumerate(names)]
        super().__init__(config, slots, config.inference.max_restarts)
        self._arguments = (config.policy, config.inference, version, state, load, timeline_folder(config))
        self.restarts = 0
        """Restarts of all replicas since this engine began."""
        self._trainer: Any = None
        """Handle of the trainer; None: nothing is published yet."""
        self._lock_step = [0] * len(slots)
        """Worlds of each that are decided for together."""

    def open(self) -> list[Endpoint]:
        """Have all replicas serve, once they are ready; their endpoints."""
        launch = self._config.launch
        endpoints = [w.endpoint("decide", launch.transport, launch.stall_s) for w in self.workers()]
        for slot, worker in zip(self._slots, self.workers(), strict=True):
            worker.work, slot.since = worker.actor.serve.remote(), time.monotonic()
        return endpoints

    def publishing(self, trainer: Any) -> list[Any]:
        """Have replicas that come later join this trainer; handles of those that get the first weights."""
        self._trainer = trainer
        return [slot.worker.actor for slot in self._slots if slot.up and slot.worker is not None]

    def lock_step(self, in_turn: bool) -> None:
        """Have each replica decide for all its worlds together, or not any more.

        Raises:
            WorkerError: a replica does not answer.
        """
        rollout = self._config.rollout
        clients = dealt(rollout.workers, len(self._slots))
        for slot in self._slots:
            self._lock_step[slot.index] = clients[slot.index] * rollout.worlds if in_turn else 0
            if slot.up and slot.worker is not None:
                observations, limit = self._lock_step[slot.index], self._config.launch.stall_s
                slot.worker.call("lock_step", observations, timeout=limit)

    def ask(self) -> None:
        """Ask each replica for its metrics, unless they are outstanding."""
        for slot in self._slots:
            if slot.up and slot.worker is not None:
                slot.worker.ask("metrics")

    def awaited(self) -> list[Any]:
        """References that restarts wait for."""
        return [slot.awaited for slot in self._slots if slot.awaited is not None]

    def listen(self) -> dict[str, float]:
        """Pick up metrics; all replicas as one."""
        for slot, metrics in self._answers():
            slot.metrics = metrics
        merged = merge_metrics([slot.metrics for slot in self._slots if slot.metrics])
        return merged | {"restarts": float(self.restarts)}

    def check_hung(self) -> None:
        """Restart replicas that do not answer."""
        for slot in self._slots:
            silent = 0.0 if slot.worker is None else slot.worker.silent_s()
            if slot.up and silent > self._config.launch.stall_s:
                self._restart(slot, RuntimeError(f"no answer for {silent:.0f} s"))

    def advance(self) -> list[tuple[int, Endpoint]]:
        """Continue restarts without waiting.

        Returns:
            Index and endpoint of each replica that has come up."""
        ready = []
        for slot in self._slots:
            if slot.up or (slot.worker is None and time.monotonic() < slot.due):
                continue
            try:
                if (endpoint := self._step(slot)) is not None:
                    ready.append((slot.index, endpoint))
            except (RayError, TimeoutError) as error:
                self._restart(slot, error)
        return ready

    @property
    def up(self) -> list[bool]:
        """True for each replica whose clients know where it is."""
        return [slot.up for slot in self._slots]

    def batching(self) -> BatcherStats:
        """Batches of all replicas so far."""
        limit = self._config.launch.stall_s
        return merge_stats([worker.call("batching", timeout=limit) for worker in self.workers()])

    def _new(self, slot: InferenceSlot) -> ActorHandle:
        from accerl_lerobot.inference.worker import InferenceWorker

        options = actor_options(self._plan.places[slot.name])
        actor = ray.remote(InferenceWorker).options(**options, max_concurrency=1000)
        return ActorHandle(slot.name, actor.remote(*self._arguments, slot.name))

    def _restart(self, slot: InferenceSlot, error: Exception) -> None:
        if slot.up and time.monotonic() - slot.since > STEADY_S:
            slot.restarts = 0
        pause = pause_s(slot.restarts)
        self._end_process(slot, error)
        if (node := self._plan.places[slot.name].node).key not in alive_nodes():
            raise WorkerError(f"{slot.name} worker is lost: {node} has left:\n{error}") from error
        slot.up, slot.steps, slot.awaited, slot.metrics = False, None, None, {}
        slot.due = time.monotonic() + pause
        self.restarts += 1

    def _step(self, slot: InferenceSlot) -> Endpoint | None:
        """Take the next steps of a restart, as far as that needs no waiting; the endpoint after the last one.

        Raises:
            RayError: the process has died or failed.
            TimeoutError: it takes too long.
        """
        answer = None
        if slot.steps is None:
            slot.worker = self._new(slot)
            slot.steps = self._come_up(slot, slot.worker)
        elif ray.wait([slot.awaited], timeout=0)[0]:
            answer = ray.get(slot.awaited)
        elif time.monotonic() > slot.deadline:
            raise TimeoutError("it takes too long to start")
        else:
            return None
        until = time.monotonic() + QUICK_S
        try:
            while True:
                slot.awaited = slot.steps.send(answer)
                if not ray.wait([slot.awaited], timeout=max(0.0, until - time.monotonic()))[0]:
                    return None
                answer = ray.get(slot.awaited)
        except StopIteration as end:
            slot.steps = slot.awaited = None
            slot.up, slot.since = True, time.monotonic()
            logger.info("%s worker is up again", slot.name)
            endpoint: Endpoint = end.value
            return endpoint

    def _come_up(self, slot: InferenceSlot, worker: ActorHandle) -> Generator[Any, Any, Endpoint]:
        """Steps until a new process can be asked; waits for the references that it yields."""
        launch = self._config.launch
        slot.deadline = time.monotonic() + max(START_S, launch.stall_s)
        yield worker.actor.ready.remote()
        slot.deadline = time.monotonic() + launch.stall_s
        address = (yield worker.actor.listen.remote()) if uses_shared_memory(launch.transport) else None
        worker.work = worker.actor.serve.remote()
        lock_step, joined = 0, False
        # Again until nothing has changed meanwhile: training may have begun, or the schedule changed.
        while True:
            if lock_step != self._lock_step[slot.index]:
                lock_step = self._lock_step[slot.index]
                yield worker.actor.lock_step.remote(lock_step)
            elif self._trainer is not None and not joined:
                newest = yield self._trainer.join.remote(worker.actor)
                while (yield worker.actor.metrics.remote())["version"] < newest:
                    if time.monotonic() > slot.deadline:
                        raise TimeoutError(f"weights of version {newest} have not come")
                joined = True
            else:
                return Endpoint(
                    name=worker.name, method=worker.actor.decide, address=address, transport=launch.transport
                )
