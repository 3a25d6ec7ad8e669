# SPDX-License-Identifier: Apache-2.0
"""Supervision of the processes of an asynchronous run.

A process that ends is noticed by the call that waits for it (`launch.RayEngine._await_end`), one that hangs
by `WorkerSlot.hung` after ``launch.stall_s``, a replica that takes no weights by `transport.weights`. The
engine waits for a restart, and the other workers go on meanwhile. Resuming a run works the same way.
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import ray
from ray.exceptions import ActorUnavailableError, GetTimeoutError, RayActorError, RayError, RayTaskError

from accerl_lerobot import errors
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.engine.config import RunConfig
from accerl_lerobot.engine.placement import Node, Place, Plan, actor_options, is_alive
from accerl_lerobot.engine.ray_session import NO_HUB_TOKEN
from accerl_lerobot.engine.stopping import WorkerError, pause_s
from accerl_lerobot.errors import InputError, last_exception
from accerl_lerobot.inference.batcher import merge_metrics
from accerl_lerobot.metrics import numbered
from accerl_lerobot.policies.config import Load
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodePlans, EpisodeResult, budgets, incarnation_after
from accerl_lerobot.rollout.worker import Report
from accerl_lerobot.transport.endpoint import Endpoint
from accerl_lerobot.transport.shared_memory import available

logger = logging.getLogger(__name__)

START_S = 600.0  # timeout for the start of a worker; `LaunchConfig.stall_s` counts from its first answer
STEADY_S = 30.0  # a worker that has run for so long starts counting restarts anew
UNREACHABLE_S = 60.0
"""How long a process on another node may be out of reach before it is restarted, unless its node is found to
have left, which Ray takes half of that to decide."""
WARNINGS_S, LAST_WARNINGS_S = 5.0, 1.0
"""Interval at which a worker hands over its warnings, and how long its last ones are waited for."""
LOOK_S = 1.0  # interval at which a node out of reach is looked at
ROLLOUT = "rollout"  # name of the rollout workers' part of a checkpoint


class WorkerSlot:
    """A place for one process after the other, each with a long call that must not end unasked.

    Questions are asked one at a time, without waiting, and answers picked up later, so a worker that hangs
    cannot hang the engine, its silence has a length, and orders arrive in order, which Ray does not promise
    for an actor with threads.
    """

    def __init__(self, name: str, actor: Any = None) -> None:
        self.name = name
        self.restart: Callable[[Exception], None] | None = None
        """Replaces the process after a failure; None: the run cannot go on without it."""
        self.restarts = 0  # in a row
        self.occupy(actor)

    def occupy(self, actor: Any) -> None:
        """Take in a new process, an actor handle; None: there is none yet."""
        self.actor = actor
        self.work: Any = None
        self.process: psutil.Process | None = None  # None: not known yet, or on another node
        self.told: Any = None  # last answer
        self.since = math.inf  # when it was at work, on `time.monotonic`
        self._question: Any = None
        self._asked = 0.0
        self.warnings: Any = None  # handed over at the next look
        self._warnings_since = -math.inf

    def start_timeout(self, limit: float) -> float:
        """Seconds that a new process may take before it answers, where an answer may take `limit` later."""
        return max(START_S, limit)

    def await_start(self, reference: Any, timeout: float, here: bool) -> None:
        """Wait for the answer to ``ready``, its process id, which is of this node if `here`."""
        pid = self.result(reference, "ready", timeout)
        if here:
            with contextlib.suppress(psutil.NoSuchProcess):  # the next question will tell
                self.process = psutil.Process(pid)

    def endpoint(self, method: str, timeout: float) -> Endpoint:
        """Where other workers reach this method."""
        address = self.call("listen", timeout=timeout) if available() else None
        handle = getattr(self.actor, method)
        return Endpoint(name=self.name, method=handle, address=address, actor=self.actor)

    def ask(self, method: str, *arguments: Any) -> bool:
        """Ask unless an answer is outstanding; returns True if it did."""
        if self._question is not None:
            return False
        self._question, self._asked = getattr(self.actor, method).remote(*arguments), time.monotonic()
        return True

    def answer(self, timeout: float = 0.0) -> Any:
        """The answer to the last question, once; None if there is none yet."""
        if self._question is None or not ray.wait([self._question], timeout=timeout)[0]:
            return None
        question, self._question = self._question, None
        self.told = ray.get(question)
        return self.told

    def show_warnings(self) -> None:
        """Shows what its process has warned of, as far as it has handed that over."""
        if self.warnings is not None and ray.wait([self.warnings], timeout=0)[0]:
            warned, self.warnings = self.warnings, None
            with contextlib.suppress(RayError):  # where it has died, others find that out
                errors.show_warnings(ray.get(warned))
        if self.warnings is None and time.monotonic() > self._warnings_since + WARNINGS_S:
            self._warnings_since = time.monotonic()
            self.warnings = self.actor.__ray_call__.remote(errors.collected_warnings)

    def silent_s(self) -> float:
        """Seconds for which an answer has been outstanding."""
        if self._question is None or ray.wait([self._question], timeout=0)[0]:
            return 0.0
        return time.monotonic() - self._asked

    def hung(self, limit: float) -> str:
        """Reason to give it up; empty: none."""
        silent = self.silent_s()
        return f"has not answered for {silent:.0f} s" if silent > limit else ""

    def call(self, method: str, *arguments: Any, timeout: float, **fields: Any) -> Any:
        return self.result(getattr(self.actor, method).remote(*arguments, **fields), method, timeout)

    def result(self, reference: Any, method: str, timeout: float) -> Any:
        """See `call`, for a call that has been made."""
        try:
            return ray.get(reference, timeout=timeout)
        except GetTimeoutError as error:
            raise WorkerError(f"{self.name} worker did not answer {method} within {timeout:.0f} s") from error
        except RayError as error:
            raise WorkerError(f"{self.name} worker failed in {method}:\n{error}") from error

    def discard(self, error: Exception, max_restarts: int | None) -> None:
        """End a process that is to be replaced, unless that was so too often; None: it does not count."""
        if max_restarts is not None:
            if time.monotonic() - self.since > STEADY_S:
                self.restarts = 0
            if self.restarts >= max_restarts:
                times = f" after {self.restarts} restarts" if self.restarts else ""
                raise WorkerError(f"{self.name} worker failed for good{times}:\n{error}") from error
            self.restarts += 1
        show_last_warnings([self])
        number = f" ({self.restarts} of {max_restarts} times)" if max_restarts else ""
        logger.warning("%s worker is restarted%s: %s", self.name, number, last_exception(str(error))[:200])
        ray.kill(self.actor)


def show_last_warnings(workers: Sequence[WorkerSlot]) -> None:
    """Shows what workers that are about to be ended have warned of."""
    asked = [worker.actor.__ray_call__.remote(errors.collected_warnings) for worker in workers]
    asked += [worker.warnings for worker in workers if worker.warnings is not None]
    for warned in ray.wait(asked, num_returns=len(asked), timeout=LAST_WARNINGS_S)[0] if asked else ():
        with contextlib.suppress(RayError):
            errors.show_warnings(ray.get(warned))


class Replicas[W: WorkerSlot](ABC):
    """Workers of one kind that can be restarted alone, `LaunchConfig.max_restarts` times in a row each."""

    def __init__(self, config: RunConfig, workers: list[W]) -> None:
        self._config, self._launch, self._all = config, config.launch, workers
        self._plan = Plan((), {})
        for worker in workers:
            worker.restart = partial(self._restart, worker)

    def start(self, plan: Plan) -> None:
        self._plan = plan
        for worker in self._all:
            worker.occupy(self._new(worker))

    def workers(self) -> Iterator[W]:
        return (worker for worker in self._all if worker.actor is not None)

    @abstractmethod
    def _new(self, worker: W) -> Any:
        """Start a process; its actor handle."""

    @abstractmethod
    def _restart(self, worker: W, error: Exception) -> None: ...


class RolloutSlot(WorkerSlot):
    """A rollout worker, and what its next process has to know; `budget`: exploring episodes left."""

    def __init__(self, index: int, budget: int | None, environments: int = 1) -> None:
        super().__init__(f"rollout {index}")
        self.index, self.budget, self._environments = index, budget, environments
        self.incarnation = 0  # grows with every process; part of its seeds and of its segments' keys
        self.outstanding: dict[tuple[str, int], EpisodePlan] = {}  # planned episodes without a result
        self.unsent: list[EpisodePlan] = []
        self.new_inference: Endpoint | None = None  # where its replica is now, until it has been told
        self.spent = budget == 0  # True if replay has all episodes of the budget

    @property
    def counters(self) -> dict[str, float]:
        return {} if self.told is None else dict(self.told.counters)

    @property
    def next_incarnation(self) -> int:
        return incarnation_after(self.incarnation, 0 if self.told is None else self.told.starts)

    def take(self, report: Report) -> list[EpisodeResult]:
        """Note a report; the episodes in it."""
        self.spent, self.since = report.spent, min(self.since, time.monotonic())
        if self.budget is not None:
            self.budget -= sum(episode.plan.explore for episode in report.episodes)
        known = self.outstanding
        return [e for e in report.episodes if known.pop((e.plan.group, e.plan.index), None) or e.plan.explore]

    def assign(self, plans: list[EpisodePlan]) -> None:
        self.outstanding |= {(plan.group, plan.index): plan for plan in plans}
        self.unsent += plans

    def start_timeout(self, limit: float) -> float:
        """See the base class; its environments are made one after the other."""
        return max(START_S, limit * self._environments)

    def hung(self, limit: float) -> str:
        """Also an environment that does not return."""
        report: Report | None = self.told
        if (why := super().hung(limit if report else self.start_timeout(limit))) or report is None:
            return why
        if report.busy_s > limit:
            what = "its environment has not returned" if report.in_environment else "it has done nothing"
            return f"{what} for {report.busy_s:.0f} s"
        return ""


class RolloutWorkers(Replicas[RolloutSlot]):
    """The rollout workers of a run. A restart loses unfinished segments, and plays planned episodes again."""

    def __init__(
        self, config: RunConfig, tasks: tuple[str, ...], history: int, state: Path | None = None
    ) -> None:
        shares = enumerate(budgets(config.rollout))
        super().__init__(config, [RolloutSlot(i, left, config.rollout.environments) for i, left in shares])
        self._tasks, self._history = tasks, history
        self._past: Counter[str] = Counter(restarts=0)  # counters of processes that have ended
        self._inference: list[Endpoint] = []
        self._replay: Endpoint | None = None
        self.in_turn = False  # True if environments wait for replay after each segment
        if state is not None:
            self._restore(state)

    def run(self, inference: list[Endpoint], replay: Endpoint) -> None:
        self._inference, self._replay = list(inference), replay
        for worker in self._all:
            self._run(worker)

    def move(self, replica: int, inference: Endpoint) -> None:
        """Tell the clients of an inference replica its new endpoint."""
        self._inference[replica] = inference
        for worker in self._all[replica :: len(self._inference)]:
            worker.new_inference = inference

    def plan(self, plans: list[EpisodePlan]) -> None:
        for worker in self._all:
            worker.assign(plans[worker.index :: len(self._all)])

    def ask(self, training: bool) -> None:
        """Ask each worker for a report, unless one is outstanding."""
        for worker in self._all:
            if worker.ask("report", training, worker.unsent, self.in_turn, worker.new_inference):
                worker.unsent, worker.new_inference = [], None

    def counters(self) -> dict[str, float]:
        """Sums over all processes since the run began."""
        totals = self._past.copy()
        for worker in self._all:
            totals.update(worker.counters)
        return dict(totals)

    @property
    def outstanding(self) -> bool:
        return any(worker.outstanding for worker in self._all)

    @property
    def spent(self) -> bool:
        """True if replay has all exploring episodes of the budget."""
        return all(worker.spent for worker in self._all)

    @property
    def moves(self) -> int:
        """Resets and executed chunks of the environments of today's processes."""
        return sum(worker.told.moves for worker in self._all if worker.told is not None)

    @property
    def busy_s(self) -> float:
        """How long the slowest worker has been at what it does now."""
        return max((worker.told.busy_s for worker in self._all if worker.told is not None), default=0.0)

    def save(self, directory: Path) -> None:
        """Write the rollout workers' part of ``training_state``."""
        slots = []
        for worker in self._all:
            outstanding, incarnation = list(worker.outstanding.values()), worker.next_incarnation - 1
            slots.append({"incarnation": incarnation, "budget": worker.budget, "outstanding": outstanding})
        snapshot.save(directory / ROLLOUT, {"past": self.counters(), "slots": slots})

    def _restore(self, directory: Path) -> None:
        if not (directory / f"{ROLLOUT}.json").is_file():
            hint = "this run was in one process; resume it with launch.engine=local"
            raise InputError("launch.engine", self._launch.engine, hint)
        saved = snapshot.load(directory / ROLLOUT)
        if len(saved["slots"]) != len(self._all):
            hint = f"this run has {len(saved['slots'])}; leave the field out"
            raise InputError("rollout.workers", len(self._all), hint)
        self._past = Counter(saved["past"])
        for worker, was in zip(self._all, saved["slots"], strict=True):
            worker.incarnation, worker.budget = was["incarnation"] + 1, was["budget"]
            worker.spent = worker.budget == 0
            worker.assign(was["outstanding"])

    def _new(self, worker: RolloutSlot) -> Any:
        from accerl_lerobot.rollout.worker import RolloutWorker

        c, place = self._config, self._plan.places[worker.name]
        actor = ray.remote(RolloutWorker).options(**actor_options(place), max_concurrency=4, **NO_HUB_TOKEN)
        # A node that does not see the run's folder would write a timeline that nobody finds.
        timeline = None if place.node.unseen else c.timeline_folder
        plans = EpisodePlans(self._tasks, c.seed, worker.budget, worker.index, worker.incarnation)
        return actor.remote(c.env, c.rollout, plans, self._history, timeline)

    def _restart(self, worker: RolloutSlot, error: Exception) -> None:
        if lost := self._has_left(node := self._plan.places[worker.name].node, error):
            logger.warning("%s has left; its %s worker goes to %s", node, worker.name, self._plan.nodes[0])
            self._plan.places[worker.name] = Place(self._plan.nodes[0])
        worker.discard(error, None if lost else self._launch.max_restarts)
        self._past["restarts"] += 1
        self._past.update(worker.counters)
        worker.incarnation, worker.new_inference = worker.next_incarnation, None
        worker.unsent = list(worker.outstanding.values())
        worker.occupy(self._new(worker))
        self._run(worker)

    def _has_left(self, node: Node, error: Exception) -> bool:
        """True if it has left the cluster, which Ray takes a while to tell from being out of reach."""
        unreachable = isinstance(error, ActorUnavailableError) and node.number > 0
        until = time.monotonic() + (UNREACHABLE_S if unreachable else 0.0)
        while (alive := is_alive(node)) and time.monotonic() < until:
            time.sleep(LOOK_S)
        return not alive

    def _run(self, worker: RolloutSlot) -> None:
        inference = self._inference[worker.index % len(self._inference)]
        worker.work = worker.actor.run.remote(inference, self._replay)


