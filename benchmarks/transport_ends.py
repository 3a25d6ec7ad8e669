# SPDX-License-Identifier: Apache-2.0
"""The two ends of what `transport` measures: callers and a service, which are Ray's actors.

All arms are measured in the same processes, by a clock around one call after the other: Ray gives its workers
a lower priority than others have, which on a busy machine is most of what a call costs.
"""

from __future__ import annotations

import mmap
import os
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import ray

from accerl_lerobot.engine.ray_session import start_ray
from accerl_lerobot.experience import Decision, Request
from accerl_lerobot.transport.contract import Client
from accerl_lerobot.transport.endpoint import Endpoint
from accerl_lerobot.transport.shared_memory import (
    Address,
    SharedMemoryServer,
    listening,
    new_name,
    new_socket,
)
from benchmarks.transport import (
    FLOORS,
    MEMCPY,
    PIPE,
    RAY,
    RAY_PUT,
    SHARED_MEMORY,
    arrays_of,
    decision,
    request_of,
)

LONG_S = 120.0
"""Seconds after which an end counts as hung."""
SIZE = struct.Struct("<Q")
LARGEST = 1 << 20
"""Bytes of an observation at most."""
REPLY = sum(array.nbytes for array in (decision().chunk, *decision().latent.values(), decision().log_prob))
BEGIN_S = 0.05
"""How long before the first call callers are told when it is."""


class Answering:
    """The service: answers at once, always the same; becomes an asynchronous Ray actor."""

    def __init__(self) -> None:
        self._decision = decision()

    async def listen(self) -> Address:
        """Serves shared memory on a thread, as inference does."""
        server = SharedMemoryServer(
            lambda asked: asked.answer([self._decision] * len(asked.message)), copy=False
        )

        def serve() -> None:
            while True:
                server.poll(1.0)

        threading.Thread(target=serve, daemon=True).start()
        return server.address

    async def floor(self) -> str:
        """Where a `Floor` connects to, once."""
        name = new_name()
        listener = listening(name, 1)
        threading.Thread(target=serve_floor, args=(listener,), daemon=True).start()
        return name

    async def decide(self, requests: list[Request]) -> list[Decision]:
        """Ray's way in."""
        return [self._decision] * len(requests)


class Calling:
    """One caller; becomes a Ray actor.

    Args:
        endpoints: of the service, by arm.
        floor: where the floors' other end is; None: they are not measured here.
    """

    def __init__(self, endpoints: dict[str, Endpoint], floor: str | None) -> None:
        self._floor = None if floor is None else Floor(floor)
        self._callers = {arm: endpoint.connect() for arm, endpoint in endpoints.items()}
        self._method = endpoints[RAY].method

    def measure(self, arm: str, size: str, seed: int, calls: int, begin: float) -> tuple[list[float], float]:
        """Seconds of each call, and the moment of the last one's end, on `time.monotonic`."""
        message = [request_of(size, seed)]
        if arm in FLOORS:
            assert self._floor is not None
            call: Callable[[], Any] = self._floor.call(arm, message[0])
        elif arm == RAY_PUT:
            # One that is already in the store is not copied again when a call is made.
            call = lambda: ray.get(self._method.remote(ray.put(message)), timeout=LONG_S)  # noqa: E731
        else:
            call = lambda: _one(self._callers[arm], message)  # noqa: E731
        time.sleep(max(0.0, begin - time.monotonic()))
        return timed(call, calls), time.monotonic()


def _one(caller: Client, message: list[Request]) -> Any:
    caller.send(message)
    replies = caller.done(LONG_S)
    if not replies:
        raise TimeoutError(f"{caller.name}: no decision within {LONG_S:g} s")
    return replies


def timed(call: Callable[[], Any], calls: int) -> list[float]:
    """Seconds of each of so many calls."""
    seconds = []
    for _ in range(calls):
        started = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - started)
    return seconds


class Crowd:
    """A service and so many callers, while the context lasts.

    Args:
        callers: processes.
        seed: of what is sent.
    """

    def __init__(self, callers: int, seed: int) -> None:
        self._count, self._seed = callers, seed
        self._started = False

    def __enter__(self) -> Crowd:
        self._started = not ray.is_initialized()
        if self._started:
            start_ray()
        self._service = ray.remote(Answering).options(num_cpus=0, max_concurrency=1000).remote()
        address = ray.get(self._service.listen.remote(), timeout=LONG_S)
        way = {"name": "answering", "method": self._service.decide}
        ends = {RAY: Endpoint(**way), SHARED_MEMORY: Endpoint(**way, address=address)}
        actor = ray.remote(Calling).options(num_cpus=0)
        floor = ray.get(self._service.floor.remote(), timeout=LONG_S)
        self._callers = [actor.remote(ends, None if i else floor) for i in range(self._count)]
        return self

    def __exit__(self, *_: object) -> None:
        for actor in (*self._callers, self._service):
            ray.kill(actor)
        if self._started:
            ray.shutdown()

    def measure(self, arm: str, size: str, callers: int, calls: int) -> tuple[list[list[float]], float]:
        """Seconds of each call of each caller, and from the beginning of the first to the end of the last."""
        begin = time.monotonic() + BEGIN_S
        asked = [
            caller.measure.remote(arm, size, self._seed, calls, begin) for caller in self._callers[:callers]
        ]
        found = ray.get(asked, timeout=LONG_S)
        return [seconds for seconds, _ in found], max(end for _, end in found) - begin


class Floor:
    """Lower bound of any transport: bare pipes and a bare socket between the same two processes."""

    def __init__(self, name: str) -> None:
        self._token = new_socket()
        self._token.settimeout(LONG_S)
        self._token.connect(f"\0{name}")
        there, self._to = os.pipe()
        self._from, back = os.pipe()
        socket.send_fds(self._token, [b"pipes"], [there, back])
        os.close(there)
        os.close(back)
        self._memory = mmap.mmap(-1, LARGEST)

    def call(self, arm: str, request: Request) -> Callable[[], None]:
        """One call of an arm."""
        source = np.concatenate([np.ravel(array).view(np.uint8) for array in arrays_of(request)])
        target, raw = np.frombuffer(self._memory, np.uint8, len(source)), source.tobytes()
        reply = memoryview(bytearray(REPLY))

        def pipe() -> None:
            os.writev(self._to, [SIZE.pack(len(raw)), raw])
            read_all(self._from, reply)

        def slot() -> None:
            target[:] = source
            self._token.send(b"x")
            self._token.recv(1)

        def memcpy() -> None:
            target[:] = source

        return {PIPE: pipe, MEMCPY: memcpy}.get(arm, slot)


def serve_floor(listener: socket.socket) -> None:
    """The other end of a `Floor`, on threads that end with it."""
    token, _ = listener.accept()
    _, (there, back), _, _ = socket.recv_fds(token, 16, 2)

    def tokens() -> None:
        while token.recv(1):
            token.send(b"x")

    def pipes() -> None:
        head, buffer, reply = memoryview(bytearray(SIZE.size)), memoryview(bytearray(LARGEST)), bytes(REPLY)
        while read_all(there, head):
            read_all(there, buffer[: SIZE.unpack(head)[0]])
            os.write(back, reply)

    for serve in (tokens, pipes):
        threading.Thread(target=serve, daemon=True).start()


def read_all(file: int, into: memoryview) -> bool:
    """Fills it; False at the end of the file."""
    while into:
        count = os.readv(file, [into])
        if not count:
            return False
        into = into[count:]
    return True
