# SPDX-License-Identifier: Apache-2.0
"""Weights from the trainer straight to readers whose memory it does not share, by gloo.

    trainer ──copies──► slab ──Ray: what comes──► reader makes room
                             ──pair: the bytes, then their digest──► compares, applies
            ◄── Ray: the call returns, and the slab is free ──

Ray says what comes and hears of the dead; the bytes go by a pair, see there, and not through object stores.
At most one set per reader is under way, as with every transport.
"""

from __future__ import annotations

import asyncio
import logging
import queue
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import ray
from ray.exceptions import RayError, RayTaskError

from accerl_lerobot.transport.meeting import LOOPBACK, Meeting, host, visit
from accerl_lerobot.weights.channel import monotonic_clock, wall_clock
from accerl_lerobot.weights.pair import PUBLISHES, READS, Pair
from accerl_lerobot.weights.publisher import Shipment
from accerl_lerobot.weights.ray_channel import CallingPublisher, answered
from accerl_lerobot.weights.reader import Received
from accerl_lerobot.weights.slab import Layout, Slab, TornSetError, digest

logger = logging.getLogger(__name__)

MEET_S = 60.0
"""How long the two ends of a pair may take to come."""
PIECE_S = 60.0
"""How long a piece of a set may take to arrive; one that was cut in the middle is noticed by that alone."""
_POLL_S = 0.02
"""How long the thread waits for a reader before it looks for something newer."""
_DIGEST = 16


class Coming(NamedTuple):
    """A set whose bytes follow."""

    version: int
    published_s: float
    """On the clock of `channel.wall_clock`."""
    layout: bytes
    """Text of it."""


@dataclass(eq=False)
class _Reader:
    """One of them as the publisher sees it."""

    number: int
    handle: Any
    pair: Pair
    under_way: Any = None
    """Reference of the call that says what comes; it returns once that is applied."""
    holds: Shipment | None = None
    applied: int | None = None


class DirectPublisher(CallingPublisher):
    """The trainer's end; `DirectReader` is the other one.

    Args:
        readers: actor handles with ``node()``, ``meet_publisher(meeting)`` and ``receive_directly(coming)``.

    Raises:
        RuntimeError: a reader and the trainer do not reach each other.
        TimeoutError: a reader does not answer.
        ray.exceptions.RayError: a reader has died.
    """

    def __init__(self, readers: Sequence[Any]) -> None:
        super().__init__(len(readers) + 2, Slab)
        self._came = 0
        self._readers = [self._meet(reader) for reader in readers]
        self._thread.start()

    def add(self, reader: Any) -> None:
        """Has another one receive what is published, from the newest set on; raises as the class does."""
        self._check()
        met = self._meet(reader)
        with self._changed:
            self._readers.append(met)
            # One that takes the place of another may be here before that one is seen to have gone.
            self._limit = max(self._limit, len(self._readers) + 2)
            self._wake()

    def close(self) -> None:
        super().close()
        for reader in self._readers:
            reader.pair.close()

    def _meet(self, handle: Any) -> _Reader:
        there = answered(handle.node.remote(), "node", MEET_S)
        here = there == str(ray.get_runtime_context().get_node_id())
        address = LOOPBACK if here else ray.util.get_node_ip_address()
        store, meeting = host(address, 2, MEET_S)
        answer = handle.meet_publisher.remote(meeting)
        pair = _paired(lambda: Pair(store, PUBLISHES, address, meet_s=MEET_S, timeout_s=PIECE_S), answer)
        answered(answer, "meet_publisher", MEET_S)
        number, self._came = self._came, self._came + 1
        return _Reader(number, handle, pair)

    def _serve(self) -> None:
        while self._wait_for_work():
            self._advance(self._take())

    def _advance(self, shipment: Shipment | None) -> None:
        """Sends what is new, or waits a moment for a reader."""
        if shipment is not None:
            self._send_newest()  # readers reckon the digest while it is reckoned here
            layout = shipment.layout
            shipment.digest = digest(shipment.version, layout, shipment.slab.memory[: layout.size])
            for reader in list(self._readers):
                if reader.holds is shipment:
                    self._confirm(reader, shipment)
            self._spare()
        else:
            ray.wait([r.under_way for r in self._readers if r.under_way is not None], timeout=_POLL_S)
        for reader in list(self._readers):
            self._hear(reader)
        self._send_newest()

    def _send_newest(self) -> None:
        """To every reader to which nothing is under way and that has not had it."""
        shipment = self._current
        if shipment is None:
            return
        for reader in list(self._readers):
            if reader.under_way is None and reader.applied != shipment.version:
                self._announce(reader, shipment)
                if shipment.digest and reader in self._readers:
                    self._confirm(reader, shipment)

    def _announce(self, reader: _Reader, shipment: Shipment) -> None:
        coming = Coming(shipment.version, wall_clock(shipment.published_s), shipment.layout.text)
        with self._changed:
            reader.holds = shipment
            reader.under_way = reader.handle.receive_directly.remote(coming)
        self._send(reader, shipment.slab.memory[: shipment.layout.size])

    def _confirm(self, reader: _Reader, shipment: Shipment) -> None:
        self._send(reader, np.frombuffer(bytearray(shipment.digest), np.uint8))

    def _send(self, reader: _Reader, memory: np.ndarray) -> None:
        try:
            reader.pair.send(memory)
        except RuntimeError as error:  # the other end is lost, whether or not its process is
            self._let_go(reader, error)

    def _hear(self, reader: _Reader) -> None:
        if reader.under_way is None or not ray.wait([reader.under_way], timeout=0)[0]:
            return
        try:
            applied = ray.get(reader.under_way)
        except RayError as error:
            if isinstance(error, RayTaskError) and isinstance(error.cause, TornSetError):
                raise
            self._let_go(reader, error)
            return
        with self._changed:
            reader.applied, reader.under_way, reader.holds = applied, None, None
            reader.pair.sent()
            self._changed.notify_all()

    def _let_go(self, reader: _Reader, error: Exception) -> None:
        super()._let_go(reader, error)
        reader.pair.close()

    def _busy(self) -> bool:
        return any(r.under_way is not None for r in self._readers) or (
            self._current is not None and any(r.applied is None for r in self._readers)
        )

    def _held(self) -> list[Slab]:
        return [reader.holds.slab for reader in self._readers if reader.holds is not None]

    def _owed(self) -> str:
        if self._version is None:
            return ""
        late = [str(reader.number) for reader in self._readers if reader.applied != self._version]
        return f"not applied by readers {', '.join(late)}" if late else ""