class InferenceReplicas(Replicas[WorkerSlot]):
    """The inference replicas of a run; rollout worker i asks replica i modulo their number.

    A restart loses nothing, as a request carries its noise and clients ask the successor again. It gets the
    newest weights before they are told its address: `on_new` is called with its index and endpoint.
    """

    def __init__(
        self,
        config: RunConfig,
        version: int,
        state: Path | None,
        load: Load | None,
        on_new: Callable[[int, Endpoint], None],
    ) -> None:
        super().__init__(config, [WorkerSlot(n) for n in numbered("inference", config.inference.workers)])
        self._arguments = (config.policy, config.inference, version, state, load, config.timeline_folder)
        self._on_new = on_new
        self._in_turn = False
        self.restarts = 0  # restarts of all replicas since this engine began
        self.trainer: Any = None  # handle of the trainer, once it publishes weights

    def open(self) -> list[Endpoint]:
        """Have all replicas serve, once they are ready; their endpoints."""
        return [self._serve(worker) for worker in self._all]

    def lock_step(self, in_turn: bool) -> None:
        """Have each replica decide for all its environments together, or not any more."""
        self._in_turn = in_turn
        for worker in self._all:
            self._lock(worker)

    def metrics(self) -> dict[str, float]:
        """Last metrics, of all replicas as of one."""
        merged = merge_metrics([worker.told for worker in self._all if worker.told])
        return merged | {"restarts": float(self.restarts)}

    def _new(self, worker: WorkerSlot) -> Any:
        from accerl_lerobot.inference.worker import InferenceWorker

        options = actor_options(self._plan.places[worker.name])
        actor = ray.remote(InferenceWorker).options(**options, max_concurrency=1000)
        return actor.remote(*self._arguments, worker.name)

    def _restart(self, worker: WorkerSlot, error: Exception) -> None:
        here, limit = self._plan.places[worker.name].node, self._launch.stall_s
        while True:
            worker.discard(error, self._launch.max_restarts)
            if not is_alive(here):
                raise WorkerError(f"{worker.name} worker is lost: {here} has left:\n{error}") from error
            self.restarts += 1
            time.sleep(pause_s(worker.restarts - 1))
            worker.occupy(self._new(worker))
            try:  # to serve with the trainer's newest weights
                timeout = worker.start_timeout(limit)
                worker.await_start(worker.actor.ready.remote(), timeout, here.number == 0)
                endpoint = self._serve(worker)
                if self._in_turn:
                    self._lock(worker)
                if self.trainer is not None:
                    self._await_weights(worker, endpoint)
                break
            except (RayError, TimeoutError, WorkerError) as again:
                worker.since, error = math.inf, again
        self._on_new(self._all.index(worker), endpoint)
        logger.info("%s worker is up again", worker.name)

    def _serve(self, worker: WorkerSlot) -> Endpoint:
        endpoint = worker.endpoint("receive", self._launch.stall_s)
        worker.work, worker.since = worker.actor.serve.remote(), time.monotonic()
        return endpoint

    def _lock(self, worker: WorkerSlot) -> None:
        rollout = self._config.rollout
        clients = len(range(self._all.index(worker), rollout.workers, len(self._all)))
        together = clients * rollout.environments if self._in_turn else 0
        worker.call("lock_step", together, timeout=self._launch.stall_s)

    def _await_weights(self, worker: WorkerSlot, endpoint: Endpoint) -> None:
        """Wait until a new replica has weights as new as the trainer's were when it joined."""
        limit = self._launch.stall_s
        deadline = time.monotonic() + limit
        try:
            newest = ray.get(self.trainer.join.remote(endpoint), timeout=limit)
        except RayActorError as error:
            if isinstance(error, RayTaskError):  # the trainer says that the replica has died
                raise
            return  # the trainer has died, and the engine deals with that
        while worker.call("metrics", timeout=limit)["version"] < newest:
            if time.monotonic() > deadline:
                raise TimeoutError(f"weights of version {newest} have not come")
            time.sleep(LOOK_S / 20)
