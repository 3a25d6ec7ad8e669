# SPDX-License-Identifier: Apache-2.0
"""An actor as the conductor sees it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable
from typing import Any

import psutil
import ray
from ray.exceptions import GetTimeoutError, RayError

from accerl_lerobot.engine.contract import WorkerError
from accerl_lerobot.transport.endpoint import Endpoint, Transport, uses_shared_memory

GONE_S = 3.0
"""How long a process may take to go that was told to."""
LOOK_S = 1.0
"""Between two looks at whether a process that takes long is still there."""


class Watched:
    """One long call that must not end unasked, and one question at a time.

    Questions are asked without waiting and answers picked up later. So a worker that hangs cannot hang the
    conductor, its silence has a length, and orders arrive in order, which Ray does not promise for an actor
    with threads.

    Example:
        >>> worker = Watched("trainer", actor)
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
        """None: it has not said yet which one it is, or is on another node."""
        self.answered = False
        self._question: Any = None
        self._asked = 0.0

    def await_start(self, reference: Any, timeout: float, here: bool) -> None:
        """Waits until it is ready.

        Args:
            reference: of the call that asks whether it is.
            timeout: seconds.
            here: whether it is on this node; a process of that number on another one is none to touch.

        Raises:
            WorkerError: it did not start.
        """
        pid = self.result(reference, "ready", timeout)
        if not here:
            return
        with contextlib.suppress(psutil.NoSuchProcess):  # whoever asks it anything will hear of that
            self.process = psutil.Process(pid)

    def endpoint(self, method: str, transport: Transport, timeout: float) -> Endpoint:
        """Where other workers reach it, by this method."""
        address = self.call("listen", timeout=timeout) if uses_shared_memory(transport) else None
        way = getattr(self.actor, method)
        return Endpoint(name=self.name, method=way, address=address, transport=transport)

    def ask(self, method: str, *arguments: Any) -> bool:
        """Asks unless an answer is still owed; returns whether it did."""
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
        """For how long an answer has been owed, in seconds."""
        return 0.0 if self._question is None else time.monotonic() - self._asked

    def call(self, method: str, *arguments: Any, timeout: float, silence: float | None = None) -> Any:
        """Waits for one answer.

        Args:
            method: of the actor.
            arguments: of the method.
            timeout: seconds until the answer.
            silence: seconds in which it must say meanwhile that it is there; None: it need not.

        Raises:
            WorkerError: it failed, with its traceback, or did not come in time.
        """
        reference = getattr(self.actor, method).remote(*arguments)
        if silence is not None:
            self._listen(reference, method, timeout, silence)
        return self.result(reference, method, timeout)

    def _listen(self, reference: Any, method: str, timeout: float, silence: float) -> None:
        """Waits for an answer that may take long, from a process that must not hang."""
        deadline = time.monotonic() + timeout
        beat, asked = self.actor.ready.remote(), time.monotonic()
        while not ray.wait([reference], timeout=min(LOOK_S, silence / 4))[0]:
            now = time.monotonic()
            if now > deadline:
                return  # `result` says so
            if ray.wait([beat], timeout=0)[0]:
                beat, asked = self.actor.ready.remote(), now
            elif now - asked > silence:
                raise WorkerError(f"{self.name} worker has not answered for {now - asked:.0f} s, in {method}")

    def result(self, reference: Any, method: str, timeout: float) -> Any:
        """As `call`, for a call that has been made."""
        try:
            return ray.get(reference, timeout=timeout)
        except GetTimeoutError as error:
            raise WorkerError(f"{self.name} worker did not answer {method} within {timeout:.0f} s") from error
        except RayError as error:
            raise WorkerError(f"{self.name} worker failed in {method}:\n{error}") from error


def end(workers: Iterable[Watched], *, told: bool = True) -> None:
    """Ends them, and waits until they are gone: nobody is to write any more where others begin anew.

    Args:
        workers: of this node, and of others if Ray tells them.
        told: whether Ray tells them to go, which a stopped process does not hear; False: Ray is lost.
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
