# SPDX-License-Identifier: Apache-2.0
"""Messages between processes of a run over sockets, pickled, large arrays behind the pickle as they are.

    client ──(ticket, time, message)──► service
           ◄──(ticket, reply, error)──

* *whole*: what arrives has the types, dtypes, shapes and texts of what was sent;
* *answered*: each reply goes to the message it answers, in whatever order replies are made;
* *detached*: once `Client.send` has returned, the caller may change its arrays;
* *bounded*: no end waits for the other one without a timeout;
* *no silence*: a client learns at once that the service has died or failed; a service drops the requests of a
  client that died.

On a node the sockets are Unix sockets in Linux's abstract namespace, so a process that is killed leaves
nothing behind; between nodes they are TCP. Both ends prove that they know the key of the service, as
`multiprocessing.connection` does it, before anything is unpickled.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import pickle
import secrets
import select
import selectors
import socket
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import AuthenticationError
from multiprocessing.connection import Connection, answer_challenge, deliver_challenge
from typing import Any, NamedTuple

import numpy as np

logger = logging.getLogger(__name__)

ADDRESS_S = 60.0  # timeout for a service to say where it is reached
CONNECT_S = 30.0  # timeout of a client for connecting, and for each step of proving the key
ACCEPT_S = 10.0  # timeout of a service for each step of proving the key; other clients wait meanwhile
RETRY_S = 1.0  # pause between two attempts to reach a service that was lost, and timeout of each
SEND_S = 0.05  # how long `Client.send` waits for the service to read, before it leaves the rest to `done`
OLDEST_S = 60.0  # largest age of a message that is believed; clocks of other nodes differ
SILENT_S = 30  # after which a machine of which nothing is heard is lost
IN_PIECES = 4096  # bytes from which on an array is not copied into the pickle
BACKLOG = 1024  # clients that may wait to be accepted
PIECES_AT_ONCE = 64  # pieces of memory per call of ``sendmsg``
_HEAD = struct.Struct("<II")  # bytes of the pickle, number of arrays behind it


class ServiceStoppedError(RuntimeError):
    """The service had failed or is gone; the caller did nothing wrong."""


def stopped(error: BaseException) -> ServiceStoppedError:
    """The error that a client gets for a failure of the service."""
    return ServiceStoppedError(f"the service has stopped: {error!r}")


class Address(NamedTuple):
    """Where a service is reached, and the key that both ends must know."""

    at: str | tuple[str, int]  # name of a Unix socket, or host and port
    key: bytes


def node_address(in_cluster: bool) -> str | None:
    """This node's address if workers of other nodes are to reach services here; None: they need not."""
    if not in_cluster:
        return None
    import ray

    return str(ray.util.get_node_ip_address())


def _socket(at: str | tuple[str, int]) -> socket.socket:
    return socket.socket(socket.AF_UNIX if isinstance(at, str) else socket.AF_INET)


def _proved(
    end: socket.socket, key: bytes, timeout: float, *steps: Callable[[Any, bytes], object]
) -> socket.socket:
    """The socket again, once both ends have proved to each other that they know the key."""
    end.settimeout(None)
    end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", int(timeout), 0))
    with Connection(end.detach()) as connection:
        for step in steps:
            step(connection, key)
        return socket.socket(fileno=os.dup(connection.fileno()))


def _notice_a_lost_machine(end: socket.socket) -> None:
    """Have a TCP connection fail within `SILENT_S` of the loss of the other machine, which says nothing."""
    end.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    if sys.platform == "linux":  # elsewhere there is one machine
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, SILENT_S // 2)
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, SILENT_S // 6)
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 1000 * SILENT_S)


