# SPDX-License-Identifier: Apache-2.0
"""Supervision of the processes of an asynchronous run: a handle of one, and sets of restartable ones."""

from __future__ import annotations

import contextlib
import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import psutil
import ray
from ray.exceptions import GetTimeoutError, RayActorError, RayError

from accerl_lerobot.engine.config import RunConfig
from accerl_lerobot.engine.contract import WorkerError
from accerl_lerobot.engine.placement import Plan
from accerl_lerobot.transport.endpoint import Endpoint, Transport, uses_shared_memory

logger = logging.getLogger(__name__)

GONE_S = 3.0
"""How long a killed process may take to be gone."""
LOOK_S = 1.0
"""Between two looks at whether a process in a long call still answers."""


class ActorHandle:
    """One long call that must not end unasked, and one question at a time.

    Questions are asked without waiting and answers picked up later, so a worker that hangs cannot hang the
    engine, its silence has a length, and orders arrive in order, which Ray does not promise for an actor with
    threads.

    Example:
        >>> worker = ActorHandle("trainer", actor)
        >>> worker.work = actor.run.remote()    # `ray.wait` on it: its end is an event
        >>> worker.ask("metrics")               # again and again: does nothing until the answer is picked up
        >>> worker.answer(), worker.silent_s()
        (None, 0.4)

    Args:
        name: for messages.
        actor: its Ray handle.
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

        Raises:
            WorkerError: it did not start.
        """
        pid = self.result(reference, "ready", timeout)
        if here:
            with contextlib.suppress(psutil.NoSuchProcess):  # the next question will tell
                self.process = psutil.Process(pid)

    def endpoint(self, method: str, transport: Transport, timeout: float) -> Endpoint:
        """Where other workers reach this method."""
        address = self.call("listen", timeout=timeout) if uses_shared_memory(transport) else None
        return Endpoint(
            name=self.name, method=getattr(self.actor, method), address=address, transport=transport
        )

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
        return 0.0 if self._question is None else time.monotonic() - self._asked

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


def end(workers: Iterable[ActorHandle], *, told: bool = True) -> None:
    """End workers and wait until they are gone, so that nothing writes any more when others start.

    Args:
        told: True: Ray tells them to end, which a stopped process does not hear; False: Ray is lost.
    """
    workers = list(workers)
    for worker in workers if told else ():
        ray.kill(worker.actor)
    processes = [worker.process for worker in workers if worker.process is not None]
    left = psutil.wait_procs(processes, timeout=GONE_S if told else 0.0)[1]
    for process in left:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()
    psutil.wait_procs(left, timeout=GONE_S)


@dataclass(kw_only=True)
class WorkerSlot:
    """A place for one process after the other."""

    index: int
    name: str
    worker: ActorHandle | None = None
    """None: there is no process now."""
    restarts: int = 0


class ReplicaSet[S: WorkerSlot](ABC):
    """Workers of one kind that can be restarted alone.

    Args:
        config: the run.
        slots: one for each worker.
        max_restarts: of each slot.
    """

    def __init__(self, config: RunConfig, slots: list[S], max_restarts: int) -> None:
        self._config, self._slots, self._max_restarts = config, slots, max_restarts
        self._plan = Plan((), {})

    def start(self, plan: Plan) -> None:
        """Start a process for each slot, where the plan says."""
        self._plan = plan
        for slot in self._slots:
            slot.worker = self._new(slot)

    def workers(self) -> Iterator[ActorHandle]:
        """Workers that there are now."""
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
        """Replace the process of a slot.

        Raises:
            WorkerError: see `restart_worker`.
        """

    def _end_process(self, slot: S, error: Exception, *, free: bool = False) -> None:
        """End the process of a slot and count the restart, unless it is `free`."""
        if slot.restarts >= self._max_restarts and not free:
            times = f" after {slot.restarts} restarts" if slot.restarts else ""
            raise WorkerError(f"{slot.name} worker failed for good{times}:\n{error}") from error
        assert slot.worker is not None
        reason = str(error).strip().splitlines()[-1][:200]
        logger.warning("%s worker is restarted: %s", slot.name, reason)
        ray.kill(slot.worker.actor)
        slot.worker = None
        slot.restarts += not free

    def _answers(self) -> Iterator[tuple[S, Any]]:
        """Answers that have come. A worker whose answer is an error is restarted."""
        for slot in self._slots:
            try:
                answer = None if slot.worker is None else slot.worker.answer()
            except RayActorError:
                continue  # its long call has ended as well, and the engine deals with that
            except RayError as error:
                self._restart(slot, error)
                continue
            if answer is not None:
                yield slot, answer
