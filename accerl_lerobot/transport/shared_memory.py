# SPDX-License-Identifier: Apache-2.0
"""Messages through memory that client and service share, on one node.

    client      writes the message into a slot of its own ──token──► service   reads it where it lies
                copies the reply out, and the slot is free ◄──token── service  writes the reply behind it

Tokens go through a Unix socket (SOCK_SEQPACKET); a slot's file descriptor goes with its first token. A
message or reply that is too large for its slot replaces the slot by a larger one. When a process dies the
kernel closes its socket, which the other end sees at once.

A message is a JSON header with everything but the arrays, as `snapshot` has it, then the arrays. Nothing that
is read is executed.

    0    size of the header
    4    [tree, [dtype, *shape] of each array]
         each array, at a multiple of 64 bytes; offsets follow from dtypes and shapes

Memory is a memfd and a socket's name is in Linux's abstract namespace, so a process that is killed leaves
neither behind. Other users could see a socket's name and connect; each end asks the kernel whose process the
other one is and talks to its own user only.
"""

from __future__ import annotations

import asyncio
import functools
import json
import logging
import mmap
import os
import secrets
import select
import socket
import struct
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from accerl_lerobot.checkpoint.snapshot import from_json, to_json
from accerl_lerobot.transport.contract import Client, PendingRequest, Server, ServiceStoppedError, stopped

logger = logging.getLogger(__name__)

CONNECT_S = 30.0  # timeout for connecting to a service
LEAST = 2**16  # bytes of a slot at least; the reply is written behind the message
SLOTS = 64
"""Slots of one client at most, and so messages that it may have under way. Their tokens fit into the buffers
of the two sockets, so no end ever waits for the other one to read."""
_TOKEN = struct.Struct("<?IQQQd")
_SIZE = struct.Struct("<I")
ALIGNMENT = 64  # alignment of arrays in shared memory, in bytes: a cache line
_dumps = json.JSONEncoder(separators=(",", ":"), check_circular=False).encode


def aligned(offset: int) -> int:
    """The next offset at which an array may begin."""
    return -(-offset // ALIGNMENT) * ALIGNMENT


class Packed(NamedTuple):
    """A message that is ready to be written; its arrays are still the sender's."""

    header: bytes
    arrays: list[np.ndarray]
    size: int

    def write(self, buffer: Any, start: int) -> None:
        """Copy it into a writable buffer from `start` on, a multiple of `ALIGNMENT`."""
        _SIZE.pack_into(buffer, start, len(self.header))
        end = start + _SIZE.size + len(self.header)
        buffer[start + _SIZE.size : end] = self.header
        for array in self.arrays:
            np.ndarray(array.shape, array.dtype, buffer, aligned(end))[...] = array
            end = aligned(end) + array.nbytes


def pack(message: Any) -> Packed:
    """Encode what `snapshot` can save; a `TypeError` names the place of anything else."""
    named: dict[str, np.ndarray] = {}
    tree = to_json(message, "message", named)
    arrays = list(named.values())
    header = _dumps([tree, [[array.dtype.str, *array.shape] for array in arrays]]).encode()
    size = _SIZE.size + len(header)
    for array in arrays:
        size = aligned(size) + array.nbytes
    return Packed(header, arrays, size)


def unpack(buffer: Any, start: int = 0, *, copy: bool = True) -> Any:
    """Decode the message that begins at `start`; unless `copy`, its arrays are views of the buffer."""
    (length,) = _SIZE.unpack_from(buffer, start)
    end = start + _SIZE.size + length
    tree, kinds = json.loads(bytes(buffer[start + _SIZE.size : end]))
    arrays = {}
    for number, (dtype, *shape) in enumerate(kinds):
        array: np.ndarray = np.ndarray(shape, dtype, buffer, aligned(end))
        end = aligned(end) + array.nbytes
        arrays[str(number)] = array.copy() if copy else array
    return from_json(tree, arrays)


@functools.cache
def available() -> bool:
    """True if this system has memfd, epoll and eventfd, which some containers forbid."""
    try:
        os.close(os.memfd_create("accerl"))
        select.epoll().close()
        os.close(os.eventfd(0))
    except (AttributeError, OSError):
        return False
    return True


def new_socket() -> socket.socket:
    """A socket whose messages keep their borders and order, and can carry file descriptors."""
    return socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)


def same_user(connection: socket.socket) -> bool:
    size = struct.calcsize("3i")
    _, user, _ = struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size))
    return bool(user == os.getuid())


class Token(NamedTuple):
    """Message on the socket. A file descriptor goes with it where the slot is new or has been replaced."""

    failed: bool  # True if it brings an error in the place of a reply
    slot: int
    ticket: int
    start: int  # first byte of the message in the slot
    size: int
    sent: float  # on `time.monotonic`


