# SPDX-License-Identifier: Apache-2.0
"""Messages through memory that caller and service share, on one node.

    caller      writes the message into a slot of its own ──token──► service   reads it where it lies
                copies the reply out, and the slot is free ◄──token── service  writes the reply behind it

Tokens go through a Unix socket that keeps their borders (SOCK_SEQPACKET); a slot's file goes with the first
of them. A message that is too large for its slot, or a reply, has whoever writes it replace the slot by a
larger one. When a process dies the kernel closes its socket, which the other end sees at once.

Neither slots nor sockets have a name in a file system, see `nameless`: nothing is left by a process that is
killed, and no folder has to be agreed on.
"""

from __future__ import annotations

import logging
import os
import select
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from accerl_lerobot.transport.codec import DamagedMessageError, decode, encode
from accerl_lerobot.transport.contract import Asked, Caller, Server, ServiceStoppedError
from accerl_lerobot.transport.nameless import aligned, listening, new_name, new_socket, same_user
from accerl_lerobot.transport.slots import (
    ANSWER,
    ASK,
    FAIL,
    LEAST,
    SLOTS,
    Slot,
    Token,
    new_file,
    receive,
    send,
)

logger = logging.getLogger(__name__)

CONNECT_S = 30.0
"""How long a service may take to be connected to."""


class Address(NamedTuple):
    """Where a service is reached by processes of its node."""

    node: str
    """See `this_node`."""
    name: str


def this_node() -> str:
    """The same for two processes that can reach each other's sockets and measure the same time."""
    spaces = (os.stat(f"/proc/self/ns/{kind}").st_ino for kind in ("net", "time"))
    return "-".join([Path("/proc/sys/kernel/random/boot_id").read_text().strip(), *map(str, spaces)])


class SharedMemoryCaller(Caller):
    """See the contract.

    Args:
        name: of the service, for messages.
        address: of its `SharedMemoryServer`.

    Raises:
        ServiceStoppedError: nobody is there any more, or it is somebody else.
    """

    def __init__(self, name: str, address: Address) -> None:
        super().__init__(name)
        self._socket = _connected(name, address)
        # Cheaper than a timeout of the socket, which costs a system call whenever it is changed.
        self._readable = select.poll()
        self._readable.register(self._socket, select.POLLIN)
        self._slots: list[Slot] = []
        self._free: list[int] = []
        self._under_way: dict[int, int] = {}
        """Ticket → slot."""
        self._forgotten: set[int] = set()
        self._sent = 0

    def send(self, message: object) -> int:
        encoded = encode(message)
        if not self._free and len(self._slots) == SLOTS:
            raise TimeoutError(f"{self.name}: none of {SLOTS} messages under way has been answered")
        index = self._free[-1] if self._free else len(self._slots)
        file = None
        if index == len(self._slots) or self._slots[index].size < encoded.size:
            file = new_file(encoded.size + LEAST)
            self._slots[index : index + 1] = [Slot(file)]
        if self._free:
            self._free.pop()
        encoded.write(self._slots[index].memory, 0)
        self._sent += 1
        self._under_way[self._sent] = index
        try:
            send(self._socket, Token(ASK, index, self._sent, 0, encoded.size, time.monotonic()), file)
        except OSError as error:
            raise self._gone(error) from error
        return self._sent

    def done(self, timeout: float) -> list[tuple[int, object]]:
        replies: list[tuple[int, object]] = []
        end = time.monotonic() + timeout
        try:
            while self._readable.poll(0 if replies else max(0.0, 1000 * (end - time.monotonic()))):
                received = receive(self._socket)
                if received is None:
                    raise self._gone("its end of the connection is closed")
                replies += self._read(*received)
                if not self._under_way:
                    break
        except (OSError, DamagedMessageError) as error:
            raise self._gone(error) from error
        return replies

    def forget(self, ticket: int) -> None:
        if ticket in self._under_way:
            self._forgotten.add(ticket)

    def close(self) -> None:
        self._socket.close()
        self._slots.clear()

    def _read(self, token: Token, slot: Slot | None) -> list[tuple[int, object]]:
        """Copies a reply out, which frees its slot; nothing if nobody waits for it."""
        index = self._under_way.pop(token.ticket, -1)
        if index != token.slot:
            raise self._gone(f"a reply to message {token.ticket}, which was not asked")
        if slot is not None:
            self._slots[index] = slot
        self._free.append(index)
        if token.ticket in self._forgotten:
            self._forgotten.discard(token.ticket)
            return []
        try:
            reply = decode(self._slots[index].memory, token.start, token.size)
        except DamagedMessageError as error:
            raise self._gone(error) from error
        if token.what == FAIL:
            raise ServiceStoppedError(f"{self.name}: {reply}")
        return [(token.ticket, reply)]

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
            mine = same_user(end)
            break
        except OSError as error:
            # Many may wait to be let in while the service is at something long.
            if not isinstance(error, BlockingIOError) or time.monotonic() > deadline:
                end.close()
                raise ServiceStoppedError(f"{name} cannot be connected to: {error}") from error
        time.sleep(0.01)
    if not mine:
        end.close()
        raise ServiceStoppedError(f"{name}: another user's process has taken its place")
    return end


