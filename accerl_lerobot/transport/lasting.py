# SPDX-License-Identifier: Apache-2.0
"""A connection that outlives its service."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any

from accerl_lerobot.transport.contract import Caller, ServiceStoppedError
from accerl_lerobot.transport.endpoint import Endpoint


class LastingCaller(Caller):
    """Asks a service, and whoever takes its place, what the one before has not answered.

    For services whose replies depend on the message, and on what they say in them: a request for a decision
    carries its noise, and the decision the version of its weights. While there is no service, replies do not
    come, and nothing fails; who takes its place is for others to say.

    Messages must not change until they are answered.

    Example:
        >>> caller = LastingCaller("inference")
        >>> caller.move(endpoint)      # on any thread; again whenever the service is another one
        >>> ticket = caller.send([request])
        >>> caller.done(timeout=0.5)   # nothing while the service is away
        []
        >>> caller.away_s  # since it was lost
        0.5

    Args:
        name: of the service, for messages.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._next: deque[Endpoint] = deque(maxlen=1)
        self._moved = threading.Event()
        self._caller: Caller | None = None
        self._messages: dict[int, Any] = {}
        """Ticket → message that has not been answered."""
        self._tickets: dict[int, int] = {}
        """The connection's ticket → ours."""
        self._sent = 0
        self._away_since: float | None = None
        self.why = ""
        """The connection was lost last, or was not to be had."""

    def move(self, endpoint: Endpoint) -> None:
        """From now on the service is there."""
        self._next.append(endpoint)
        self._away_since = None
        self._moved.set()

    @property
    def away_s(self) -> float:
        """For how long it was not found where it was last said to be, in seconds; 0 before it is tried."""
        since = self._away_since
        return 0.0 if since is None else time.monotonic() - since

    def send(self, message: Any) -> int:
        self._follow()
        self._sent += 1
        self._messages[self._sent] = message
        if self._caller is not None:
            self._pass_on(self._sent)
        return self._sent

    def done(self, timeout: float) -> list[tuple[int, Any]]:
        self._follow()
        if self._caller is None:
            if self._moved.wait(timeout):
                self._moved.clear()
            return []
        try:
            replies = self._caller.done(timeout)
        except ServiceStoppedError as error:
            self._lose(error)
            return []
        found = [(self._tickets.pop(ticket), reply) for ticket, reply in replies]
        for ticket, _ in found:
            del self._messages[ticket]
        return found

    def forget(self, ticket: int) -> None:
        self._messages.pop(ticket, None)
        for theirs in [theirs for theirs, ours in self._tickets.items() if ours == ticket]:
            del self._tickets[theirs]
            if self._caller is not None:
                self._caller.forget(theirs)

    def close(self) -> None:
        self._messages.clear()
        self._drop()

    def _follow(self) -> None:
        """Connects to where the service is now, if that is somewhere else, and asks again."""
        if not self._next:
            return
        self._drop()
        try:
            self._caller = self._next.popleft().connect()
        except ServiceStoppedError as error:
            self._lose(error)
            return
        self._away_since = None  # what was lost meanwhile was the one before
        for ticket in list(self._messages):
            if self._caller is not None:
                self._pass_on(ticket)

    def _pass_on(self, ticket: int) -> None:
        assert self._caller is not None
        try:
            self._tickets[self._caller.send(self._messages[ticket])] = ticket
        except ServiceStoppedError as error:
            self._lose(error)

    def _lose(self, error: ServiceStoppedError) -> None:
        self.why = str(error)
        if self._away_since is None:
            self._away_since = time.monotonic()
        self._drop()

    def _drop(self) -> None:
        caller, self._caller = self._caller, None
        self._tickets.clear()
        if caller is not None:
            caller.close()