class Stream:
    """One end of a connection: whole messages, over a socket that is never waited for."""

    def __init__(self, end: socket.socket) -> None:
        self.socket = end
        self.socket.setblocking(False)
        if self.socket.family != socket.AF_UNIX:
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            _notice_a_lost_machine(self.socket)
        self.closed = False
        self.unsent: deque[memoryview] = deque()
        self._received: list[Any] = []
        self._views = self._read_messages()
        self._view = next(self._views)

    def fileno(self) -> int:
        return self.socket.fileno()

    def send(self, message: Any) -> None:
        """Send a message, or keep in `unsent` what the socket does not take; `flush` sends that."""
        pieces: list[memoryview] = []

        def is_small(buffer: pickle.PickleBuffer) -> bool:
            raw = buffer.raw()
            small = raw.nbytes < IN_PIECES
            if not small:
                pieces.append(raw)
            return small

        head = pickle.dumps(message, protocol=5, buffer_callback=is_small)
        sizes = struct.pack(f"<{len(pieces)}Q", *(piece.nbytes for piece in pieces))
        start = _HEAD.pack(len(head), len(pieces))
        self.unsent.append(memoryview(start + sizes + head))
        self.unsent.extend(pieces)
        self.flush()

    def flush(self) -> None:
        """Send what is left of messages, as far as the socket takes it."""
        while self.unsent:
            try:
                sent = self.socket.sendmsg(list(self.unsent)[:PIECES_AT_ONCE])
            except BlockingIOError:
                return
            while self.unsent and sent >= self.unsent[0].nbytes:
                sent -= self.unsent.popleft().nbytes
            if self.unsent:
                self.unsent[0] = self.unsent[0][sent:]

    def detach(self) -> None:
        """Copy what is left of messages, so that their arrays may change."""
        self.unsent = deque(memoryview(bytes(piece)) for piece in self.unsent)

    def receive(self) -> list[Any]:
        """Messages that have come. An `EOFError` if the other end is gone."""
        with contextlib.suppress(BlockingIOError):
            while size := self.socket.recv_into(self._view):
                self._view = self._view[size:]
                while not self._view:
                    self._view = next(self._views)
            if not self._received:
                raise EOFError("its end of the connection is closed")
        received = self._received
        self._received = []
        return received

    def close(self) -> None:
        self.closed = True
        self.socket.close()
        self.unsent.clear()

    def _read_messages(self) -> Iterator[memoryview]:
        """Yields the memory to be filled next, and collects a message whenever it is complete."""
        while True:
            start = bytearray(_HEAD.size)
            yield memoryview(start)
            length, count = _HEAD.unpack(start)
            head = memoryview(bytearray(8 * count + length))
            yield head
            pieces = [np.empty(size, np.uint8) for size in struct.unpack_from(f"<{count}Q", head)]
            for piece in pieces:
                yield memoryview(piece)
            message = pickle.loads(head[8 * count :], buffers=pieces)
            self._received.append(message)


class Client:
    """One connection to a service, for one thread at a time.

    Calls raise `ServiceStoppedError` when the service has failed, or is gone.
    """

    def __init__(self, name: str, address: Address) -> None:
        self.name = name
        end = _socket(address.at)
        end.settimeout(CONNECT_S)
        try:
            end.connect(address.at)
            end = _proved(end, address.key, CONNECT_S, answer_challenge, deliver_challenge)
        except (OSError, EOFError, AuthenticationError) as error:
            end.close()
            raise ServiceStoppedError(f"{name} cannot be connected to: {error}") from error
        self._stream = Stream(end)
        self._poll = select.poll()
        self._replies: list[tuple[int, Any]] = []
        self._sent = 0

    def send(self, message: Any, ticket: int | None = None) -> int:
        """Send without waiting for a reply; returns the ticket, a new one unless the caller gives one."""
        self._sent += 1
        if ticket is None:
            ticket = self._sent
        try:
            self._stream.send((ticket, time.monotonic(), message))
            deadline = time.monotonic() + SEND_S
            while self._stream.unsent and time.monotonic() < deadline:
                self._exchange(SEND_S)
        except OSError as error:
            raise self._gone(error) from error
        self._stream.detach()
        return ticket

    def done(self, timeout: float) -> list[tuple[int, Any]]:
        """Tickets and replies that have come, each once; waits `timeout` seconds for the first."""
        deadline = time.monotonic() + timeout
        while not self._replies:
            left = deadline - time.monotonic()
            self._exchange(max(0.0, left))
            if left <= 0:
                break
        replies = self._replies
        self._replies = []
        return replies

    def close(self) -> None:
        """End the connection and forget what is under way. Safe to call twice."""
        self._stream.close()

    def _exchange(self, timeout: float) -> None:
        """Wait until the socket can be read or, with something unsent, written; read and write."""
        events = select.POLLIN
        if self._stream.unsent:
            events |= select.POLLOUT
        try:
            self._poll.register(self._stream, events)
            if not self._poll.poll(1000 * timeout):
                return
            self._stream.flush()
            received = self._stream.receive()
        except (OSError, EOFError, ValueError) as error:
            raise self._gone(error) from error
        for ticket, reply, failed in received:
            if failed:
                raise ServiceStoppedError(f"{self.name}: {reply}")
            self._replies.append((ticket, reply))

    def _gone(self, reason: object) -> ServiceStoppedError:
        return ServiceStoppedError(f"{self.name} is gone: {reason}")


