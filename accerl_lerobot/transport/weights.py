# SPDX-License-Identifier: Apache-2.0
"""Weights from the trainer to inference replicas: messages that are answered once they are applied.

Each set is copied once per replica, into shared memory or Ray's object store, and nobody is waited for: a
slow replica skips versions.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.transport.contract import Client, ServiceStoppedError
from accerl_lerobot.transport.endpoint import Endpoint

logger = logging.getLogger(__name__)

FLUSH_S = 300.0  # timeout for all replicas together: a forward pass and a copy of the weights
UNDER_WAY = 2  # sets on their way to a replica at most: one that it applies, and the next

Tensors = dict[str, np.ndarray]  # parameter name → array; dtype and shape arrive as they were sent


@kind
class WeightUpdate(NamedTuple):
    """All trained weights of one version."""

    version: int
    tensors: Tensors


@dataclass(eq=False)
class _Reader:
    endpoint: Endpoint
    client: Client
    under_way: set[int] = field(default_factory=set)  # tickets of sets that it has not applied yet
    sent: int | None = None  # version of the last one


class WeightPublisher:
    """Sends the newest weights to all replicas. One that fails is ended, and the engine replaces it.

    Published tensors must not change before `flush` has returned, as `resend` and `add` send them too.
    """

    def __init__(self, readers: Iterable[Endpoint] = ()) -> None:
        self._readers: list[_Reader] = []
        self._newest: WeightUpdate | None = None
        for reader in readers:
            self.add(reader)

    def add(self, endpoint: Endpoint) -> None:
        """Send to another replica, the newest set at once."""
        try:
            reader = _Reader(endpoint, endpoint.connect())
        except ServiceStoppedError as error:
            _end(endpoint, error)
            return
        if self._advance(reader):
            self._readers.append(reader)  # another thread may flush meanwhile

    def publish(self, version: int, tensors: Tensors) -> None:
        """Copy a set to every replica that has applied the one before the last."""
        self._newest = WeightUpdate(version, tensors)
        self.resend()

    def resend(self) -> None:
        """Copy the newest set to replicas that were busy when it was published."""
        for reader in list(self._readers):
            if not self._advance(reader):
                self._readers.remove(reader)

    def flush(self, timeout_s: float = FLUSH_S) -> None:
        """Wait until every replica has applied the newest set."""
        deadline = time.monotonic() + timeout_s
        while late := [reader for reader in self._readers if reader.under_way or self._is_behind(reader)]:
            if (left := deadline - time.monotonic()) <= 0:
                names = ", ".join(reader.endpoint.name for reader in late)
                raise TimeoutError(f"weights not applied within {timeout_s:g} s by {names}")
            if not self._advance(late[0], left):
                self._readers.remove(late[0])

    def close(self) -> None:
        for reader in self._readers:
            reader.client.close()
        self._readers.clear()

    def _is_behind(self, reader: _Reader) -> bool:
        return self._newest is not None and reader.sent != self._newest.version

    def _advance(self, reader: _Reader, wait_s: float = 0.0) -> bool:
        """Hear what a replica has applied, and send the newest set if there is room; False: it is gone."""
        try:
            if reader.under_way:
                reader.under_way -= {ticket for ticket, _ in reader.client.done(wait_s)}
            if self._is_behind(reader) and len(reader.under_way) < UNDER_WAY:
                assert self._newest is not None
                reader.under_way.add(reader.client.send(self._newest))
                reader.sent = self._newest.version
        except ServiceStoppedError as error:
            reader.client.close()
            _end(reader.endpoint, error)
            return False
        return True


def _end(endpoint: Endpoint, error: Exception) -> None:
    """End a replica that may be alive and out of reach: with old weights it would serve for ever."""
    logger.warning("%s does not get weights any more: %s", endpoint.name, error)
    endpoint.kill()


class PublishDelay:
    """Publishes weights some `updates` after they were made, for studies of what lag does."""

    def __init__(self, updates: int) -> None:
        self.updates = updates
        self._waiting: deque[tuple[int, Tensors]] = deque()

    def push(self, version: int, tensors: Tensors, *, last: bool = False) -> list[tuple[int, Tensors]]:
        """Take the newest weights, which must not change; return those that are due, oldest first.

        Version 0 always is due, and only the newest if no update follows (`last`).
        """
        self._waiting.append((version, tensors))
        due = []
        while self._waiting and (last or self._waiting[0][0] <= max(0, version - self.updates)):
            due.append(self._waiting.popleft())
        return due[-1:] if last else due

    def state(self) -> list[tuple[int, Tensors]]:
        return list(self._waiting)

    def restore(self, state: list[tuple[int, Tensors]]) -> None:
        self._waiting.extend(state)