Slot = mmap.mmap  # mapped shared memory, which lasts as long as something refers to it or a view of it


def new_slot(size: int) -> tuple[Slot, int]:
    """A slot of at least `size` bytes, and its file descriptor; what is not written to takes no memory."""
    file = os.memfd_create("accerl", os.MFD_CLOEXEC)
    os.ftruncate(file, max(LEAST, 1 << (size - 1).bit_length()))
    return Slot(file, 0), file


def send_token(connection: socket.socket, token: Token, file: int | None = None) -> None:
    """Send a token; a file descriptor goes with it and is closed here."""
    if file is None:
        connection.send(_TOKEN.pack(*token))
        return
    try:
        socket.send_fds(connection, [_TOKEN.pack(*token)], [file])
    finally:
        os.close(file)


def receive_token(connection: socket.socket) -> tuple[Token, Slot | None] | None:
    """The next token, and the slot that came with it; None if the other end is gone."""
    packet, files, _, _ = socket.recv_fds(connection, _TOKEN.size, 1, socket.MSG_CMSG_CLOEXEC)
    if not packet:
        return None
    slot = None
    if files:
        slot = Slot(files[0], 0)
        os.close(files[0])
    return Token._make(_TOKEN.unpack(packet)), slot


class Address(NamedTuple):
    """Where processes of a node, see `this_node`, reach a service."""

    node: str
    name: str


def this_node() -> str:
    """Equal for two processes that can reach each other's sockets and have the same monotonic clock."""
    spaces = (os.stat(f"/proc/self/ns/{kind}").st_ino for kind in ("net", "time"))
    return "-".join([Path("/proc/sys/kernel/random/boot_id").read_text().strip(), *map(str, spaces)])


class SharedMemoryClient(Client):
    """The caller's end."""

    def __init__(self, name: str, address: Address) -> None:
        super().__init__(name)
        self._socket = _connected(name, address)
        # Cheaper than a socket timeout, which costs a system call whenever it is changed.
        self._readable = select.poll()
        self._readable.register(self._socket, select.POLLIN)
        self._slots: list[Slot] = []
        self._free: list[int] = []
        self._under_way: dict[int, int] = {}  # ticket → slot
        self._sent = 0

    def send(self, message: object) -> int:
        packed, file = pack(message), None
        if not self._free and len(self._slots) == SLOTS:
            raise TimeoutError(f"{self.name}: none of {SLOTS} messages under way has been answered")
        index = self._free.pop() if self._free else len(self._slots)
        if index == len(self._slots) or len(self._slots[index]) < packed.size:
            slot, file = new_slot(packed.size + LEAST)
            self._slots[index : index + 1] = [slot]
        packed.write(self._slots[index], 0)
        self._sent += 1
        self._under_way[self._sent] = index
        try:
            send_token(self._socket, Token(False, index, self._sent, 0, packed.size, time.monotonic()), file)
        except OSError as error:
            raise self._gone(error) from error
        return self._sent

    def done(self, timeout: float) -> list[tuple[int, object]]:
        replies: list[tuple[int, object]] = []
        end = time.monotonic() + timeout
        try:
            while self._readable.poll(0 if replies else max(0.0, 1000 * (end - time.monotonic()))):
                received = receive_token(self._socket)
                if received is None:
                    raise self._gone("its end of the connection is closed")
                replies.append(self._read(*received))
                if not self._under_way:
                    break
        except OSError as error:
            raise self._gone(error) from error
        return replies

    def close(self) -> None:
        self._socket.close()
        self._slots.clear()

    def _read(self, token: Token, slot: Slot | None) -> tuple[int, object]:
        """Copy a reply out, which frees its slot."""
        index = self._under_way.pop(token.ticket)
        if slot is not None:
            self._slots[index] = slot
        self._free.append(index)
        reply = unpack(self._slots[index], token.start)
        if token.failed:
            raise ServiceStoppedError(f"{self.name}: {reply}")
        return token.ticket, reply

    def _gone(self, reason: object) -> ServiceStoppedError:
        return ServiceStoppedError(f"{self.name} is gone: {reason}")


def _connected(name: str, address: Address) -> socket.socket:
    """A socket whose other end is a service of this user."""
    end = new_socket()
    end.setblocking(False)
    deadline = time.monotonic() + CONNECT_S
    while True:
        try:
            end.connect(f"\0{address.name}")
            if same_user(end):
                return end
            reason = ": another user's process has taken its place"
            break
        except OSError as error:
            # The backlog may be full while the service is busy.
            if not isinstance(error, BlockingIOError) or time.monotonic() > deadline:
                reason = f" cannot be connected to: {error}"
                break
        time.sleep(0.01)
    end.close()
    raise ServiceStoppedError(f"{name}{reason}")


