# SPDX-License-Identifier: Apache-2.0
"""Weights from the trainer to readers on the same machine, through memory that both map.

    trainer ──copies──► buffer ◄──reads── reader ──copies──► its parameters, then releases the buffer
       └── header and, once, the buffer's file descriptor over a Unix socket ──┘

Sockets and buffers have no name in a file system, see `transport.memfd`, and both ends talk to processes of
the same user only. The reader compares the digest before it uses a set. A buffer that a reader holds is never
written to. A reader that has died is dropped; the engine knows why.
"""

from __future__ import annotations

import contextlib
import logging
import os
import selectors
import socket
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from accerl_lerobot.transport.memfd import listening, new_name, new_socket, same_user
from accerl_lerobot.weights.publisher import (
    BufferLayout,
    Publisher,
    Tensors,
    TornSetError,
    WeightBuffer,
    WeightUpdate,
    digest,
)

logger = logging.getLogger(__name__)

TALK_S = 10.0
"""Timeout for a message of some hundred bytes."""


class WeightHeader(NamedTuple):
    """Message about a set in a buffer; the file descriptor comes with the first one about that buffer."""

    slot: int
    """Slot of the buffer; a new buffer replaces the one before in its slot."""
    version: int
    published_s: float
    size: int
    """Bytes of the data."""
    text: int
    """Bytes of the layout, which follows the data."""
    digest: bytes


HEADER = struct.Struct("<QqdQQ16s")
APPLIED = struct.Struct("<q")
"""A reader's answer: the version that it has applied, so that it does not hold the buffer any more."""


@dataclass(eq=False)
class _Reader:
    """A reader as the publisher sees it."""

    number: int
    """In the order in which they connected."""
    connection: socket.socket
    known: dict[int, WeightBuffer] = field(default_factory=dict)
    """Slot → buffer that it has mapped."""
    holds: WeightUpdate | None = None
    applied: int | None = None


class SharedMemoryPublisher(Publisher):
    """The trainer's end."""

    def __init__(self, readers: int) -> None:
        super().__init__(WeightBuffer.shared)
        self._awaited = readers
        self._readers: list[_Reader] = []
        self._connected = 0
        self.address = new_name()
        """Socket name on this machine that readers connect to."""
        self._listener = listening(self.address, readers)
        self._event = os.eventfd(0, os.EFD_CLOEXEC)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._event, selectors.EVENT_READ)
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._thread.start()

    def expect(self, readers: int) -> None:
        """Wait for so many readers in all, in `flush`."""
        with self._changed:
            self._awaited = max(0, readers - self._connected)

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
                    if (update := self._take()) is not None:
                        update.digest = digest(update.version, update.layout, update.buffer)
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
            reader = _Reader(self._connected, connection)
            self._connected, self._awaited = self._connected + 1, max(0, self._awaited - 1)
            self._readers.append(reader)
        self._selector.register(connection, selectors.EVENT_READ, reader)

    def _drop(self, reader: _Reader) -> None:
        """Forget a reader that has gone, and what it held."""
        self._selector.unregister(reader.connection)
        with self._changed:
            self._readers.remove(reader)
            self._changed.notify_all()
        reader.connection.close()
        logger.warning("reader %d of the weights has gone", reader.number)

    def _send_newest(self) -> None:
        """Send the newest set to every reader that holds nothing and has not had it."""
        if (update := self._current) is None:
            return
        for reader in list(self._readers):
            if reader.holds is None and reader.applied != update.version:
                self._send(reader, update)

    def _send(self, reader: _Reader, update: WeightUpdate) -> None:
        buffer, layout = update.buffer, update.layout
        with self._changed:
            slot = self._buffers.index(buffer)
            reader.holds = update
        header = WeightHeader(
            slot, update.version, update.published_s, layout.size, len(layout.text), update.digest
        )
        fds = [] if buffer.fd is None or reader.known.get(slot) is buffer else [buffer.fd]
        try:
            socket.send_fds(reader.connection, [HEADER.pack(*header)], fds)
        except OSError:
            self._drop(reader)
            return
        reader.known[slot] = buffer

    def _hear(self, reader: _Reader) -> None:
        if reader not in self._readers:
            return  # dropped since the selector returned
        try:
            data = reader.connection.recv(APPLIED.size)
        except OSError:
            data = b""
        if not data:
            self._drop(reader)
            return
        with self._changed:
            (reader.applied,) = APPLIED.unpack(data)
            reader.holds = None
            self._changed.notify_all()

    def _wake(self) -> None:
        if self._event >= 0:
            os.eventfd_write(self._event, 1)

    def _held(self) -> list[WeightBuffer]:
        return [reader.holds.buffer for reader in self._readers if reader.holds is not None]

    def _missing(self) -> str:
        if self._version is None:
            return ""
        late = [str(reader.number) for reader in self._readers if reader.applied != self._version]
        parts = [f"{self._awaited} readers have not connected"] if self._awaited else []
        parts += [f"not applied by readers {', '.join(late)}"] if late else []
        return "; ".join(parts)