@dataclass(frozen=True, kw_only=True)
class Endpoint:
    """A service of a worker, whose ``listen`` says where it is reached now."""

    name: str
    actor: Any = None  # Ray's handle of its process, and of the next one if that is restarted

    def connect(self, timeout_s: float = ADDRESS_S) -> Client:
        """A new connection. A `ServiceStoppedError` if the service does not answer in time."""
        import ray

        try:
            address = ray.get(self.actor.listen.remote(), timeout=timeout_s)
        except ray.exceptions.RayError as error:
            raise ServiceStoppedError(f"{self.name}: {error}") from error
        return Client(self.name, address)


class ReconnectingClient:
    """Connects again to a service that was lost, or to its successor, and asks what has not been answered.

    For services without a state of their own: a request for a decision carries the seed of its noise, and the
    decision the version of its weights. While the service is away no replies come and nothing fails. Messages
    must not change until they are answered.
    """

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint
        self._client: Client | None = None
        self._retry_at = 0.0
        self._unanswered: dict[int, Any] = {}  # ticket → message
        self._sent = 0

    def send(self, message: Any) -> int:
        self._sent += 1
        self._unanswered[self._sent] = message
        with self._noticing_loss():
            if self._client is None:
                self._connect()
            else:
                self._client.send(message, self._sent)
        return self._sent

    def done(self, timeout: float) -> list[tuple[int, Any]]:
        with self._noticing_loss():
            if self._client is None:
                self._connect()
            if self._client is None:
                time.sleep(min(timeout, RETRY_S / 10))
                return []
            replies = self._client.done(timeout)
            for ticket, _ in replies:
                del self._unanswered[ticket]
            return replies
        return []

    def _connect(self) -> None:
        """Connect where the service is now, unless that was tried a moment ago, and ask again."""
        if time.monotonic() < self._retry_at:
            return
        self._client = self._endpoint.connect(RETRY_S)
        for ticket, message in self._unanswered.items():
            self._client.send(message, ticket)

    @contextmanager
    def _noticing_loss(self) -> Iterator[None]:
        try:
            yield
        except ServiceStoppedError as error:
            logger.info("%s", error)
            self._retry_at = time.monotonic() + RETRY_S
            if self._client is not None:
                self._client.close()
                self._client = None


@dataclass(eq=False)
class PendingRequest:
    """A message at the service; answered or failed once, on the thread that polls."""

    message: Any
    sent: float  # on this process's `time.monotonic`
    ticket: int
    stream: Stream
    server: Server

    def gone(self) -> bool:
        """True if the answer is not awaited any more."""
        return self.stream.closed

    def answer(self, reply: Any, failed: bool = False) -> None:
        """Answer, unless the client is gone; if `failed`, it raises a `ServiceStoppedError` of the reply."""
        self.server.reply(self, reply, failed)

    def __len__(self) -> int:
        return len(self.message)


