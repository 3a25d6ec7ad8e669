# SPDX-License-Identifier: Apache-2.0
"""Weights from the trainer to inference workers through Ray's object store.

One copy is put into the store, each reader gets a reference, and at most one set per reader is under way: a
reader that is slow skips versions instead of queueing them. The trainer waits for its own copy and neither
for the store nor for a reader. One that dies is let go of, and one that comes later gets the newest set.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import ray
from ray.exceptions import ActorDiedError, GetTimeoutError, RayError, RayTaskError

from accerl_lerobot.weights.channel import wall_clock
from accerl_lerobot.weights.publisher import Publisher
from accerl_lerobot.weights.slab import Slab

logger = logging.getLogger(__name__)

_POLL_S = 0.02
"""How long the thread waits for a reader before it looks for something newer."""


@dataclass(eq=False)
class _Reader:
    """One of them as the publisher sees it."""

    number: int
    handle: Any
    under_way: Any = None
    """Reference of the call that brings it a set."""
    sent: int | None = None
    """Version of the last one."""


class RayPublisher(Publisher):
    """The trainer's end; the readers' end is `InferenceWorker.receive_weights`.

    Args:
        readers: actor handles with a ``receive_weights(version, tensors, published_s)`` method; the last one
            is on the clock of `channel.wall_clock`, since monotonic clocks are a machine's own.
    """

    def __init__(self, readers: Sequence[Any]) -> None:
        super().__init__(2, Slab)  # one is put into the store while the next is written
        self._readers = [_Reader(number, handle) for number, handle in enumerate(readers)]
        self._came = len(self._readers)
        self._stored: tuple[int, Any, float] | None = None
        self._thread.start()

    def add(self, reader: Any) -> None:
        """See `Publisher.add`."""
        self._check()
        with self._changed:
            self._readers.append(_Reader(self._came, reader))
            self._came += 1
            self._wake()

    def _wait_for_work(self) -> bool:
        """Waits for a set, or until there are readers to look after; False: it is over."""
        with self._changed:
            self._changed.wait_for(lambda: self._closing or self._pending is not None or self._busy())
            return not self._closing

    def _wake(self) -> None:
        self._changed.notify_all()

    def _let_go(self, reader: Any, error: Exception) -> None:
        """Forgets a reader that has died. One that lives and cannot be reached is ended: another takes its
        place."""
        with self._changed:
            self._readers.remove(reader)
            self._changed.notify_all()
        logger.warning("reader %d of the weights has gone: %s", reader.number, error)
        if not isinstance(error, ActorDiedError):
            ray.kill(reader.handle)

    def _serve(self) -> None:
        while self._wait_for_work():
            shipment = self._take()
            if shipment is not None:
                tensors = shipment.slab.views(shipment.layout)
                self._stored = (shipment.version, ray.put(tensors), wall_clock(shipment.published_s))
                self._spare()
                with self._changed:
                    self._current = None  # the store has a copy
            waiting = [reader.under_way for reader in self._readers if reader.under_way is not None]
            if waiting and shipment is None:
                ray.wait(waiting, timeout=_POLL_S)
            for reader in list(self._readers):
                try:
                    self._advance(reader)
                except RayTaskError:
                    raise
                except RayError as error:
                    self._let_go(reader, error)

    def _advance(self, reader: _Reader) -> None:
        """Hears from a reader, and sends it the newest set if it is free and has another one.

        Raises:
            RayError: it has died or cannot be reached, or, a RayTaskError, what it has raised.
        """
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

    def _busy(self) -> bool:
        return any(r.under_way is not None for r in self._readers) or (
            self._stored is not None and any(r.sent is None for r in self._readers)
        )

    def _owed(self) -> str:
        late = [
            str(reader.number)
            for reader in self._readers
            if self._version is not None and (reader.sent != self._version or reader.under_way is not None)
        ]
        return f"not received by readers {', '.join(late)}" if late else ""


def answered(answer: Any, method: str, timeout_s: float) -> Any:
    """Waits for a reader's answer.

    Raises:
        TimeoutError: names the question that was not answered.
    """
    try:
        return ray.get(answer, timeout=timeout_s)
    except GetTimeoutError as error:
        raise TimeoutError(f"a reader has not answered `{method}` within {timeout_s:g} s") from error
