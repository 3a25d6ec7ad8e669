# SPDX-License-Identifier: Apache-2.0
"""The contract that every transport keeps, and the way in for those who are in the server's own process.

What must hold, whatever carries the messages:

* *whole*: what arrives has the dtypes, shapes, keys, texts and kinds of what was sent;
* *answered*: each reply goes to the message it answers, in whatever order replies are made; one that nobody
  waits for any more is dropped;
* *detached*: once `Caller.send` has returned, the caller may change its arrays;
* *no waiting for ever*: every wait has an end, and an error says what was waited for;
* *no silence*: a caller learns at once that the service has died, or that it failed; a service forgets what
  a caller that died had asked, and frees its memory.

A new transport passes the checks in ``tests/transport/contract.py``.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any

AT_ONCE = 32
"""Messages that `Caller.ask` has under way at most; a transport carries at least so many."""


class ServiceStoppedError(RuntimeError):
    """The caller did nothing wrong: the service behind it had failed, and says why where it failed."""


class Caller(ABC):
    """One end of a connection; the other one belongs to a service. For one thread at a time.

    Example:
        >>> first, second = inference.send([request]), inference.send([another])
        >>> inference.done(timeout=0.5)  # as they come
        [(1, [Decision(...)])]

    Args:
        name: of the service, for messages.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    @abstractmethod
    def send(self, message: Any) -> int:
        """Hands a message over and does not wait for its reply.

        Returns:
            The ticket that the reply will have.

        Raises:
            ServiceStoppedError: the service is gone.
            TimeoutError: it takes no message.
            TypeError: the message cannot be sent.
        """

    @abstractmethod
    def done(self, timeout: float) -> list[tuple[int, Any]]:
        """Replies that have come, with their tickets; each once.

        Args:
            timeout: seconds to wait for the first of them; with 0 it does not wait.

        Returns:
            Nothing if none came in time.

        Raises:
            ServiceStoppedError: the service failed, or is gone.
        """

    @abstractmethod
    def forget(self, ticket: int) -> None:
        """Drops the reply to a message, whether it has come or will."""

    @abstractmethod
    def close(self) -> None:
        """Ends the connection; what is under way is forgotten. Safe to call twice."""

    def ask(self, messages: Sequence[Any], timeout: float) -> list[Any]:
        """Sends messages and waits for all replies; nothing else may be under way.

        Raises:
            ServiceStoppedError: see `done`.
            TimeoutError: they did not all come in so many seconds.
        """
        under_way: dict[int, int] = {}
        """Ticket → which of the messages."""
        replies: dict[int, Any] = {}
        deadline, sent = time.monotonic() + timeout, 0
        while len(replies) < len(messages):
            while sent < len(messages) and len(under_way) < AT_ONCE:
                under_way[self.send(messages[sent])] = sent
                sent += 1
            left = deadline - time.monotonic()
            if left <= 0:
                for ticket in under_way:
                    self.forget(ticket)
                missing = f"{len(messages) - len(replies)} of {len(messages)} replies"
                raise TimeoutError(f"{self.name}: {missing} did not come within {timeout:g} s")
            replies |= {under_way.pop(ticket): reply for ticket, reply in self.done(left)}
        return [replies[number] for number in range(len(messages))]


class Asked(ABC):
    """A message as the service gets it. Answered or failed once, on the thread that polls."""

    message: Any
    """Where it lies in shared memory, arrays are only good until the answer; see `decode`."""
    sent: float
    """When, on `time.monotonic`, which all processes of a node share."""

    @property
    @abstractmethod
    def gone(self) -> bool:
        """Nobody waits for the answer any more."""

    @abstractmethod
    def answer(self, reply: Any) -> None:
        """Sends the reply; does nothing if nobody waits for it."""

    @abstractmethod
    def fail(self, error: BaseException) -> None:
        """Has the caller get a `ServiceStoppedError` that names this error."""

    def __len__(self) -> int:
        """Length of the message, which is a list where this is asked for."""
        return len(self.message)


class AskedHere(Asked):
    """By another thread of this process, as Ray's calls are."""

    def __init__(self, message: Any) -> None:
        self.message, self.sent = message, time.monotonic()
        self.future: Future[Any] = Future()

    @property
    def gone(self) -> bool:
        return self.future.cancelled()

    def answer(self, reply: Any) -> None:
        if self.future.set_running_or_notify_cancel():
            self.future.set_result(reply)

    def fail(self, error: BaseException) -> None:
        if self.future.set_running_or_notify_cancel():
            self.future.set_exception(stopped(error))


class Server:
    """The other end, for callers of this process; those of other processes are what transports add.

    Example:
        >>> server = Server(lambda asked: asked.answer(len(asked.message)))
        >>> reply = server.call("four")   # on any thread
        >>> server.poll(timeout=1.0)      # on the one that serves: hands it to the function above
        >>> reply.result(timeout=1.0)
        4

    Args:
        take: gets every message, on the thread that polls; answers then or later.
    """

    def __init__(self, take: Callable[[Asked], None]) -> None:
        self._take = take
        self._called: deque[AskedHere] = deque()
        self._woken = threading.Event()

    def call(self, message: Any) -> Future[Any]:
        """Asks from another thread of this process."""
        asked = AskedHere(message)
        self._called.append(asked)
        self.wake()
        return asked.future

    def wake(self) -> None:
        """Has the `poll` that waits, or the next one, return at once; from any thread."""
        self._woken.set()

    def poll(self, timeout: float) -> None:
        """Hands over all that has come, and waits for something to come, or for `wake`, at most so long."""
        self._woken.wait(timeout)
        self._woken.clear()
        self._take_calls()

    def close(self) -> None:
        """Ends all connections."""

    def _take_calls(self) -> None:
        while self._called:
            self._take(self._called.popleft())


def stopped(error: BaseException) -> ServiceStoppedError:
    """The error that a caller gets for a failure."""
    return ServiceStoppedError(f"the service has stopped: {error!r}")
