# SPDX-License-Identifier: Apache-2.0
"""Supervision of the processes of an asynchronous run.

    ActorHandle          one process: a long call that must not end unasked, and one question at a time
    RolloutWorkers       restarted alone: a process loses its unfinished segments; planned episodes
                         are run again
    InferenceReplicas    restarted alone: nothing is lost, as a request carries its noise and clients ask the
                         successor again

The engine waits for a restart, and the other workers go on meanwhile. Resuming a run works the same way.
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import psutil
import ray
from ray.exceptions import ActorUnavailableError, GetTimeoutError, RayActorError, RayError, RayTaskError

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.engine.config import RunConfig, timeline_folder
from accerl_lerobot.engine.loop import check_new, episode_key
from accerl_lerobot.engine.placement import Plan, actor_options, alive_nodes
from accerl_lerobot.engine.ray_session import NO_HUB_TOKEN
from accerl_lerobot.engine.stopping import WorkerError, pause_s
from accerl_lerobot.errors import InputError
from accerl_lerobot.inference.batcher import BatcherStats, dealt, merge_metrics, merge_stats
from accerl_lerobot.metrics import numbered
from accerl_lerobot.policies.config import Load
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodeResult, budgets, incarnation_after
from accerl_lerobot.rollout.worker import Report
from accerl_lerobot.transport.endpoint import Endpoint, Transport, uses_shared_memory

logger = logging.getLogger(__name__)

START_S = 600.0
"""Timeout for the start of a worker; `LaunchConfig.stall_s` counts from its first answer."""
STEADY_S = 30.0
"""A worker that has run for so long starts counting restarts anew."""
AWAY_S = 10.0
"""How long a rollout worker may fail to connect to its inference replica."""
UNREACHABLE_S = 60.0
"""How long a process on another node may be out of reach before it is restarted, unless its node is found to
have left, which Ray takes half of that to decide."""
LOOK_S = 1.0
"""Interval at which a process in a long call, or a node out of reach, is looked at."""
ROLLOUT = "rollout"
"""Name of the rollout workers' part of a checkpoint."""


class ActorHandle:
    """One long call that must not end unasked, and one question at a time.

    Questions are asked without waiting and answers picked up later, so a worker that hangs cannot hang the
    engine, its silence has a length, and orders arrive in order, which Ray does not promise for an actor with
    threads.

    Example:
        >>> worker = ActorHandle("trainer", actor)
        >>> worker.work = actor.run.remote()    # `ray.wait` on it: its end is an event
        >>> worker.ask("metrics")               # does nothing until the last answer was picked up
    """

    def __init__(self, name: str, actor: Any) -> None:
        self.name, self.actor = name, actor
        self.work: Any = None
        self.process: psutil.Process | None = None
        """None: not known yet, or on another node."""
        self.answered = False
        self._question: Any = None
        self._asked = 0.0

    def await_start(self, reference: Any, timeout: float, here: bool) -> None:
        """Wait for the answer to ``ready``, its process id.

        Args:
            here: True on this node; a process of that number on another node must not be touched.
        """
        pid = self.result(reference, "ready", timeout)
        if here:
            with contextlib.suppress(psutil.NoSuchProcess):  # the next question will tell
                self.process = psutil.Process(pid)

    def endpoint(self, method: str, transport: Transport, timeout: float) -> Endpoint:
        """Where other workers reach this method."""
        address = self.call("listen", timeout=timeout) if uses_shared_memory(transport) else None
        return Endpoint(name=self.name, method=getattr(self.actor, method), address=address)

    def ask(self, method: str, *arguments: Any) -> bool:
        """Ask unless an answer is outstanding; returns True if it did."""
        if self._question is not None:
            return False
        self._question, self._asked = getattr(self.actor, method).remote(*arguments), time.monotonic()
        return True

    def answer(self, timeout: float = 0.0) -> Any:
        """The answer to the last question, once; None if there is none yet.

        Raises:
            RayError: the call failed, or the process has died.
        """
        if self._question is None or not ray.wait([self._question], timeout=timeout)[0]:
            return None
        question, self._question = self._question, None
        answer = ray.get(question)
        self.answered = True
        return answer

    def silent_s(self) -> float:
        """Seconds for which an answer has been outstanding."""
        if self._question is None or ray.wait([self._question], timeout=0)[0]:
            return 0.0
        return time.monotonic() - self._asked

    def call(self, method: str, *arguments: Any, timeout: float, silence: float | None = None) -> Any:
        """Call a method and wait for its answer.

        Args:
            timeout: seconds until the answer.
            silence: seconds in which it must answer ``ready`` meanwhile; None: it need not.

        Raises:
            WorkerError: it failed, with its traceback, or did not answer in time.
        """
        reference = getattr(self.actor, method).remote(*arguments)
        if silence is not None:
            self._check_alive(reference, method, timeout, silence)
        return self.result(reference, method, timeout)

    def result(self, reference: Any, method: str, timeout: float) -> Any:
        """See `call`, for a call that has been made."""
        try:
            return ray.get(reference, timeout=timeout)
        except GetTimeoutError as error:
            raise WorkerError(f"{self.name} worker did not answer {method} within {timeout:.0f} s") from error
        except RayError as error:
            raise WorkerError(f"{self.name} worker failed in {method}:\n{error}") from error

    def _check_alive(self, reference: Any, method: str, timeout: float, silence: float) -> None:
        """Wait for an answer that may take long, from a process that must not hang."""
        deadline = time.monotonic() + timeout
        beat, asked = self.actor.ready.remote(), time.monotonic()
        while not ray.wait([reference], timeout=min(LOOK_S, silence / 4))[0]:
            now = time.monotonic()
            if now > deadline:
                return  # `result` reports it
            if ray.wait([beat], timeout=0)[0]:
                beat, asked = self.actor.ready.remote(), now
            elif now - asked > silence:
                raise WorkerError(f"{self.name} worker has not answered for {now - asked:.0f} s, in {method}")


