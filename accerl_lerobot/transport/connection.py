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
import os
import pickle
import queue
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
from dataclasses import dataclass
from multiprocessing import AuthenticationError
from multiprocessing.connection import Connection, answer_challenge, deliver_challenge
from typing import Any, NamedTuple

import numpy as np

CONNECT_S = 10  # timeout for connecting to a service, and for each step of proving the key
IN_PIECES = 4096  # bytes from which on an array is not copied into the pickle
BACKLOG = 1024  # clients that may wait to be accepted
SEND_S = 0.05  # how long `Client.send` waits for the service to read, before it leaves the rest to `done`
OLDEST_S = 60.0  # largest age of a message that is believed; clocks of other nodes differ
_HEAD = struct.Struct("<II")


class ServiceStoppedError(RuntimeError):
    """The service had failed or is gone; the caller did nothing wrong."""


class Address(NamedTuple):
    """Where a service is reached, and the key that both ends must know."""

    at: str | tuple[str, int]  # name of a Unix socket, or host and port
    key: bytes


def _family(at: str | tuple[str, int]) -> socket.AddressFamily:
    return socket.AF_UNIX if isinstance(at, str) else socket.AF_INET


class Stream:
    """One end of a connection: whole messages, over a socket that is never waited for."""

    def __init__(self, end: socket.socket) -> None:
        self.socket = end
        self.socket.setblocking(False)
        if self.socket.family != socket.AF_UNIX:
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
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
            if raw.nbytes >= IN_PIECES:
                pieces.append(raw)
            return raw.nbytes < IN_PIECES

        head = pickle.dumps(message, protocol=5, buffer_callback=is_small)
        sizes = struct.pack(f"<{len(pieces)}Q", *(piece.nbytes for piece in pieces))
        self.unsent += [memoryview(_HEAD.pack(len(head), len(pieces)) + sizes + head), *pieces]
        self.flush()

    def flush(self) -> None:
        """Send what is left of messages, as far as the socket takes it."""
        while self.unsent:
            try:
                sent = self.socket.sendmsg(list(self.unsent)[:64])
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
            size = self.socket.recv_into(self._view)
            while size:
                self._view = self._view[size:]
                while not self._view:
                    self._view = next(self._views)
                size = self.socket.recv_into(self._view)
            if not self._received:
                raise EOFError("its end of the connection is closed")
        received, self._received = self._received, []
        return received

    def close(self) -> None:
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
            self._received.append(pickle.loads(head[8 * count :], buffers=pieces))


def _proved(end: socket.socket, *steps: Callable[[Any, bytes], object], key: bytes) -> socket.socket:
    """The socket again, once both ends have proved to each other that they know the key."""
    end.settimeout(None)
    end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", CONNECT_S, 0))
    with Connection(end.detach()) as connection:
        for step in steps:
            step(connection, key)
        return socket.socket(fileno=os.dup(connection.fileno()))


class Client:
    """One connection to a service, for one thread at a time.

    Calls raise `ServiceStoppedError` when the service has failed, or is gone.
    """

    def __init__(self, name: str, address: Address) -> None:
        self.name = name
        end = socket.socket(_family(address.at))
        end.settimeout(CONNECT_S)
        try:
            end.connect(address.at)
            end = _proved(end, answer_challenge, deliver_challenge, key=address.key)
        except (OSError, EOFError, AuthenticationError) as error:
            end.close()
            raise ServiceStoppedError(f"{name} cannot be connected to: {error}") from error
        self._stream = Stream(end)
        self._poll = select.poll()
        self._replies: list[tuple[int, Any]] = []
        self._sent = 0

    def send(self, message: Any) -> int:
        """Send without waiting for a reply; returns a ticket."""
        self._sent += 1
        try:
            self._stream.send((self._sent, time.monotonic(), message))
            deadline = time.monotonic() + SEND_S
            while self._stream.unsent and time.monotonic() < deadline:
                self._advance(SEND_S)
        except OSError as error:
            raise self._gone(error) from error
        self._stream.detach()
        return self._sent

    def done(self, timeout: float) -> list[tuple[int, Any]]:
        """Tickets and replies that have come, each once; waits `timeout` seconds for the first."""
        deadline = time.monotonic() + timeout
        while not self._replies:
            left = deadline - time.monotonic()
            self._advance(max(0.0, left))
            if left <= 0:
                break
        replies, self._replies = self._replies, []
        return replies

    def close(self) -> None:
        """End the connection and forget what is under way. Safe to call twice."""
        self._stream.close()

    def _advance(self, timeout: float) -> None:
        """Wait until the socket can be read or, with something unsent, written; read and write."""
        events = select.POLLIN | (select.POLLOUT if self._stream.unsent else 0)
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


