# SPDX-License-Identifier: Apache-2.0
"""The trainer's publisher: shared memory to readers on this machine, Ray's object store to all others."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import ray
from ray.exceptions import ActorDiedError, GetTimeoutError, RayError, RayTaskError

from accerl_lerobot.transport.endpoint import Transport, uses_shared_memory
from accerl_lerobot.weights.publisher import FLUSH_S, Publisher, WeightBuffer, wall_clock
from accerl_lerobot.weights.shared_memory import SharedMemoryPublisher

logger = logging.getLogger(__name__)

CONNECT_S = 60.0
"""Timeout for readers to say whether they can map the trainer's memory."""
_POLL_S = 0.02
"""How long the thread waits for a reader before it looks for something newer."""


class WeightPublisher:
    """One or two publishers with readers of their own, as one. Each copies a set for itself."""

    def __init__(self, *parts: Publisher) -> None:
        self.parts = parts

    def publish(self, version: int, tensors: Mapping[str, Any]) -> None:
        """See `Publisher.publish`."""
        for part in self.parts:
            part.publish(version, tensors)

    def flush(self, timeout_s: float = FLUSH_S) -> None:
        """See `Publisher.flush`."""
        deadline = time.monotonic() + timeout_s
        for part in self.parts:
            part.flush(max(0.0, deadline - time.monotonic()))

    def add(self, reader: Any) -> None:
        """Send to another reader, an actor handle, from the newest set on."""
        for part in self.parts:
            if isinstance(part, RayPublisher):
                part.add(reader)
                return
            if isinstance(part, SharedMemoryPublisher) and _connect(part, [reader]) == [True]:
                return
        raise RuntimeError("a restarted worker cannot reach the trainer's memory")

    def close(self) -> None:
        """See `Publisher.close`."""
        for part in self.parts:
            part.close()


def make_publisher(readers: Sequence[Any], transport: Transport = "auto") -> WeightPublisher:
    """Connect readers to a publisher.

    Args:
        readers: actor handles with ``receive_weights(version, tensors, published_s)`` and
            ``open_weights(address)``, as `InferenceWorker` has them.
        transport: ray, or auto: shared memory to readers on this machine.
    """
    if uses_shared_memory(transport):
        publisher = SharedMemoryPublisher(len(readers))
        try:
            near = _connect(publisher, readers)
        except BaseException:
            publisher.close()
            raise
        if all(near):
            return WeightPublisher(publisher)
        if any(near):
            publisher.expect(sum(near))
            far = [reader for reader, here in zip(readers, near, strict=True) if not here]
            return WeightPublisher(publisher, RayPublisher(far))
        publisher.close()
    return WeightPublisher(RayPublisher(readers))


def _connect(publisher: SharedMemoryPublisher, readers: Sequence[Any]) -> list[bool]:
    """Tell readers where to connect; True for each that could."""
    answers = [reader.open_weights.remote(publisher.address) for reader in readers]
    try:
        return [bool(ray.get(answer, timeout=CONNECT_S)) for answer in answers]
    except GetTimeoutError as error:
        raise TimeoutError(f"a reader has not answered `open_weights` within {CONNECT_S:g} s") from error


@dataclass(eq=False)
class _Reader:
    """A reader as the publisher sees it."""

    number: int
    handle: Any
    under_way: Any = None
    """Reference of the call that brings it a set."""
    sent: int | None = None
    """Version of the last one."""


class RayPublisher(Publisher):
    """Puts one copy into Ray's object store and sends each reader a reference.

    Args:
        readers: actor handles with a ``receive_weights(version, tensors, published_s)`` method; the last one
            is on the clock of `wall_clock`, since monotonic clocks are a machine's own.
    """

    def __init__(self, readers: Sequence[Any]) -> None:
        super().__init__(WeightBuffer)
        self._readers = [_Reader(number, handle) for number, handle in enumerate(readers)]
        self._count = len(self._readers)
        self._stored: tuple[int, Any, float] | None = None
        self._thread.start()

    def add(self, reader: Any) -> None:
        """Send to another reader, from the newest set on."""
        self._check()
        with self._changed:
            self._readers.append(_Reader(self._count, reader))
            self._count += 1
            self._wake()

    def _wake(self) -> None:
        self._changed.notify_all()

    def _wait_for_work(self) -> bool:
        """Wait for a set, or until a reader needs attention; False: the publisher is closing."""
        with self._changed:
            self._changed.wait_for(lambda: self._closing or self._pending is not None or self._busy())
            return not self._closing

    def _serve(self) -> None:
        while self._wait_for_work():
            update = self._take()
            if update is not None:
                tensors = update.buffer.views(update.layout)
                self._stored = (update.version, ray.put(tensors), wall_clock(update.published_s))
                with self._changed:
                    self._current = None  # the store has a copy
            waiting = [reader.under_way for reader in self._readers if reader.under_way is not None]
            if waiting and update is None:
                ray.wait(waiting, timeout=_POLL_S)
            for reader in list(self._readers):
                try:
                    self._advance(reader)
                except RayTaskError:
                    raise
                except RayError as error:
                    self._drop(reader, error)

    def _advance(self, reader: _Reader) -> None:
        """Send a reader the newest set if it is free and has another one."""
        if reader.under_way is not None:
            done, _ = ray.wait([reader.under_way], timeout=0)
            if not done:
                return
            ray.get(done[0])
        if self._stored is None:
            return
        version, stored, published_s = self._stored
        sent = None
        if reader.sent != version:
            sent = reader.handle.receive_weights.remote(version, stored, published_s)
        with self._changed:
            reader.under_way, reader.sent = sent, version
            self._changed.notify_all()

    def _drop(self, reader: Any, error: Exception) -> None:
        """Forget a reader that has died. One that lives and cannot be reached is ended, to be replaced."""
        with self._changed:
            self._readers.remove(reader)
            self._changed.notify_all()
        logger.warning("reader %d of the weights has gone: %s", reader.number, error)
        if not isinstance(error, ActorDiedError):
            ray.kill(reader.handle)

    def _busy(self) -> bool:
        return any(r.under_way is not None for r in self._readers) or (
            self._stored is not None and any(r.sent is None for r in self._readers)
        )

    def _missing(self) -> str:
        late = [
            str(reader.number)
            for reader in self._readers
            if self._version is not None and (reader.sent != self._version or reader.under_way is not None)
        ]
        return f"not received by readers {', '.join(late)}" if late else ""