@dataclass(kw_only=True)
class WorkerSlot:
    """A place for one process after the other."""

    index: int
    name: str
    worker: ActorHandle = None  # type: ignore[assignment]
    """Set by `ReplicaSet.start`."""
    restarts: int = 0
    """In a row."""
    since: float = math.inf
    """When the process was at work, on `time.monotonic`."""


class ReplicaSet[S: WorkerSlot](ABC):
    """Workers of one kind that can be restarted alone, `LaunchConfig.max_restarts` times in a row each."""

    def __init__(self, config: RunConfig, slots: list[S]) -> None:
        self._config, self._slots = config, slots
        self._plan = Plan((), {})

    def start(self, plan: Plan) -> None:
        """Start a process for each slot, where the plan says."""
        self._plan = plan
        for slot in self._slots:
            slot.worker = self._new(slot)

    def workers(self) -> Iterator[ActorHandle]:
        """All workers of this kind, once they have been started."""
        return (slot.worker for slot in self._slots if slot.worker is not None)

    def restart_worker(self, worker: ActorHandle, error: Exception) -> bool:
        """Restart a worker that has failed; False if it is not one of these.

        Raises:
            WorkerError: it has been restarted too often; carries its traceback.
        """
        for slot in self._slots:
            if slot.worker is worker:
                self._restart(slot, error)
                return True
        return False

    @abstractmethod
    def _new(self, slot: S) -> ActorHandle:
        """Start a process for a slot."""

    @abstractmethod
    def _restart(self, slot: S, error: Exception) -> None:
        """Replace the process of a slot; see `restart_worker`."""

    def _end_process(self, slot: S, error: Exception, *, free: bool = False) -> None:
        """End the process of a slot and count the restart, unless it is `free`."""
        if time.monotonic() - slot.since > STEADY_S:
            slot.restarts = 0
        if slot.restarts >= self._config.launch.max_restarts and not free:
            times = f" after {slot.restarts} restarts" if slot.restarts else ""
            raise WorkerError(f"{slot.name} worker failed for good{times}:\n{error}") from error
        reason = str(error).strip().splitlines()[-1][:200]
        logger.warning("%s worker is restarted: %s", slot.name, reason)
        ray.kill(slot.worker.actor)
        slot.restarts, slot.since = slot.restarts + (not free), math.inf

    def _answers(self) -> Iterator[tuple[S, Any]]:
        """Answers that have come. A worker whose answer is an error is restarted."""
        for slot in self._slots:
            try:
                answer = slot.worker.answer()
            except RayActorError:
                continue  # its long call has ended as well, and the engine deals with that
            except RayError as error:
                self._restart(slot, error)
                continue
            if answer is not None:
                yield slot, answer


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

    @property
    def next_incarnation(self) -> int:
        """Incarnation of another process in this place."""
        return incarnation_after(self.incarnation, 0 if self.report is None else self.report.starts)


