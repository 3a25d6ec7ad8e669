# SPDX-License-Identifier: Apache-2.0
"""Connections to a service: which transport leads there, Ray's, and one that outlives the service."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

from accerl_lerobot.transport.contract import Client, ServiceStoppedError
from accerl_lerobot.transport.shared_memory import Address, SharedMemoryClient, available, this_node

logger = logging.getLogger(__name__)

LAST_WORDS_S = 2.0  # from noticing that a service is lost to ending its process
RETRY_S = 1.0  # between two attempts to connect to a service that was lost


@dataclass(frozen=True, kw_only=True)
class Endpoint:
    """Address of a service, which a worker needs in order to call it."""

    name: str
    method: Any  # method of its Ray actor handle
    address: Address | None = None  # address of its shared memory; None: it can only be reached through Ray
    actor: Any = None  # Ray's handle of its process

    def kill(self) -> None:
        """End its process, after `LAST_WORDS_S`: one that has failed tells the engine why before that."""
        timer = threading.Timer(LAST_WORDS_S, self._kill)
        timer.daemon = True
        timer.start()

    def _kill(self) -> None:
        import ray

        if ray.is_initialized():  # or it would start a new one
            ray.kill(self.actor)

    def connect(self) -> Client:
        if self.address is not None and available() and self.address.node == this_node():
            return SharedMemoryClient(self.name, self.address)
        return RayClient(self.name, self.method)


class RayClient(Client):
    """Calls an actor's method, by value: from any node to any other."""

    def __init__(self, name: str, method: Any) -> None:
        super().__init__(name)
        import ray

        self._ray, self._method = ray, method
        self._tickets: dict[Any, int] = {}  # by reference
        self._sent = 0

    def send(self, message: Any) -> int:
        self._sent += 1
        try:
            self._tickets[self._method.remote(message)] = self._sent
        except self._ray.exceptions.RayError as error:
            raise ServiceStoppedError(f"{self.name}: {error}") from error
        return self._sent

    def done(self, timeout: float) -> list[tuple[int, Any]]:
        references = list(self._tickets)
        if not references:
            time.sleep(timeout)
            return []
        ready, others = self._ray.wait(references, timeout=timeout)
        if ready and others:
            ready += self._ray.wait(others, num_returns=len(others), timeout=0)[0]
        try:
            return [(self._tickets.pop(reference), self._ray.get(reference)) for reference in ready]
        except self._ray.exceptions.RayError as error:
            raise ServiceStoppedError(f"{self.name}: {error}") from error

    def close(self) -> None:
        self._tickets.clear()


class ReconnectingClient(Client):
    """Connects again to a service that was lost, or to its successor, and asks what has not been answered.

    For services without a state of their own: a request for a decision carries its noise, and the decision
    the version of its weights. While the service is away no replies come and nothing fails; the engine
    restarts it and says where it is. Messages must not change until they are answered.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._next: deque[Endpoint] = deque(maxlen=1)
        self._moved = threading.Event()
        self._endpoint: Endpoint | None = None
        self._retry_at = 0.0
        self._client: Client | None = None
        self._messages: dict[int, Any] = {}  # not answered yet, by ticket
        self._tickets: dict[int, int] = {}  # ticket of the connection → ticket here
        self._sent = 0

    def move(self, endpoint: Endpoint) -> None:
        self._next.append(endpoint)
        self._moved.set()

    def send(self, message: Any) -> int:
        self._follow()
        self._sent += 1
        self._messages[self._sent] = message
        self._pass_on(self._sent)
        return self._sent

    def done(self, timeout: float) -> list[tuple[int, Any]]:
        self._follow()
        if self._client is None:
            self._moved.wait(min(timeout, RETRY_S))
            self._moved.clear()
            return []
        try:
            replies = self._client.done(timeout)
        except ServiceStoppedError as error:
            self._lose(error)
            return []
        answered = [(self._tickets.pop(ticket), reply) for ticket, reply in replies]
        for ticket, _ in answered:
            del self._messages[ticket]
        return answered

    def close(self) -> None:
        self._messages.clear()
        self._drop()

    def _follow(self) -> None:
        """Connect to where the service is now, or once more to where it was, and ask again."""
        if self._next:
            self._drop()
            self._endpoint = self._next.popleft()
        elif self._client is not None or self._endpoint is None or time.monotonic() < self._retry_at:
            return
        try:
            self._client = self._endpoint.connect()
        except ServiceStoppedError as error:
            self._lose(error)
        for ticket in list(self._messages):
            self._pass_on(ticket)

    def _pass_on(self, ticket: int) -> None:
        if self._client is not None:
            try:
                self._tickets[self._client.send(self._messages[ticket])] = ticket
            except ServiceStoppedError as error:
                self._lose(error)

    def _lose(self, error: ServiceStoppedError) -> None:
        logger.info("%s", error)
        self._retry_at = time.monotonic() + RETRY_S
        self._drop()

    def _drop(self) -> None:
        client, self._client = self._client, None
        self._tickets.clear()
        if client is not None:
            client.close()
