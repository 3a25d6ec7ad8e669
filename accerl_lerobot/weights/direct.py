# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Weights from the trainer straight to each reader, by gloo between hosts or by NCCL between GPUs.

    trainer ──copies──► slab ──Ray: what comes──► reader makes room
                             ──pair: the bytes, then their digest──► compares, applies
            ◄── Ray: the call returns, and the slab is free ──

For readers with a GPU of their own, or on other machines. Ray says what comes and hears of the dead; the
bytes go by a pair, see there. At most one set per reader is under way, as with every transport.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import ray
import torch
from ray.exceptions import GetTimeoutError, RayActorError

from accerl_lerobot.errors import InputError
from accerl_lerobot.transport.meeting import LOOPBACK, Meeting, host, only_at, visit
from accerl_lerobot.weights.channel import WAY, monotonic_clock, wall_clock
from accerl_lerobot.weights.device_slab import DeviceSlab, digest_of
from accerl_lerobot.weights.pair import PUBLISHES, READS, Backend, Pair, Place, place_of
from accerl_lerobot.weights.publisher import FLUSH_S, Publisher, Shipment
from accerl_lerobot.weights.reader import Received
from accerl_lerobot.weights.slab import Layout, Slab, TornSetError

logger = logging.getLogger(__name__)

MEET_S = 60.0
"""How long the two ends of a pair may take to come."""
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
    sending: list[object] = field(default_factory=list)
    """What `Pair.send` wants kept."""
    applied: int | None = None