class RolloutWorkers(ReplicaSet[RolloutSlot]):
    """The rollout workers of a run.

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
        super().__init__(config, slots)
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
            slot.since = min(slot.since, time.monotonic())
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
            _add(totals, slot.report)
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
        reports = [slot.report for slot in self._slots if slot.report is not None]
        return max((max(report.in_world_s, report.stuck_s) for report in reports), default=0.0)

    def check_hung(self) -> None:
        """Restart workers that do not answer or do nothing, whose world does not return, or that do not find
        inference."""
        for slot in self._slots:
            if why := self._hung(slot):
                self._restart(slot, RuntimeError(why))

    def save(self, directory: Path) -> None:
        """Write the rollout workers' part of ``training_state``."""
        slots = [
            {
                "incarnation": slot.next_incarnation - 1,
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
                slot.spent = slot.budget == 0
            self._assign(slot, was["outstanding"])

    def _assign(self, slot: RolloutSlot, plans: list[EpisodePlan]) -> None:
        slot.outstanding |= {episode_key(plan): plan for plan in plans}
        slot.unsent += plans

    def _hung(self, slot: RolloutSlot) -> str:
        """Reason to restart a worker; empty: none."""
        limit, silent, report = self._config.launch.stall_s, slot.worker.silent_s(), slot.report
        if silent > (limit if slot.worker.answered else max(START_S, limit)):
            return f"no answer for {silent:.0f} s"
        if report is None:
            return ""
        if report.in_world_s > limit:
            return f"its world has not returned for {report.in_world_s:.0f} s"
        if report.stuck_s > limit:
            return f"it has done nothing for {report.stuck_s:.0f} s"
        if report.away_s > AWAY_S and slot.moved is None:
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
        if isinstance(error, ActorUnavailableError):
            self._await_verdict(slot.name)
        moved = self._move(slot.name)
        self._end_process(slot, error, free=moved)  # that its node has left is not the worker's fault
        self._past["restarts"] += 1
        _add(self._past, slot.report)
        slot.incarnation = slot.next_incarnation
        slot.report, slot.moved = None, None
        slot.worker = self._new(slot)
        slot.unsent = list(slot.outstanding.values())
        self._run(slot)

    def _await_verdict(self, name: str) -> None:
        """Wait until Ray has decided whether the node of a worker out of reach has left, if it is another."""
        node, until = self._plan.places[name].node, time.monotonic() + UNREACHABLE_S
        while node.number and node.key in alive_nodes() and time.monotonic() < until:
            time.sleep(LOOK_S)

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
        inference = self._inference[slot.index % len(self._inference)]
        slot.worker.work = slot.worker.actor.run.remote(inference, self._replay)


def _add(totals: dict[str, float], report: Report | None) -> None:
    """Add a report's counters to `totals`."""
    for key, value in (report.counters if report is not None else {}).items():
        totals[key] = totals.get(key, 0.0) + value


@dataclass(kw_only=True)
class InferenceSlot(WorkerSlot):
    """An inference replica's place."""

    metrics: dict[str, float] = field(default_factory=dict)
    lock_step: int = 0
    """Worlds that are decided for together; 0: each for itself."""


class InferenceReplicas(ReplicaSet[InferenceSlot]):
    """The inference replicas of a run; rollout worker i asks replica i modulo their number.

    Args:
        version: of the first weights.
        state: the ``training_state`` that holds these; None: they are the policy's.
        load: makes the policy's adapter; None: of LeRobot's checkpoint.
        moved: called with the index and new endpoint of a replica that has been restarted.
    """

    def __init__(
        self,
        config: RunConfig,
        version: int,
        state: Path | None,
        load: Load | None,
        moved: Callable[[int, Endpoint], None],
    ) -> None:
        names = numbered("inference", config.inference.workers)
        super().__init__(config, [InferenceSlot(index=i, name=name) for i, name in enumerate(names)])
        self._arguments = (config.policy, config.inference, version, state, load, timeline_folder(config))
        self._moved = moved
        self.restarts = 0
        """Restarts of all replicas since this engine began."""
        self._trainer: Any = None
        """Handle of the trainer; None: nothing is published yet."""

    def open(self) -> list[Endpoint]:
        """Have all replicas serve, once they are ready; their endpoints."""
        launch = self._config.launch
        endpoints = [w.endpoint("decide", launch.transport, launch.stall_s) for w in self.workers()]
        for slot in self._slots:
            slot.worker.work, slot.since = slot.worker.actor.serve.remote(), time.monotonic()
        return endpoints

    def publishing(self, trainer: Any) -> list[Any]:
        """Have replicas that come later join this trainer; handles of those that there are."""
        self._trainer = trainer
        return [worker.actor for worker in self.workers()]

    def lock_step(self, in_turn: bool) -> None:
        """Have each replica decide for all its worlds together, or not any more."""
        rollout = self._config.rollout
        clients = dealt(rollout.workers, len(self._slots))
        for slot in self._slots:
            slot.lock_step = clients[slot.index] * rollout.worlds if in_turn else 0
            slot.worker.call("lock_step", slot.lock_step, timeout=self._config.launch.stall_s)

    def ask(self) -> None:
        """Ask each replica for its metrics, unless they are outstanding."""
        for worker in self.workers():
            worker.ask("metrics")

    def listen(self) -> dict[str, float]:
        """Pick up metrics; all replicas as one."""
        for slot, metrics in self._answers():
            slot.metrics = metrics
        merged = merge_metrics([slot.metrics for slot in self._slots if slot.metrics])
        return merged | {"restarts": float(self.restarts)}

    def check_hung(self) -> None:
        """Restart replicas that do not answer."""
        for slot in self._slots:
            if (silent := slot.worker.silent_s()) > self._config.launch.stall_s:
                self._restart(slot, RuntimeError(f"no answer for {silent:.0f} s"))

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
        again: Exception | None = error
        while again is not None:
            self._end_process(slot, again)
            if (node := self._plan.places[slot.name].node).key not in alive_nodes():
                raise WorkerError(f"{slot.name} worker is lost: {node} has left:\n{again}") from again
            self.restarts += 1
            time.sleep(pause_s(slot.restarts - 1))
            slot.worker, slot.metrics = self._new(slot), {}
            again = self._come_up(slot)
        logger.info("%s worker is up again", slot.name)

    def _come_up(self, slot: InferenceSlot) -> Exception | None:
        """Wait until a new process serves with the trainer's newest weights, and tell its clients.

        Returns:
            The error, if it fails or takes too long.
        """
        worker, launch = slot.worker, self._config.launch
        here = self._plan.places[slot.name].node.number == 0
        try:
            worker.await_start(worker.actor.ready.remote(), max(START_S, launch.stall_s), here)
            endpoint = worker.endpoint("decide", launch.transport, launch.stall_s)
            worker.work = worker.actor.serve.remote()
            if slot.lock_step:
                worker.call("lock_step", slot.lock_step, timeout=launch.stall_s)
            if self._trainer is not None:
                self._await_weights(worker)
        except (RayError, TimeoutError, WorkerError) as error:
            return error
        slot.since = time.monotonic()
        self._moved(slot.index, endpoint)
        return None

    def _await_weights(self, worker: ActorHandle) -> None:
        """Wait until a new replica has weights as new as the trainer's were when it joined."""
        limit = self._config.launch.stall_s
        deadline = time.monotonic() + limit
        try:
            newest = ray.get(self._trainer.join.remote(worker.actor), timeout=limit)
        except RayActorError as error:
            if isinstance(error, RayTaskError):  # the trainer says that the replica has died
                raise
            return  # the trainer has died, and the engine deals with that
        while worker.call("metrics", timeout=limit)["version"] < newest:
            if time.monotonic() > deadline:
                raise TimeoutError(f"weights of version {newest} have not come")
            time.sleep(LOOK_S / 20)
