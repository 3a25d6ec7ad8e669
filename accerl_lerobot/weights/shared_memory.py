# SPDX-License-Identifier: Apache-2.0
"""Weights from the trainer to readers on the same machine through memory that both map.

    trainer ──copies──► slab ◄──reads── reader ──copies──► its parameters, then lets the slab go
       └── version and, once, the slab's file descriptor over a Unix socket ──┘
       └── the digest, which both have reckoned meanwhile ────────────────────┘

Socket and slabs are in no file system, see `transport.nameless`: nothing is left behind whoever is killed,
and both sides talk to processes of the same user only. A slab that a reader holds is never written to: with R
readers there are R for them, one that is being sent and one to write to. A reader that has gone is let go of:
whoever watches it knows why. One that comes later gets the newest set.
"""

from __future__ import annotations

import logging
import os
import selectors
import socket
import struct
from dataclasses import dataclass, field
from typing import NamedTuple

from accerl_lerobot.transport.memfd import listening, new_name, same_user
from accerl_lerobot.weights.publisher import Publisher, Shipment
from accerl_lerobot.weights.slab import Slab, digest

logger = logging.getLogger(__name__)

TALK_S = 10.0
"""How long a message of some hundred bytes may take."""


class Message(NamedTuple):
    """A set that lies in a slab; the slab's file descriptor comes with the first one about it."""

    slot: int
    """Slot of the slab; one that comes for a slot takes the place of the one before."""
    version: int
    published_s: float
    size: int
    text: int
    """Bytes of the layout, which follows the data."""

    def pack(self) -> bytes:
        """For the socket."""
        return FORMAT.pack(*self)

    @classmethod
    def unpack(cls, data: bytes) -> Message:
        """The inverse of `pack`."""
        return cls(*FORMAT.unpack(data))


FORMAT = struct.Struct("<QqdQQ")
CONFIRMED = struct.Struct("<q16s")
"""Trailer of every message: version, and digest of the whole set."""
APPLIED = struct.Struct("<q")
"""A reader's answer: the version that it has applied, so that it does not hold the slab any more."""


@dataclass(eq=False)
class _Reader:
    """One of them as the publisher sees it."""

    number: int
    """In the order in which they came."""
    connection: socket.socket
    known: dict[int, Slab] = field(default_factory=dict)
    """Slot → slab that it has mapped."""
    holds: Shipment | None = None
    applied: int | None = None


class SharedMemoryPublisher(Publisher):
    """The trainer's end; `SharedMemoryReader` is the other one.

    Args:
        readers: how many there will be to begin with.
    """

    def __init__(self, readers: int) -> None:
        super().__init__(readers + 2, Slab.shared)
        self._awaited = readers
        self._readers: list[_Reader] = []
        self._came = 0
        self.address = new_name()
        """Address on this machine that readers connect to."""
        self._listener = listening(self.address, readers)
        self._event = os.eventfd(0, os.EFD_CLOEXEC)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._event, selectors.EVENT_READ)
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._thread.start()

    def expect(self, readers: int) -> None:
        """So many have said that they connect, and no others will for now."""
        with self._changed:
            self._awaited = max(0, readers - self._came)

    def close(self) -> None:
        super().close()
        self._selector.close()
        for connection in (self._listener, *(reader.connection for reader in self._readers)):
            connection.close()
        if self._event >= 0:
            os.close(self._event)
            self._event = -1

    def _serve(self) -> None:
        while True:
            for key, _ in self._selector.select():
                if key.fileobj is self._listener:
                    self._accept()
                elif key.fileobj == self._event:
                    os.eventfd_read(self._event)
                    if self._closing:
                        return
                    self._begin()
                else:
                    self._hear(key.data)
            self._send_newest()

    def _accept(self) -> None:
        connection, _ = self._listener.accept()
        if not same_user(connection):
            connection.close()
            return
        connection.settimeout(TALK_S)
        with self._changed:
            reader = _Reader(self._came, connection)
            self._came, self._awaited = self._came + 1, max(0, self._awaited - 1)
            self._readers.append(reader)
            # One that takes the place of another may be here before that one is seen to have gone.
            self._limit = max(self._limit, len(self._readers) + 2)
        self._selector.register(connection, selectors.EVENT_READ, reader)

    def _let_go(self, reader: _Reader) -> None:
        """Forgets a reader that has gone, and what it held."""
        self._selector.unregister(reader.connection)
        with self._changed:
            self._readers.remove(reader)
            self._changed.notify_all()
        reader.connection.close()
        logger.warning("reader %d of the weights has gone", reader.number)

    def _begin(self) -> None:
        """Makes the newest set ready to be sent."""
        with self._changed:
            shipment = self._take()
            if shipment is None:
                return
        self._send_newest()  # readers reckon the digest while it is reckoned here
        data = shipment.slab.memory[: shipment.layout.size]
        shipment.digest = digest(shipment.version, shipment.layout, data)
        for reader in list(self._readers):
            if reader.holds is shipment:
                self._confirm(reader, shipment)
        self._spare()

    def _send_newest(self) -> None:
        """To every reader that holds nothing and has not had it."""
        shipment = self._current
        if shipment is None:
            return
        for reader in list(self._readers):
            if reader.holds is None and reader.applied != shipment.version:
                there = self._announce(reader, shipment)
                if there and shipment.digest:
                    self._confirm(reader, shipment)

    def _announce(self, reader: _Reader, shipment: Shipment) -> bool:
        """Tells a reader of a set; False if it has gone."""
        slab, layout = shipment.slab, shipment.layout
        with self._changed:
            slot = self._slabs.index(slab)
            reader.holds = shipment
        message = Message(
            slot=slot,
            version=shipment.version,
            published_s=shipment.published_s,
            size=layout.size,
            text=len(layout.text),
        )
        fds = [] if slab.fd is None or reader.known.get(slot) is slab else [slab.fd]
        try:
            socket.send_fds(reader.connection, [message.pack()], fds)
        except OSError:
            self._let_go(reader)
            return False
        reader.known[slot] = slab
        return True

    def _confirm(self, reader: _Reader, shipment: Shipment) -> None:
        try:
            reader.connection.send(CONFIRMED.pack(shipment.version, shipment.digest))
        except OSError:
            self._let_go(reader)

    def _hear(self, reader: _Reader) -> None:
        if reader not in self._readers:
            return  # let go of since the selector spoke of it
        try:
            data = reader.connection.recv(APPLIED.size)
        except OSError:
            data = b""
        if not data:
            self._let_go(reader)
            return
        with self._changed:
            (reader.applied,) = APPLIED.unpack(data)
            reader.holds = None
            self._changed.notify_all()

    def _wake(self) -> None:
        if self._event >= 0:
            os.eventfd_write(self._event, 1)

    def _held(self) -> list[Slab]:
        return [reader.holds.slab for reader in self._readers if reader.holds is not None]

    def _owed(self) -> str:
        if self._version is None:
            return ""
        late = [str(reader.number) for reader in self._readers if reader.applied != self._version]
        parts = [f"{self._awaited} readers have not connected"] if self._awaited else []
        parts += [f"not applied by readers {', '.join(late)}"] if late else []
        return "; ".join(parts)