@dataclass(frozen=True, kw_only=True)
class Received:
    """A set that has arrived, to be released once it is applied."""

    version: int
    tensors: Tensors
    """Read-only, and valid until `release`."""
    published_s: float
    """When `publish` was called, on `time.monotonic`."""
    release: Callable[[], None] = lambda: None
    nbytes: int = 0


class SharedMemoryReader:
    """The reader's end: receives on a thread of its own, and checks every set before it is used.

    Args:
        address: the publisher's.
        deliver: called on that thread with each set; the next one comes once it is released.
        failed: called on that thread if it ends because of an error, which the publisher's end is not.
    """

    def __init__(
        self, address: str, deliver: Callable[[Received], object], failed: Callable[[BaseException], object]
    ) -> None:
        self._deliver, self._failed = deliver, failed
        self._buffers: dict[int, WeightBuffer] = {}
        """By slot."""
        self._layout = BufferLayout.of({})
        self._closing = False
        self._socket = new_socket()
        try:
            self._socket.settimeout(TALK_S)
            self._socket.connect(f"\0{address}")
            if not same_user(self._socket):
                raise PermissionError("another user listens at the trainer's address")
        except BaseException:
            self._socket.close()
            raise
        self._socket.settimeout(None)  # the trainer's end is noticed without one
        self._thread = threading.Thread(target=self._run, name="weights", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop receiving; arrays that were delivered stay valid."""
        self._closing = True
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        if self._thread is not threading.current_thread():
            self._thread.join(TALK_S)
        self._socket.close()

    def _run(self) -> None:
        try:
            while True:
                self._deliver(self._receive())
        except BaseException as error:
            # The trainer's end is no error here: the engine knows why.
            if not (self._closing or isinstance(error, ConnectionError)):
                self._failed(error)
        finally:
            self._socket.close()  # so that the trainer hears of it
            for buffer in self._buffers.values():
                buffer.close()

    def _receive(self) -> Received:
        """The next set, checked.

        Raises:
            TornSetError: it is not what was published.
            ConnectionError: there will be no more.
        """
        data, fds, _, _ = socket.recv_fds(self._socket, HEADER.size, 1, socket.MSG_CMSG_CLOEXEC)
        if not data:
            raise ConnectionResetError("the publisher has ended")
        header = WeightHeader(*HEADER.unpack(data))
        buffer = self._buffer(header, fds)
        layout = self._read_layout(header, buffer)
        if digest(header.version, layout, buffer) != header.digest:
            raise TornSetError(f"weights of version {header.version} are not what their digest says")
        tensors = buffer.views(layout)
        for tensor in tensors.values():
            tensor.flags.writeable = False
        return Received(
            version=header.version,
            tensors=tensors,
            published_s=header.published_s,
            release=lambda: self._release(header.version),
            nbytes=layout.size,
        )

    def _buffer(self, header: WeightHeader, fds: list[int]) -> WeightBuffer:
        if fds:
            if header.slot in self._buffers:
                self._buffers.pop(header.slot).close()
            size = os.fstat(fds[0]).st_size
            self._buffers[header.slot] = WeightBuffer(size, fds[0], writable=False)
        if header.slot not in self._buffers:
            raise TornSetError(f"weights of version {header.version} came without their memory")
        return self._buffers[header.slot]

    def _read_layout(self, header: WeightHeader, buffer: WeightBuffer) -> BufferLayout:
        end = header.size + header.text
        if end > len(buffer):
            raise TornSetError(f"weights of version {header.version} do not fit into their memory")
        text = buffer.memory[header.size : end].tobytes()
        if text != self._layout.text:
            self._layout = BufferLayout.read(text)
        return self._layout

    def _release(self, version: int) -> None:
        with contextlib.suppress(OSError):  # the trainer has gone
            self._socket.send(APPLIED.pack(version))