class SharedMemoryServer(Server):
    """Listens from the beginning; `poll` connects callers and hands their messages over, oldest first.

    Args:
        take: see `Server`.
        copy: whether messages own their arrays; otherwise these are views, good until the answer.
    """

    def __init__(self, take: Callable[[Asked], None], *, copy: bool) -> None:
        super().__init__(take)
        self._copy = copy
        self.address = Address(this_node(), new_name())
        self._listener = listening(self.address.name, SLOTS)
        self._listener.setblocking(False)
        self._bell = open(os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK), "rb+", buffering=0)  # noqa: SIM115
        self._epoll = select.epoll()
        for source in (self._listener, self._bell):
            self._epoll.register(source, select.EPOLLIN)
        self._connections: dict[int, _Connection] = {}

    def fileno(self) -> int:
        """Readable when `poll` has something to do, for those who wait for other things as well."""
        return self._epoll.fileno()

    def wake(self) -> None:
        self._bell.write((1).to_bytes(8, "little"))

    def poll(self, timeout: float) -> None:
        heard: list[Asked] = []
        events = self._epoll.poll(timeout)
        while events:
            for descriptor, _ in events:
                connection = self._connections.get(descriptor)
                if connection is not None:
                    heard += self._hear(connection)
                elif descriptor == self._listener.fileno():
                    self._connect()
                elif descriptor == self._bell.fileno():
                    self._bell.read(8)
            events = self._epoll.poll(0)
        while self._called:
            heard.append(self._called.popleft())
        if len(heard) > 1:
            heard.sort(key=lambda asked: asked.sent)
        for asked in heard:
            self._take(asked)

    def close(self) -> None:
        self._epoll.unregister(self._listener)
        self._listener.close()
        for connection in list(self._connections.values()):
            self._drop(connection)

    def _connect(self) -> None:
        try:
            end, _ = self._listener.accept()
        except (BlockingIOError, ConnectionError):
            return  # it has gone again
        if not same_user(end):
            logger.warning("a process of another user was refused")
            end.close()
            return
        end.setblocking(False)
        self._connections[end.fileno()] = _Connection(end, self._drop)
        self._epoll.register(end, select.EPOLLIN)

    def _hear(self, connection: _Connection) -> list[Asked]:
        """The caller's next message; nothing if it is gone, which is how they end, or talks nonsense."""
        try:
            received = receive(connection.socket)
            if received is not None:
                return connection.take(*received, self._copy)
        except BlockingIOError:
            return []
        except ConnectionError:
            pass
        except DamagedMessageError as error:
            logger.warning("a caller was dropped: %s", error)
        self._drop(connection)
        return []

    def _drop(self, connection: _Connection) -> None:
        """Forgets a caller; its slots go with the last view of them."""
        if self._connections.pop(connection.socket.fileno(), None) is not None:
            self._epoll.unregister(connection.socket)
        connection.close()


class _Connection:
    """One caller as the service sees it."""

    def __init__(self, end: socket.socket, drop: Callable[[_Connection], None]) -> None:
        self.socket, self._drop = end, drop
        self.closed = False
        self._slots: dict[int, Slot] = {}
        self._busy: set[int] = set()

    def take(self, token: Token, slot: Slot | None, copy: bool) -> list[Asked]:
        """A message, once; nothing if it was answered here because it cannot be read."""
        if slot is not None and token.slot < SLOTS and token.slot not in self._busy:
            self._slots[token.slot] = slot
        known = token.what == ASK and token.slot in self._slots and token.slot not in self._busy
        if not known or token.start + token.size > self._slots[token.slot].size:
            raise DamagedMessageError(f"a token that makes no sense: {token}")
        self._busy.add(token.slot)
        asked = _AskedThere(self, token)
        try:
            asked.message = decode(self._slots[token.slot].memory, token.start, token.size, copy=copy)
        except DamagedMessageError as error:
            asked.fail(error)
            return []
        return [asked]

    def reply(self, what: int, asked: Token, reply: object) -> None:
        """Writes it behind the message, whose arrays it may consist of, or into a larger slot."""
        encoded = encode(reply)
        start, file = aligned(asked.start + asked.size), None
        if start + encoded.size > self._slots[asked.slot].size:
            file = new_file(start + encoded.size)
            self._slots[asked.slot], start = Slot(file), 0
        encoded.write(self._slots[asked.slot].memory, start)
        self._busy.discard(asked.slot)
        try:
            send(self.socket, Token(what, asked.slot, asked.ticket, start, encoded.size, asked.sent), file)
        except OSError:  # it has died, or does not read although it may have few messages under way
            self._drop(self)

    def close(self) -> None:
        self.closed = True
        self.socket.close()
        self._slots.clear()


class _AskedThere(Asked):
    """By another process."""

    def __init__(self, connection: _Connection, token: Token) -> None:
        self._connection, self._token = connection, token
        self.sent = min(token.sent, time.monotonic())

    @property
    def gone(self) -> bool:
        return self._connection.closed

    def answer(self, reply: object) -> None:
        if not self.gone:
            self._connection.reply(ANSWER, self._token, reply)

    def fail(self, error: BaseException) -> None:
        if not self.gone:
            self._connection.reply(FAIL, self._token, f"the service has stopped: {error!r}")
