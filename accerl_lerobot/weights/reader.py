# SPDX-License-Identifier: Apache-2.0
"""A reader's end of shared memory: receives on a thread of its own, and checks every set before it is used.

What is delivered stays as it is until it is let go of: the trainer writes elsewhere meanwhile.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass

from accerl_lerobot.transport.memfd import new_socket, same_user
from accerl_lerobot.weights.channel import Tensors
from accerl_lerobot.weights.shared_memory import (
    APPLIED,
    CONFIRMED,
    FORMAT,
    TALK_S,
    Message,
)
from accerl_lerobot.weights.slab import Layout, Slab, TornSetError, digest

CONFIRM_S = 60.0
"""How long the trainer's process may take to read a set once, among all else that it does."""


@dataclass(frozen=True, kw_only=True)
class Received:
    """A set that has arrived, and is to be let go of once it is applied."""

    version: int
    tensors: Tensors
    """All of them, read-only; not to be looked at any more once they are let go of."""
    published_s: float
    """When `publish` was called, on the clock `time.monotonic`."""
    release: Callable[[], None] = lambda: None
    nbytes: int = 0
    """Bytes that the reader has to read of it."""


class SharedMemoryReader:
    """Receives what a `SharedMemoryPublisher` sends.

    Args:
        address: the publisher's.
        deliver: called on the receiving thread with each set; the next one comes once it is let go of.
        failed: called on that thread if it ends because of an error. The publisher's end is none.

    Raises:
        OSError: nobody of this user listens there, or not on this machine.
    """

    def __init__(
        self, address: str, deliver: Callable[[Received], object], failed: Callable[[BaseException], object]
    ) -> None:
        self._deliver, self._failed = deliver, failed
        self._slabs: dict[int, Slab] = {}
        """By slot."""
        self._layout = Layout.of({})
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
        self._socket.settimeout(None)  # the next set comes when it comes, and the end of the trainer is heard
        self._thread = threading.Thread(target=self._run, name="weights", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stops receiving; arrays that were delivered stay valid."""
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
            # The trainer's end is not ours: whoever watches it knows why.
            if not (self._closing or isinstance(error, ConnectionError)):
                self._failed(error)
        finally:
            self._socket.close()  # so that the trainer hears of it
            for slab in self._slabs.values():
                slab.close()

    def _receive(self) -> Received:
        """The next set, once it is checked.

        Raises:
            TornSetError: it is not what was published.
            ConnectionError: there will be no more.
        """
        data, fds, _, _ = socket.recv_fds(self._socket, FORMAT.size, 1, socket.MSG_CMSG_CLOEXEC)
        if not data:
            raise ConnectionResetError("the publisher has ended")
        message = Message.unpack(data)
        slab = self._slab(message, fds)
        layout = self._layout_of(message, slab)
        tensors = slab.views(layout)
        if digest(message.version, layout, slab.memory[: layout.size]) != self._confirmed(message):
            raise TornSetError(f"weights of version {message.version} are not what their digest says")
        for tensor in tensors.values():
            tensor.flags.writeable = False
        return Received(
            version=message.version,
            tensors=tensors,
            published_s=message.published_s,
            release=lambda: self._release(message.version),
            nbytes=layout.size,
        )

    def _confirmed(self, message: Message) -> bytes:
        """The digest that the publisher has reckoned."""
        self._socket.settimeout(CONFIRM_S)
        try:
            data = self._socket.recv(CONFIRMED.size)
        except TimeoutError as error:
            raise TimeoutError(
                f"the digest of weights of version {message.version} did not come within {CONFIRM_S:g} s"
            ) from error
        if not data:
            raise ConnectionResetError("the publisher has ended")
        self._socket.settimeout(None)
        version, found = CONFIRMED.unpack(data)
        assert version == message.version
        return bytes(found)

    def _slab(self, message: Message, fds: list[int]) -> Slab:
        if fds:
            if message.slot in self._slabs:
                self._slabs.pop(message.slot).close()
            size = os.fstat(fds[0]).st_size
            self._slabs[message.slot] = Slab(size, fds[0], writable=False)
        if message.slot not in self._slabs:
            raise TornSetError(f"weights of version {message.version} came without their memory")
        return self._slabs[message.slot]

    def _layout_of(self, message: Message, slab: Slab) -> Layout:
        end = message.size + message.text
        text = slab.memory[message.size : end].tobytes()
        if end > len(slab):
            raise TornSetError(f"weights of version {message.version} do not fit into their memory")
        if text != self._layout.text:
            self._layout = Layout.read(text)
        return self._layout

    def _release(self, version: int) -> None:
        with contextlib.suppress(OSError):  # a trainer that has gone wants nothing back
            self._socket.send(APPLIED.pack(version))
