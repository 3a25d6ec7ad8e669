# SPDX-License-Identifier: Apache-2.0
"""The contract that both transports keep.

* *whole*: what arrives has the dtypes, shapes, keys, texts and kinds of what was sent;
* *answered*: each reply goes to the message it answers, in whatever order replies are made;
* *detached*: once `Client.send` has returned, the caller may change its arrays;
* *bounded*: every wait has a timeout, and its error says what was awaited;
* *no silence*: a client learns at once that the service has died or failed; a service drops the requests of
  a client that died, and frees their memory.

A new transport passes the checks in ``tests/transport/contract.py``.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

MAX_IN_FLIGHT = 32  # messages that `Client.ask` has under way at most; a transport carries at least so many


class ServiceStoppedError(RuntimeError):
    """The service had failed or is gone; the caller did nothing wrong."""


class Client(ABC):
    """One connection to a service, for one thread at a time.

    Calls raise `ServiceStoppedError` when the service has failed, or is gone.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    @abstractmethod
    def send(self, message: Any) -> int:
        """Sends without waiting for a reply; returns a ticket. A `TimeoutError` if too many are under way."""

    @abstractmethod
    def done(self, timeout: float) -> list[tuple[int, Any]]:
        """Tickets and replies that have come, each once; waits `timeout` seconds for the first."""

    @abstractmethod
    def close(self) -> None:
        """End the connection and forget what is under way. Safe to call twice."""

    def ask(self, messages: Sequence[Any], timeout: float) -> list[Any]:
        """Send messages and wait for all replies; nothing else may be under way."""
        under_way: dict[int, int] = {}  # ticket → index of the message
        replies: dict[int, Any] = {}
        deadline, sent = time.monotonic() + timeout, 0
        while len(replies) < len(messages):
            while sent < len(messages) and len(under_way) < MAX_IN_FLIGHT:
                under_way[self.send(messages[sent])] = sent
                sent += 1
            left = deadline - time.monotonic()
            if left <= 0:
                missing = f"{len(messages) - len(replies)} of {len(messages)} replies"
                raise TimeoutError(f"{self.name}: {missing} did not come within {timeout:g} s")
            replies |= {under_way.pop(ticket): reply for ticket, reply in self.done(left)}
        return [replies[index] for index in range(len(messages))]


@dataclass(eq=False)
class PendingRequest:
    """A message at the service; answered or failed once, on the thread that polls.

    `sent` is on `time.monotonic`, which all processes of a node share; `gone` tells that the answer is not
    awaited any more; `reply` sends a reply, or the error in its place.
    """

    message: Any
    sent: float
    gone: Callable[[], bool]
    reply: Callable[[Any, BaseException | None], None]

    def answer(self, reply: Any) -> None:
        """Send the reply. In shared memory, the message's arrays are valid until then; see `decode`."""
        if not self.gone():
            self.reply(reply, None)

    def fail(self, error: BaseException) -> None:
        """Raise a `ServiceStoppedError` that names this error at the client."""
        if not self.gone():
            self.reply(None, error)

    def __len__(self) -> int:
        return len(self.message)


class Server:
    """A service for threads of its own process; transports add those of other processes.

    `take` gets every message, on the thread that polls, and answers then or later.
    """

    def __init__(self, take: Callable[[PendingRequest], None]) -> None:
        self._take = take
        self._called: deque[PendingRequest] = deque()
        self._woken = threading.Event()

    def call(self, message: Any) -> Future[Any]:
        """Ask from another thread of this process."""
        future: Future[Any] = Future()

        def reply(value: Any, error: BaseException | None) -> None:
            if not future.set_running_or_notify_cancel():
                return
            if error is None:
                future.set_result(value)
            else:
                future.set_exception(stopped(error))

        self._called.append(PendingRequest(message, time.monotonic(), future.cancelled, reply))
        self.wake()
        return future

    def wake(self) -> None:
        """Make the current or next `poll` return at once; from any thread."""
        self._woken.set()

    def poll(self, timeout: float) -> None:
        """Hand over all messages that have come; wait `timeout` seconds at most for one, or for `wake`."""
        self._woken.wait(timeout)
        self._woken.clear()
        while self._called:
            self._take(self._called.popleft())

    def close(self) -> None:
        """End all connections."""


def stopped(error: BaseException) -> ServiceStoppedError:
    """The error that a client gets for a failure of the service."""
    return ServiceStoppedError(f"the service has stopped: {error!r}")
