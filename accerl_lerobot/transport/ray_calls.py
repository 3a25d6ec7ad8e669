# SPDX-License-Identifier: Apache-2.0
"""Messages through Ray, by value: from any node to any other."""

from __future__ import annotations

import time
from typing import Any

import ray
from ray.exceptions import RayError

from accerl_lerobot.transport.contract import Caller, ServiceStoppedError


class RayCaller(Caller):
    """Calls a method of an actor.

    Args:
        name: of the service, for messages.
        method: of its handle; takes one message and returns the reply.
    """

    def __init__(self, name: str, method: Any) -> None:
        super().__init__(name)
        self._method = method
        self._tickets: dict[Any, int] = {}
        """Reference → ticket."""
        self._sent = 0

    def send(self, message: Any) -> int:
        self._sent += 1
        try:
            self._tickets[self._method.remote(message)] = self._sent
        except RayError as error:
            raise self._stopped(error) from error
        return self._sent

    def done(self, timeout: float) -> list[tuple[int, Any]]:
        references = list(self._tickets)
        if not references:
            time.sleep(timeout)
            return []
        ready, others = ray.wait(references, timeout=timeout)
        if ready and others:
            ready += ray.wait(others, num_returns=len(others), timeout=0)[0]
        try:
            return [(self._tickets.pop(reference), ray.get(reference)) for reference in ready]
        except RayError as error:
            raise self._stopped(error) from error

    def forget(self, ticket: int) -> None:
        self._tickets = {reference: t for reference, t in self._tickets.items() if t != ticket}

    def close(self) -> None:
        self._tickets.clear()

    def _stopped(self, error: Exception) -> ServiceStoppedError:
        return ServiceStoppedError(f"{self.name}: {error}")
