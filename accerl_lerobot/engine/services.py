# SPDX-License-Identifier: Apache-2.0
"""The inference services of an asynchronous run: places that outlive the processes that take them in turn.

A service that died or hangs is started again alone, as it has no state but weights:

    started ─► ready ─► listens and serves ─► has the trainer's newest weights ─► those who ask it are told

Others go on meanwhile, and what was asked of the one before is asked of it again: a request carries its
noise, so the decision is the one that would have been made, but for the weights, whose version it says. Only
one that cannot be started again is a loss for all.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayActorError, RayError

from accerl_lerobot.engine.cluster import alive, on
from accerl_lerobot.engine.config import RunConfig, timeline_folder
from accerl_lerobot.engine.contract import WorkerError, pause_s
from accerl_lerobot.engine.placement import Plan
from accerl_lerobot.engine.seats import START_S
from accerl_lerobot.engine.watched import Watched
from accerl_lerobot.inference.batcher import BatcherStats
from accerl_lerobot.inference.pool import added, dealt, together
from accerl_lerobot.policies.config import Load
from accerl_lerobot.transport.endpoint import Endpoint, uses_shared_memory

logger = logging.getLogger(__name__)

STEADY_S = 30.0
"""After so long a time of service, what was before is forgotten."""
QUICK_S = 0.2
"""How long an answer is waited for that most likely comes at once."""


@dataclass(kw_only=True)
class Service:
    """An inference service's place."""

    index: int
    name: str
    worker: Watched = field(init=False)
    since: float = 0.0
    """When it began to be asked, on `time.monotonic`."""
    restarts: int = 0
    """Processes that have been here before, in a row."""
    metrics: dict[str, float] = field(default_factory=dict)
    begins: float = 0.0
    """When the next process is started, while there is none."""
    coming: Generator[Any, Any, Endpoint] | None = None
    """Remaining steps until it is asked; None: it is, or there is no process."""
    awaited: Any = None
    """The answer that `coming` waits for."""
    deadline: float = 0.0
    up: bool = True
    """True if those who ask it have been told where it is."""


