# SPDX-License-Identifier: Apache-2.0
"""A connection that outlives its service."""

from __future__ import annotations

from concurrent.futures import Future
from typing import Any

import pytest

from accerl_lerobot.transport import connection
from accerl_lerobot.transport.connection import ReconnectingClient, ServiceStoppedError
from tests.transport.played import PlayedClient


class Service:
    """Answers when the test says so; may be away, or die while it is asked."""

    def __init__(self) -> None:
        self.held: list[tuple[str, Future[Any]]] = []
        self.state = "there"

    def become(self, state: str) -> None:
        self.state = state
        if state != "there":
            for _, future in self.held:
                future.set_exception(ServiceStoppedError("the service has stopped"))
            self.held.clear()

    def connect(self, timeout_s: float = 0.0) -> Any:
        if self.state == "away":
            raise ServiceStoppedError("nobody listens there")
        return PlayedClient("inference", self._take)

    def answer(self, number: int = 0) -> None:
        message, future = self.held.pop(number)
        future.set_result(f"answer to {message}")

    def _take(self, message: str) -> Future[Any]:
        if self.state == "dying":
            raise ServiceStoppedError("it dies")
        self.held.append((message, Future()))
        return self.held[-1][1]


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "RETRY_S", 0.0)


@pytest.mark.parametrize("lost", ["away", "dying"])
def test_what_was_not_answered_is_asked_again_in_order_and_under_the_same_ticket(lost: str):
    service = Service()
    client = ReconnectingClient(service)
    a, b, c = (client.send(name) for name in "abc")
    service.answer(1)
    assert client.done(60.0) == [(b, "answer to b")]
    service.become(lost)
    assert client.done(0.0) == []
    d = client.send("d")  # while nobody is there
    assert client.done(0.0) == [] and not service.held
    service.become("there")
    assert client.done(0.0) == [] and [message for message, _ in service.held] == ["a", "c", "d"]
    for _ in range(3):
        service.answer()
    assert sorted(client.done(60.0)) == [(a, "answer to a"), (c, "answer to c"), (d, "answer to d")]


def test_a_service_that_was_away_at_first_is_asked_when_it_is_there():
    service = Service()
    service.become("away")
    client = ReconnectingClient(service)
    ticket = client.send("early")
    assert client.done(0.0) == []
    service.become("there")
    client.done(0.0)
    service.answer()
    assert client.done(60.0) == [(ticket, "answer to early")]
