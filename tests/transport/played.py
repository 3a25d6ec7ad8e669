# SPDX-License-Identifier: Apache-2.0
"""A service that a test plays, so that a worker's loop runs in the test's own process."""

from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import Any

from accerl_lerobot.transport import Endpoint


class PlayedClient:
    """Replies are what a function returns, or what is put into a future that it returns."""

    def __init__(self, name: str, answer: Callable[[Any], Any]) -> None:
        self.name = name
        self._answer = answer
        self._under_way: dict[int, Future[Any]] = {}
        self._sent = 0

    def send(self, message: Any, ticket: int | None = None) -> int:
        answer = self._answer(message)
        if not isinstance(answer, Future):
            future: Future[Any] = Future()
            future.set_result(answer)
            answer = future
        self._sent += 1
        ticket = self._sent if ticket is None else ticket
        self._under_way[ticket] = answer
        return ticket

    def done(self, timeout: float) -> list[tuple[int, Any]]:
        wait(self._under_way.values(), timeout=timeout, return_when=FIRST_COMPLETED)
        done = [ticket for ticket, future in self._under_way.items() if future.done()]
        return [(ticket, self._under_way.pop(ticket).result()) for ticket in done]

    def close(self) -> None:
        self._under_way.clear()


class PlayedEndpoint(Endpoint):
    """Leads to a function of the test."""

    def connect(self, timeout_s: float = 0.0) -> Any:
        return PlayedClient(self.name, self.actor)


def played(answer: Callable[[Any], Any]) -> Endpoint:
    """An endpoint at which `answer` replies."""
    return PlayedEndpoint(name="played", actor=answer)