class Server:
    """The service's end: `poll` hands every message to `take`, oldest first, which answers then or later.

    `host` is this node's address if other nodes are to reach it.
    """

    def __init__(self, take: Callable[[PendingRequest], None], host: str | None = None) -> None:
        self._take = take
        at: str | tuple[str, int] = (host or "127.0.0.1", 0)
        if host is None and sys.platform == "linux":
            at = f"\0accerl-{secrets.token_hex(16)}"
        self._listener = _socket(at)
        self._listener.bind(at)
        self._listener.listen(BACKLOG)
        if not isinstance(at, str):
            at = self._listener.getsockname()
        self.address = Address(at, secrets.token_bytes(32))
        self._accepted: deque[socket.socket] = deque()  # connections that `poll` is to take over
        self._woken, self._waker = socket.socketpair()
        self._woken.setblocking(False)
        self._waker.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._closed = False
        threading.Thread(target=self._accept, daemon=True).start()

    def fileno(self) -> int:
        """Readable when `poll` has something to do, for an event loop."""
        return self._selector.fileno()

    def wake(self) -> None:
        """Make the current or next `poll` return at once; from any thread."""
        with contextlib.suppress(BlockingIOError):  # it has been woken often, and will return
            self._waker.send(b"x")

    def poll(self, timeout: float) -> None:
        """Hand over all messages that have come; wait `timeout` seconds at most for one, or for `wake`."""
        requests: list[PendingRequest] = []
        for key, events in self._selector.select(timeout):
            if key.fileobj is self._woken:
                self._woken.recv(4096)
                while self._accepted:
                    self._selector.register(Stream(self._accepted.popleft()), selectors.EVENT_READ)
            else:
                requests += self._exchange(key.fileobj, events)
        for request in sorted(requests, key=lambda request: request.sent):
            self._take(request)

    def reply(self, request: PendingRequest, value: Any, failed: bool) -> None:
        """See `PendingRequest.answer`."""
        stream = request.stream
        if stream.closed:
            return
        try:
            stream.send((request.ticket, value, failed))
        except OSError:
            self._drop(stream)
            return
        if stream.unsent:
            stream.detach()
            self._selector.modify(stream, selectors.EVENT_READ | selectors.EVENT_WRITE)

    def close(self) -> None:
        """End all connections."""
        self._closed = True
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)  # ends the thread that accepts
        self._listener.close()
        self._close_accepted()
        for key in list(self._selector.get_map().values()):
            if key.fileobj is not self._woken:
                self._drop(key.fileobj)

    def _accept(self) -> None:
        """Take in clients that know the key, on a thread of its own."""
        while not self._closed:
            try:
                end, _ = self._listener.accept()
            except OSError:
                time.sleep(0.1)  # closed, or too many open files
                continue
            with contextlib.suppress(OSError, EOFError, AuthenticationError):
                end = _proved(end, self.address.key, ACCEPT_S, deliver_challenge, answer_challenge)
                self._accepted.append(end)
                self.wake()
        self._close_accepted()

    def _close_accepted(self) -> None:
        """Close connections that `poll` has not taken over."""
        with contextlib.suppress(IndexError):
            while True:
                self._accepted.popleft().close()

    def _exchange(self, stream: Any, events: int) -> list[PendingRequest]:
        """Send a client what is left of replies, and read its messages."""
        messages = []
        try:
            if events & selectors.EVENT_WRITE:
                stream.flush()
                if not stream.unsent:
                    self._selector.modify(stream, selectors.EVENT_READ)
            if events & selectors.EVENT_READ:
                messages = stream.receive()
        except (OSError, EOFError):
            self._drop(stream)
        now = time.monotonic()
        requests = []
        for ticket, sent, message in messages:
            believed = sent if now - OLDEST_S < sent <= now else now
            requests.append(PendingRequest(message, believed, ticket, stream, self))
        return requests

    def _drop(self, stream: Any) -> None:
        if not stream.closed:
            self._selector.unregister(stream)
            stream.close()


def serve_on_loop(answer: Callable[[Any], Awaitable[Any]], host: str | None = None) -> Server:
    """Have a coroutine function answer messages, in tasks of the running event loop."""
    tasks: set[asyncio.Task[None]] = set()

    async def handle(request: PendingRequest) -> None:
        try:
            request.answer(await answer(request.message))
        except Exception as error:
            request.answer(str(stopped(error)), failed=True)

    def take(request: PendingRequest) -> None:
        task = asyncio.ensure_future(handle(request))
        tasks.add(task)  # the loop itself refers to tasks weakly
        task.add_done_callback(tasks.discard)

    server = Server(take, host)
    asyncio.get_running_loop().add_reader(server.fileno(), server.poll, 0.0)
    return server
