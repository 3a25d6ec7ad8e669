# SPDX-License-Identifier: Apache-2.0
"""Services of a run as their clients see them: by Ray's handle, which outlives the process behind it."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from typing import Any

from accerl_lerobot.transport.connection import Client, ServiceStoppedError

logger = logging.getLogger(__name__)

CONNECT_S = 60.0  # timeout for a service to say where it is reached
RETRY_S = 1.0  # the same, and the pause between two attempts, where a service was lost


@dataclass(frozen=True, kw_only=True)
class Endpoint:
    """A service of a worker, whose ``listen`` says where it is reached now."""

    name: str
    actor: Any = None  # Ray's handle of its process, and of the next one if that is restarted

    def connect(self, timeout_s: float = CONNECT_S) -> Client:
        """A new connection. A `ServiceStoppedError` if the service does not answer in time."""
        import ray

        try:
            address = ray.get(self.actor.listen.remote(), timeout=timeout_s)
        except ray.exceptions.RayError as error:
            raise ServiceStoppedError(f"{self.name}: {error}") from error
        return Client(self.name, address)


def node_address(in_cluster: bool) -> str | None:
    """This node's address if workers of other nodes are to reach services here; None: they need not."""
    if not in_cluster:
        return None
    import ray

    return str(ray.util.get_node_ip_address())


class ReconnectingClient:
    """Connects again to a service that was lost, or to its successor, and asks what has not been answered.

    For services without a state of their own: a request for a decision carries its noise, and the decision
    the version of its weights. While the service is away no replies come and nothing fails. Messages must not
    change until they are answered.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._endpoint: Endpoint | None = None
        self._client: Client | None = None
        self._retry_at = 0.0
        self._messages: dict[int, Any] = {}  # not answered yet, by ticket
        self._tickets: dict[int, int] = {}  # ticket of the connection → ticket here
        self._sent = 0

    def move(self, endpoint: Endpoint) -> None:
        """Ask this service from now on."""
        self._drop()
        self._endpoint, self._retry_at = endpoint, 0.0

    def send(self, message: Any) -> int:
        self._reconnect()
        self._sent += 1
        self._messages[self._sent] = message
        self._pass_on(self._sent)
        return self._sent

    def done(self, timeout: float) -> list[tuple[int, Any]]:
        self._reconnect()
        if self._client is None:
            time.sleep(min(timeout, RETRY_S / 10))
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

    def ask(self, messages: list[Any], timeout: float) -> list[Any]:
        """Send messages and wait for all replies; nothing else may be under way."""
        tickets = [self.send(message) for message in messages]
        replies: dict[int, Any] = {}
        deadline = time.monotonic() + timeout
        while len(replies) < len(tickets):
            left = deadline - time.monotonic()
            if left <= 0:
                missing = f"{len(tickets) - len(replies)} of {len(tickets)} replies"
                raise TimeoutError(f"{self.name}: {missing} did not come within {timeout:g} s")
            replies |= self.done(left)
        return [replies[ticket] for ticket in tickets]

    def close(self) -> None:
        self._messages.clear()
        self._drop()

    def _reconnect(self) -> None:
        """Connect where the service is now, unless that was tried a moment ago, and ask again."""
        if self._client is not None or self._endpoint is None or time.monotonic() < self._retry_at:
            return
        try:
            self._client = self._endpoint.connect(RETRY_S)
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