class SharedMemoryServer(Server):
    """The service's end: `poll` accepts clients and hands over their messages, oldest first.

    Messages own their arrays if `copy`; else these are views, valid until the answer.
    """

    def __init__(self, take: Callable[[PendingRequest], None], *, copy: bool) -> None:
        super().__init__(take)
        self._copy = copy
        self.address = Address(this_node(), f"accerl-{secrets.token_hex(16)}")  # which nobody can guess
        self._listener = new_socket()
        self._listener.bind(f"\0{self.address.name}")
        self._listener.listen(SLOTS)
        self._listener.setblocking(False)
        self._event = open(os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK), "rb+", buffering=0)  # noqa: SIM115
        self._epoll = select.epoll()
        for source in (self._listener, self._event):
            self._epoll.register(source, select.EPOLLIN)
        self._connections: dict[int, _Connection] = {}

    def fileno(self) -> int:
        """Readable when `poll` has something to do, for an event loop."""
        return self._epoll.fileno()

    def wake(self) -> None:
        self._event.write((1).to_bytes(8, "little"))

    def poll(self, timeout: float) -> None:
        received: list[PendingRequest] = []
        events = self._epoll.poll(timeout)
        while events:
            for descriptor, _ in events:
                if (connection := self._connections.get(descriptor)) is not None:
                    self._receive(connection, received)
                elif descriptor == self._listener.fileno():
                    self._accept()
                elif descriptor == self._event.fileno():
                    self._event.read(8)
            events = self._epoll.poll(0)
        while self._called:
            received.append(self._called.popleft())
        for request in sorted(received, key=lambda request: request.sent):
            self._take(request)

    def close(self) -> None:
        self._epoll.unregister(self._listener)
        self._listener.close()
        for connection in list(self._connections.values()):
            self._drop(connection)

    def _accept(self) -> None:
        try:
            end, _ = self._listener.accept()
        except (BlockingIOError, ConnectionError):
            return  # it has gone again
        if not same_user(end):
            logger.warning("a process of another user was refused")
            end.close()
            return
        end.setblocking(False)
        self._connections[end.fileno()] = _Connection(end)
        self._epoll.register(end, select.EPOLLIN)

    def _receive(self, connection: _Connection, received: list[PendingRequest]) -> None:
        """Take the client's next message, if there is one."""
        try:
            packet = receive_token(connection.socket)
        except BlockingIOError:
            return
        except ConnectionError:
            packet = None
        if packet is None:
            self._drop(connection)
            return
        token, slot = packet
        if slot is not None:
            connection.slots[token.slot] = slot
        message = unpack(connection.slots[token.slot], token.start, copy=self._copy)
        reply = functools.partial(self._reply, connection, token)
        sent = min(token.sent, time.monotonic())
        received.append(PendingRequest(message, sent, lambda: connection.closed, reply))

    def _reply(self, to: _Connection, asked: Token, reply: object, error: BaseException | None) -> None:
        """Write it behind the message, whose arrays it may consist of, or into a larger slot."""
        packed = pack(reply if error is None else str(stopped(error)))
        start, file = aligned(asked.start + asked.size), None
        if start + packed.size > len(to.slots[asked.slot]):
            to.slots[asked.slot], file = new_slot(start + packed.size)
            start = 0
        packed.write(to.slots[asked.slot], start)
        token = asked._replace(failed=error is not None, start=start, size=packed.size)
        try:
            send_token(to.socket, token, file)
        except OSError:  # it has died, or does not read although it may have few messages under way
            self._drop(to)

    def _drop(self, connection: _Connection) -> None:
        """Forget a client; its slots go with the last view of them."""
        if self._connections.pop(connection.socket.fileno(), None) is not None:
            self._epoll.unregister(connection.socket)
        connection.closed = True
        connection.socket.close()
        connection.slots.clear()


class _Connection:
    """One client as the service sees it."""

    def __init__(self, end: socket.socket) -> None:
        self.socket, self.closed = end, False
        self.slots: dict[int, Slot] = {}


def serve_on_loop(answer: Callable[[Any], Awaitable[Any]]) -> SharedMemoryServer:
    """Have a coroutine function answer messages, which own their arrays, in tasks of the running loop."""
    tasks: set[asyncio.Task[None]] = set()

    async def handle(request: PendingRequest) -> None:
        try:
            request.answer(await answer(request.message))
        except Exception as error:
            request.fail(error)

    def take(request: PendingRequest) -> None:
        task = asyncio.ensure_future(handle(request))
        tasks.add(task)  # the loop itself refers to tasks weakly
        task.add_done_callback(tasks.discard)

    server = SharedMemoryServer(take, copy=True)
    asyncio.get_running_loop().add_reader(server.fileno(), server.poll, 0.0)
    return server