class DirectReader:
    """Receives what a `DirectPublisher` sends.

    Args:
        meeting: with the publisher.
        deliver: called with each set; the next one comes once it is let go of.

    Raises:
        RuntimeError: the publisher is not there.
    """

    def __init__(self, meeting: Meeting, deliver: Callable[[Received], object]) -> None:
        self._deliver = deliver
        self._slab: Slab | None = None
        address = LOOPBACK if meeting.address == LOOPBACK else ray.util.get_node_ip_address()
        self._pair = Pair(visit(meeting, 2, MEET_S), READS, address, meet_s=MEET_S, timeout_s=PIECE_S)

    async def receive(self, coming: Coming) -> int:
        """Returns the version once it is applied.

        Raises:
            TornSetError: it is not what was published; nobody has seen it.
            RuntimeError: the publisher is gone, or silent.
        """
        loop = asyncio.get_running_loop()
        applied: asyncio.Future[None] = loop.create_future()

        def release() -> None:
            loop.call_soon_threadsafe(applied.set_result, None)

        self._deliver(await asyncio.to_thread(self.take, coming, release))
        await applied
        return coming.version

    def take(self, coming: Coming, release: Callable[[], None]) -> Received:
        """Waits for the bytes of a set and checks them; see `receive`."""
        layout = Layout.read(coming.layout)
        if self._slab is None or len(self._slab) < layout.size:
            self._slab = Slab(layout.size)
        whole, published = self._slab.memory[: layout.size], np.empty(_DIGEST, np.uint8)
        self._pair.receive(whole)
        self._pair.receive(published)
        if digest(coming.version, layout, whole) != published.tobytes():
            raise TornSetError(f"weights of version {coming.version} are not what their digest says")
        tensors = layout.views(whole)
        for tensor in tensors.values():
            tensor.flags.writeable = False
        return Received(
            version=coming.version,
            tensors=tensors,
            published_s=monotonic_clock(coming.published_s),
            release=release,
            nbytes=layout.size,
        )


def _paired(make: Callable[[], Pair], answer: Any) -> Pair:
    """The pair, unless the other end says before that it will not come."""
    made: queue.SimpleQueue[Pair | Exception] = queue.SimpleQueue()

    def wait() -> None:
        try:
            made.put(make())
        except Exception as error:
            made.put(error)

    threading.Thread(target=wait, name="meeting", daemon=True).start()
    while True:
        try:
            found = made.get(timeout=_POLL_S)
        except queue.Empty:
            if ray.wait([answer], timeout=0)[0]:
                ray.get(answer)  # raises if that is so
            continue
        if isinstance(found, Exception):
            answered(answer, "meet_publisher", MEET_S)  # what the other end has to say of it, if it has
            raise found
        return found