class Services:
    """All of them.

    Args:
        config: the run.
        version: of the weights that they begin with.
        state: the ``training_state`` that holds these; None: they are the policy's.
        load: makes the policy's adapter; None: of LeRobot's checkpoint.
    """

    def __init__(self, config: RunConfig, version: int, state: Path | None, load: Load | None) -> None:
        self._config = config
        self._serves = (config.policy, config.inference, version, state, load, timeline_folder(config))
        self.restarts = 0
        """Restarts of all, since this engine began."""
        self._trainer: Any = None
        """Handle of the one whose weights they serve; None: nothing is published yet."""
        self._together = [0] * config.inference.workers
        """Worlds of each that are in lock step."""
        several = config.inference.workers > 1
        names = [f"inference {i}" if several else "inference" for i in range(config.inference.workers)]
        self._services = [Service(index=index, name=name) for index, name in enumerate(names)]

    def start(self, plan: Plan) -> None:
        """Starts a process for each, where the plan says."""
        self._plan = plan
        for service in self._services:
            service.worker = self._new(service.name)

    def workers(self) -> Iterator[Watched]:
        """Workers that there are now."""
        there = (service for service in self._services if hasattr(service, "worker"))
        return (service.worker for service in there if not service.begins)

    def open(self) -> list[Endpoint]:
        """Has them serve, once they are ready; where each is."""
        way = self._config.launch.transport, self._config.launch.stall_s
        found = [service.worker.endpoint("decide", *way) for service in self._services]
        for service in self._services:
            service.worker.work, service.since = service.worker.actor.serve.remote(), time.monotonic()
        return found

    def publishing(self, trainer: Any) -> list[Any]:
        """From now on there is a trainer, which publishes weights: those that come later get them from it.

        Returns:
            Handles of those who are to get the first ones.
        """
        self._trainer = trainer
        return [service.worker.actor for service in self._services if service.up]

    def lock_step(self, in_turn: bool) -> None:
        """Has the worlds of each be decided for together, or not any more.

        Raises:
            WorkerError: one of them does not take the order.
        """
        rollout = self._config.rollout
        workers = dealt(rollout.workers, len(self._services))
        self._together = [count * rollout.worlds if in_turn else 0 for count in workers]
        for service, observations in zip(self._services, self._together, strict=True):
            if service.up:
                service.worker.call("lock_step", observations, timeout=self._config.launch.stall_s)

    def ask(self) -> None:
        """Has each report, unless it owes a report already."""
        for service in self._services:
            if service.up:
                service.worker.ask("metrics")

    def awaited(self) -> list[Any]:
        """Answers that those wait for who are to come."""
        return [service.awaited for service in self._services if service.awaited is not None]

    def listen(self) -> dict[str, float]:
        """Picks up what they report, and gives it as of one."""
        for service in self._services:
            try:
                service.metrics = (service.up and service.worker.answer()) or service.metrics
            except RayActorError:
                continue  # its `serve` has ended as well, and the engine deals with that
            except RayError as error:
                self._restart(service, error)
        found = together([service.metrics for service in self._services if service.metrics])
        return found | {"restarts": float(self.restarts)}

    def restart_worker(self, worker: Watched, error: Exception) -> bool:
        """Starts a service again that has failed; False if it is none of these.

        Raises:
            WorkerError: it has been done `InferenceConfig.max_restarts` times; carries its traceback.
        """
        for service in self._services:
            if service.worker is worker:
                self._restart(service, error)
                return True
        return False

    def check_hung(self) -> None:
        """Starts those again that do not answer.

        Raises:
            WorkerError: see `restart_worker`.
        """
        for service in self._services:
            silent = service.worker.silent_s()
            if service.up and silent > self._config.launch.stall_s:
                self._restart(service, RuntimeError(f"no answer for {silent:.0f} s"))

    def advance(self) -> list[tuple[int, Endpoint]]:
        """Goes on with those that are to come, without waiting.

        Returns:
            Number and place of each that is there now.

        Raises:
            WorkerError: see `restart_worker`.
        """
        found = []
        for service in self._services:
            if service.up or time.monotonic() < service.begins:
                continue
            try:
                if (endpoint := self._come(service)) is not None:
                    found.append((service.index, endpoint))
            except (RayError, TimeoutError) as error:
                self._restart(service, error)
        return found

    @property
    def up(self) -> list[bool]:
        """For each, True if those who ask it know where it is."""
        return [service.up for service in self._services]

    def batching(self) -> BatcherStats:
        """Their batches so far."""
        limit = self._config.launch.stall_s
        return added([worker.call("batching", timeout=limit) for worker in self.workers()])

    def _new(self, name: str) -> Watched:
        from accerl_lerobot.inference.worker import InferenceWorker

        actor = ray.remote(InferenceWorker).options(**on(self._plan.places[name]), max_concurrency=1000)
        return Watched(name, actor.remote(*self._serves, name))

    def _restart(self, service: Service, error: Exception) -> None:
        """Ends a process, and has another one take its place.

        Raises:
            WorkerError: that has been done too often, or its node has left.
        """
        if service.up and time.monotonic() - service.since > STEADY_S:
            service.restarts = 0
        if service.restarts >= self._config.inference.max_restarts:
            times = f" after {service.restarts} restarts" if service.restarts else ""
            raise WorkerError(f"{service.name} worker failed for good{times}:\n{error}") from error
        if (node := self._plan.places[service.name].node).key not in alive():
            raise WorkerError(f"{service.name} worker is lost: {node} has left:\n{error}") from error
        reason = str(error).strip().splitlines()[-1][:200]
        logger.warning("%s worker is started again: %s", service.name, reason)
        ray.kill(service.worker.actor)
        service.worker.work = None
        pause = pause_s(service.restarts)
        service.up, service.coming, service.awaited, service.metrics = False, None, None, {}
        service.begins = time.monotonic() + pause
        service.restarts += 1
        self.restarts += 1

    def _come(self, service: Service) -> Endpoint | None:
        """Goes on with one that is to come, without waiting; where it is once it is there.

        Raises:
            RayError: its process has died or failed.
            TimeoutError: it takes too long.
        """
        answer = None
        if service.coming is None:
            service.worker, service.begins = self._new(service.name), 0.0
            service.coming = self._steps(service)
        elif ray.wait([service.awaited], timeout=0)[0]:
            answer = ray.get(service.awaited)
        elif time.monotonic() > service.deadline:
            raise TimeoutError("it takes too long to start")
        else:
            return None
        try:
            until = time.monotonic() + QUICK_S
            while True:
                service.awaited = service.coming.send(answer)
                left = until - time.monotonic()
                if left < 0 or not ray.wait([service.awaited], timeout=left)[0]:
                    return None
                answer = ray.get(service.awaited)
        except StopIteration as end:
            service.coming = service.awaited = None
            service.up, service.since = True, time.monotonic()
            logger.info("%s worker is there again", service.name)
            endpoint: Endpoint = end.value
            return endpoint

    def _steps(self, service: Service) -> Generator[Any, Any, Endpoint]:
        """Steps until a new process may be asked; waits for whatever it yields."""
        launch, worker = self._config.launch, service.worker
        service.deadline = time.monotonic() + max(START_S, launch.stall_s)
        yield worker.actor.ready.remote()
        service.deadline = time.monotonic() + launch.stall_s
        address = (yield worker.actor.listen.remote()) if uses_shared_memory(launch.transport) else None
        worker.work = worker.actor.serve.remote()
        together, joined = 0, False
        # Until all is as it is now: a trainer may have begun meanwhile, or turns ended.
        while True:
            if together != self._together[service.index]:
                together = self._together[service.index]
                yield worker.actor.lock_step.remote(together)
            elif self._trainer is not None and not joined:
                newest = yield self._trainer.join.remote(worker.actor)
                while (yield worker.actor.metrics.remote())["version"] < newest:
                    if time.monotonic() > service.deadline:
                        raise TimeoutError(f"weights of version {newest} have not come")
                joined = True
            else:
                return Endpoint(
                    name=worker.name,
                    method=worker.actor.decide,
                    address=address,
                    transport=launch.transport,
                )
