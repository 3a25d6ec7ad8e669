# SPDX-License-Identifier: Apache-2.0
"""A connection that outlives its service."""

from __future__ import annotations

from concurrent.futures import Future
from typing import Any

import pytest

from accerl_lerobot.transport import endpoint
from accerl_lerobot.transport.connection import Endpoint, ReconnectingClient, ServiceStoppedError
from tests.transport.played import played


class Service:
    """Answers what the test says, when it says so, until it is stopped."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.held: list[tuple[str, Future[Any]]] = []
        self.endpoint = played(self._take)

    def _take(self, message: str) -> Future[Any]:
        self.held.append((message, Future()))
        return self.held[-1][1]

    def answer(self, number: int = 0) -> None:
        message, future = self.held.pop(number)
        future.set_result(f"{self.name} {message}")

    def stop(self) -> None:
        for _, future in self.held:
            future.set_exception(ServiceStoppedError("the service has stopped"))


class Nowhere(Endpoint):
    def connect(self, timeout_s: float = 0.0) -> Any:
        raise ServiceStoppedError("nobody listens there")


def connected(service: Service) -> ReconnectingClient:
    caller = ReconnectingClient("inference")
    caller.move(service.endpoint)
    return caller


def test_what_was_not_answered_is_asked_of_the_next_in_order_and_under_the_same_ticket():
    first, second = Service("first"), Service("second")
    caller = connected(first)
    a, b, c = (caller.send(name) for name in "abc")
    first.answer(1)
    assert caller.done(60.0) == [(b, "first b")]
    first.stop()
    assert caller.done(0.0) == []
    d = caller.send("d")  # while nobody is there
    assert caller.done(0.01) == []
    caller.move(second.endpoint)
    assert caller.done(0.0) == [] and [message for message, _ in second.held] == ["a", "c", "d"]
    for _ in range(3):
        second.answer()
    assert sorted(caller.done(60.0)) == [(a, "second a"), (c, "second c"), (d, "second d")]


def test_a_service_that_dies_while_it_is_asked_and_one_that_is_gone_when_it_is_connected_to():
    caller = ReconnectingClient("inference")
    ticket = caller.send("early")
    caller.move(Nowhere(name="nowhere"))
    assert caller.done(0.0) == []

    def refuse(message: str) -> Any:
        raise ServiceStoppedError("it dies")

    caller.move(played(refuse))
    assert caller.done(0.0) == []
    last = Service("last")
    caller.move(last.endpoint)
    caller.done(0.0)
    last.answer()
    assert caller.done(60.0) == [(ticket, "last early")]


def test_a_connection_that_was_lost_is_made_again_though_nobody_says_where(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(endpoint, "RETRY_S", 0.05)
    service = Service("only")
    caller = connected(service)
    ticket = caller.send("question")
    service.stop()
    assert caller.done(0.0) == []
    service.held.clear()
    while not service.held:
        assert caller.done(0.0) == []
    service.answer()
    assert caller.done(60.0) == [(ticket, "only question")]
