# SPDX-License-Identifier: Apache-2.0
"""A connection that outlives its service."""

from __future__ import annotations

import threading
import time
from concurrent.futures import Future
from typing import Any

from accerl_lerobot.transport.contract import ServiceStoppedError
from accerl_lerobot.transport.endpoint import Endpoint, ReconnectingClient
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
    def connect(self) -> Any:
        raise ServiceStoppedError("nobody listens there")


def connected(service: Service) -> ReconnectingClient:
    caller = ReconnectingClient("inference")
    caller.move(service.endpoint)
    return caller


def test_what_was_not_answered_is_asked_of_the_next_in_order_and_under_the_same_ticket():
    first, second = Service("first"), Service("second")
    caller = connected(first)
    a, b, c = (caller.send(name) for name in "abc")
    assert caller.away_s == 0.0
    first.answer(1)
    assert caller.done(60.0) == [(b, "first b")]
    first.stop()
    assert caller.done(0.0) == [] and caller.away_s > 0.0 and caller.why == "the service has stopped"
    d = caller.send("d")  # while nobody is there
    assert caller.done(0.01) == []
    caller.move(second.endpoint)
    assert caller.done(0.0) == [] and [message for message, _ in second.held] == ["a", "c", "d"]
    for _ in range(3):
        second.answer()
    assert sorted(caller.done(60.0)) == [(a, "second a"), (c, "second c"), (d, "second d")]
    assert caller.away_s == 0.0


def test_a_service_that_dies_while_it_is_asked_and_one_that_is_gone_when_it_is_connected_to():
    caller = ReconnectingClient("inference")
    ticket = caller.send("early")
    caller.move(Nowhere(name="nowhere", method=None))
    assert caller.done(0.0) == [] and caller.why == "nobody listens there"

    def refuse(message: str) -> Any:
        raise ServiceStoppedError("it dies")

    caller.move(played(refuse))
    assert caller.done(0.0) == [] and caller.why == "it dies"
    last = Service("last")
    caller.move(last.endpoint)
    caller.done(0.0)
    last.answer()
    assert caller.done(60.0) == [(ticket, "last early")]


def test_a_wait_ends_when_the_service_is_there_and_how_long_it_was_away_counts_from_then():
    service = Service("only")
    caller = ReconnectingClient("inference")
    ticket = caller.send("question")
    assert caller.done(0.01) == [] and caller.away_s == 0.0, "nobody has said where it is"
    caller.move(Nowhere(name="nowhere", method=None))
    time.sleep(0.05)
    assert caller.away_s == 0.0, "nobody has looked"
    caller.done(0.0)
    time.sleep(0.3)
    assert caller.away_s >= 0.3
    threading.Timer(0.1, caller.move, (service.endpoint,)).start()
    started = time.monotonic()
    assert caller.done(600.0) == []
    assert time.monotonic() - started < 300.0 and caller.away_s == 0.0
    caller.done(0.0)
    service.answer()
    assert caller.done(60.0) == [(ticket, "only question")]