@dataclass(eq=False)
class PendingRequest:
    """A message at the service; answered or failed once, on the thread that polls.

    `sent` is on `time.monotonic`; `gone` tells that the answer is not awaited any more.
    """

    message: Any
    sent: float
    gone: Callable[[], bool]
    reply: Callable[[Any, bool], None]

    def answer(self, reply: Any) -> None:
        if not self.gone():
            self.reply(reply, False)

    def fail(self, error: BaseException) -> None:
        """Raise a `ServiceStoppedError` that names this error at the client."""
        if not self.gone():
            self.reply(str(stopped(error)), True)

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
        self._listener = socket.socket(_family(at))
        self._listener.bind(at)
        self._listener.listen(BACKLOG)
        reached_at = at if isinstance(at, str) else self._listener.getsockname()
        self.address = Address(reached_at, secrets.token_bytes(32))
        self._accepted: queue.SimpleQueue[socket.socket] = queue.SimpleQueue()
        self._woken, self._waker = socket.socketpair()
        for end in (self._woken, self._waker):
            end.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._streams: set[Stream] = set()
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
                while not self._accepted.empty():
                    stream = Stream(self._accepted.get())
                    self._streams.add(stream)
                    self._selector.register(stream, selectors.EVENT_READ)
                continue
            if events & selectors.EVENT_WRITE:
                self._flush(key.fileobj)
            if events & selectors.EVENT_READ:
                requests += self._receive(key.fileobj)
        for request in sorted(requests, key=lambda request: request.sent):
            self._take(request)

    def close(self) -> None:
        """End all connections."""
        self._closed = True
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)  # ends the thread that accepts
        self._listener.close()
        self._close_accepted()
        for stream in list(self._streams):
            self._drop(stream)

    def _accept(self) -> None:
        while True:
            try:
                end, _ = self._listener.accept()
            except OSError:
                if self._closed:
                    return
                time.sleep(0.1)  # such as too many open files
                continue
            # On a thread, as a stranger might connect and then not say a word.
            threading.Thread(target=self._welcome, args=(end,), daemon=True).start()

    def _welcome(self, end: socket.socket) -> None:
        """Take a client in that knows the key."""
        try:
            self._accepted.put(_proved(end, deliver_challenge, answer_challenge, key=self.address.key))
        except (OSError, EOFError, AuthenticationError):
            return  # it does not know the key, or has gone again
        self.wake()
        if self._closed:
            self._close_accepted()

    def _close_accepted(self) -> None:
        """Close connections that `poll` has not taken over."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._accepted.get_nowait().close()

    def _receive(self, stream: Any) -> list[PendingRequest]:
        try:
            messages = stream.receive()
        except (OSError, EOFError):
            self._drop(stream)
            return []
        now = time.monotonic()
        requests = []
        for ticket, sent, message in messages:
            age = now - sent if now - OLDEST_S < sent <= now else 0.0
            requests.append(self._request(stream, ticket, now - age, message))
        return requests

    def _request(self, stream: Stream, ticket: int, sent: float, message: Any) -> PendingRequest:
        def reply(value: Any, failed: bool) -> None:
            try:
                stream.send((ticket, value, failed))
            except OSError:
                self._drop(stream)
                return
            if stream.unsent:
                stream.detach()
                self._selector.modify(stream, selectors.EVENT_READ | selectors.EVENT_WRITE)

        return PendingRequest(message, sent, lambda: stream not in self._streams, reply)

    def _flush(self, stream: Any) -> None:
        try:
            stream.flush()
        except OSError:
            self._drop(stream)
            return
        if not stream.unsent:
            self._selector.modify(stream, selectors.EVENT_READ)

    def _drop(self, stream: Stream) -> None:
        if stream in self._streams:
            self._streams.remove(stream)
            self._selector.unregister(stream)
            stream.close()


def stopped(error: BaseException) -> ServiceStoppedError:
    """The error that a client gets for a failure of the service."""
    return ServiceStoppedError(f"the service has stopped: {error!r}")


def serve_on_loop(answer: Callable[[Any], Awaitable[Any]], host: str | None = None) -> Server:
    """Have a coroutine function answer messages, in tasks of the running event loop."""
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

    server = Server(take, host)
    asyncio.get_running_loop().add_reader(server.fileno(), server.poll, 0.0)
    return server