class DirectPublisher(Publisher):
    """The trainer's end; `DirectReader` is the other one.

    Args:
        readers: actor handles with ``weights_place()``, ``meet_publisher(meeting, backend)`` and
            ``receive_directly(coming)``.
        backend: see `Pair`.
        device: where slabs are; None: in the host's memory.

    Raises:
        InputError: NCCL, and a reader has no GPU of its own.
        RuntimeError: a reader and the trainer do not reach each other.
        TimeoutError: a reader does not answer.
        ray.exceptions.RayError: a reader has died.
    """

    def __init__(self, readers: Sequence[Any], backend: Backend, device: torch.device | None = None) -> None:
        make = Slab if device is None else lambda size: DeviceSlab(size, device)
        super().__init__(len(readers) + 2, make)
        self.on_device = device is not None
        self._backend, self._came = backend, 0
        self._here = place_of(device or torch.device("cpu"))
        self._one_at_a_time = threading.Lock()
        self._readers: list[_Reader] = []
        for reader in readers:
            self._readers.append(self._meet(reader))
        self._thread.start()

    def add(self, reader: Any) -> None:
        """Has another one receive what is published, from the newest set on; raises as the class does."""
        with self._one_at_a_time:  # which interface a pair uses is the process's
            met = self._meet(reader)
        with self._changed:
            self._readers.append(met)
            # One that takes the place of another may be here before that one is seen to have gone.
            self._limit = max(self._limit, len(self._readers) + 2)
            self._wake()

    def _meet(self, handle: Any) -> _Reader:
        there = Place(*_answered(handle.weights_place.remote(), "weights_place"))
        if self._backend == "nccl" and there.device in ("cpu", self._here.device):
            whose = "the CPU" if there.device == "cpu" else "the trainer's GPU"
            found = f"an inference worker has its policy on {whose}, and NCCL wants a GPU for each"
            raise InputError(WAY, self._backend, f"{found}; use auto or gloo")
        address = LOOPBACK if there.node == self._here.node else ray.util.get_node_ip_address()
        only_at(address)
        store, meeting = host(address, 2, MEET_S)
        answer = handle.meet_publisher.remote(meeting, self._backend)
        try:
            pair = Pair(store, PUBLISHES, self._backend, meet_s=MEET_S, timeout_s=FLUSH_S)
        except RuntimeError:
            _answered(answer, "meet_publisher")  # what the other end has to say of it, if it has
            raise
        _answered(answer, "meet_publisher")
        number, self._came = self._came, self._came + 1
        return _Reader(number, handle, pair)

    def _serve(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing or self._pending is not None or self._busy())
                if self._closing:
                    return
            shipment = self._take()
            if shipment is not None:
                self._send_newest()  # readers reckon the digest while it is reckoned here
                layout = shipment.layout
                shipment.digest = digest_of(shipment.version, layout, shipment.slab.memory[: layout.size])
                for reader in self._readers:
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
                if shipment.digest:
                    self._confirm(reader, shipment)

    def _announce(self, reader: _Reader, shipment: Shipment) -> None:
        coming = Coming(shipment.version, wall_clock(shipment.published_s), shipment.layout.text)
        with self._changed:
            reader.holds = shipment
            reader.under_way = reader.handle.receive_directly.remote(coming)
        self._send(reader, shipment.slab.memory[: _sent(shipment.layout)])

    def _confirm(self, reader: _Reader, shipment: Shipment) -> None:
        memory = torch.frombuffer(bytearray(shipment.digest), dtype=torch.uint8)
        self._send(reader, memory.to(shipment.slab.memory.device) if self.on_device else memory)

    def _send(self, reader: _Reader, memory: Any) -> None:
        with suppress(RuntimeError):  # the other end is gone, or has let go of the pair: the call says which
            reader.sending.append(reader.pair.send(memory))

    def _hear(self, reader: _Reader) -> None:
        if reader.under_way is None or not ray.wait([reader.under_way], timeout=0)[0]:
            return
        try:
            applied = ray.get(reader.under_way)
        except RayActorError:
            self._let_go(reader)
            return
        with self._changed:
            reader.applied, reader.under_way, reader.holds = applied, None, None
            reader.sending.clear()
            self._changed.notify_all()

    def _let_go(self, reader: _Reader) -> None:
        with self._changed:
            self._readers.remove(reader)
            self._changed.notify_all()
        logger.warning("reader %d of the weights has gone", reader.number)

    def _busy(self) -> bool:
        """Whether a reader has been sent something, or has come and is owed the newest set."""
        return any(r.under_way is not None for r in self._readers) or (
            self._current is not None and any(r.applied is None for r in self._readers)
        )

    def _wake(self) -> None:
        self._changed.notify_all()

    def _held(self) -> list[Any]:
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
        backend: see `Pair`.
        device: where sets are to be; None: in the host's memory.
        deliver: called with each set; the next one comes once it is let go of.

    Raises:
        RuntimeError: the publisher is not there.
    """

    def __init__(
        self,
        meeting: Meeting,
        backend: Backend,
        device: torch.device | None,
        deliver: Callable[[Received], object],
    ) -> None:
        self._device, self._deliver = device, deliver
        self._slab: Slab | DeviceSlab | None = None
        only_at(LOOPBACK if meeting.address == LOOPBACK else ray.util.get_node_ip_address())
        store = visit(meeting, 2, MEET_S)
        self._pair = Pair(store, READS, backend, meet_s=MEET_S, timeout_s=FLUSH_S)

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

        received = await asyncio.to_thread(self.take, coming, release)
        self._deliver(received)
        await applied
        return coming.version

    def take(self, coming: Coming, release: Callable[[], None]) -> Received:
        """Waits for the bytes of a set and checks them; see `receive`."""
        layout = Layout.read(coming.layout)
        size = _sent(layout)
        if self._slab is None or len(self._slab) < size:
            self._slab = Slab(size) if self._device is None else DeviceSlab(size, self._device)
        memory = self._slab.memory
        self._pair.receive(memory[:size])
        published: Any = np.empty(_DIGEST, np.uint8)
        if self._device is not None:
            published = torch.from_numpy(published).to(self._device)
        self._pair.receive(published)
        if digest_of(coming.version, layout, memory[: layout.size]) != bytes(published.tolist()):
            raise TornSetError(f"weights of version {coming.version} are not what their digest says")
        tensors: dict[str, Any] = dict(self._slab.views(layout))
        for tensor in tensors.values():
            if isinstance(tensor, np.ndarray):
                tensor.flags.writeable = False
        return Received(
            version=coming.version,
            tensors=tensors,
            published_s=monotonic_clock(coming.published_s),
            release=release,
            nbytes=layout.size,
        )


def _sent(layout: Layout) -> int:
    """Bytes of a set on its way; some, even if it is empty."""
    return max(layout.size, 8)


def _answered(answer: Any, method: str) -> Any:
    try:
        return ray.get(answer, timeout=MEET_S)
    except GetTimeoutError as error:
        raise TimeoutError(f"a reader has not answered `{method}` within {MEET_S:g} s") from error
