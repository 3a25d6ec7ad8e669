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
"""The two ends of what `transport` measures: callers and a service as Ray's actors, and peers for the floors.

Every arm is measured in a process of its own, by a clock around one call after the other.
"""

from __future__ import annotations

import mmap
import multiprocessing
import socket
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import ray

from accerl_lerobot.bench.transport import (
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
from accerl_lerobot.experience import Decision, Request
from accerl_lerobot.launch import start_ray
from accerl_lerobot.transport.contract import Caller
from accerl_lerobot.transport.endpoint import Endpoint, listens
from accerl_lerobot.transport.shared_memory import Address, SharedMemoryServer

LONG_S = 120.0
"""What takes that long hangs."""
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

    async def decide(self, requests: list[Request]) -> list[Decision]:
        """Ray's way in."""
        return [self._decision] * len(requests)


class Calling:
    """One caller; becomes a Ray actor."""

    def __init__(self, endpoints: dict[str, Endpoint]) -> None:
        self._callers = {arm: endpoint.connect() for arm, endpoint in endpoints.items()}
        self._method = endpoints[RAY].method

    def measure(self, arm: str, size: str, seed: int, calls: int, begin: float) -> tuple[list[float], float]:
        """Seconds of each call, and the moment of the last one's end, on `time.monotonic`."""
        message = [request_of(size, seed)]
        if arm == RAY_PUT:
            # One that is already in the store is not copied again when a call is made.
            call: Callable[[], Any] = lambda: ray.get(self._method.remote(ray.put(message)), timeout=LONG_S)  # noqa: E731
        else:
            call = lambda: _one(self._callers[arm], message)  # noqa: E731
        time.sleep(max(0.0, begin - time.monotonic()))
        return timed(call, calls), time.monotonic()


def _one(caller: Caller, message: list[Request]) -> Any:
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
    """A service, so many callers and a peer for the floors, while the context lasts.

    Args:
        callers: processes.
        seed: of what is sent.
    """

    def __init__(self, callers: int, seed: int) -> None:
        self._count, self._seed = callers, seed
        self._floors = Floors(decision())
        self._started = False

    def __enter__(self) -> Crowd:
        listens("shared_memory")  # refuses where there is none
        self._started = not ray.is_initialized()
        if self._started:
            start_ray()
        self._service = ray.remote(Answering).options(num_cpus=0, max_concurrency=1000).remote()
        address = ray.get(self._service.listen.remote(), timeout=LONG_S)
        way = {"name": "answering", "method": self._service.decide}
        ends = {RAY: Endpoint(**way), SHARED_MEMORY: Endpoint(**way, address=address)}
        actor = ray.remote(Calling).options(num_cpus=0)
        self._callers = [actor.remote(ends) for _ in range(self._count)]
        self._floors.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._floors.close()
        for actor in (*self._callers, self._service):
            ray.kill(actor)
        if self._started:
            ray.shutdown()

    def measure(self, arm: str, size: str, callers: int, calls: int) -> tuple[list[list[float]], float]:
        """Seconds of each call of each caller, and from the beginning of the first to the end of the last."""
        if arm in FLOORS:
            seconds = self._floors.measure(arm, request_of(size, self._seed), calls)
            return [seconds], sum(seconds)
        begin = time.monotonic() + BEGIN_S
        asked = [
            caller.measure.remote(arm, size, self._seed, calls, begin) for caller in self._callers[:callers]
        ]
        found = ray.get(asked, timeout=LONG_S)
        return [seconds for seconds, _ in found], max(end for _, end in found) - begin


class Floors:
    """What no transport can beat, with a process at the other end that does nothing else."""

    def __init__(self, reply: Decision) -> None:
        self._reply = sum(array.nbytes for array in (reply.chunk, *reply.latent.values(), reply.log_prob))

    def start(self) -> None:
        """Starts the other end."""
        context = multiprocessing.get_context("spawn")
        there, self._to = context.Pipe(duplex=False)
        self._from, back = context.Pipe(duplex=False)
        self._token, token = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._token.settimeout(LONG_S)
        self._memory = mmap.mmap(-1, 1 << 20)
        self._peers = [
            context.Process(target=_reply_to_bytes, args=(there, back, self._reply), daemon=True),
            context.Process(target=_reply_to_tokens, args=(token,), daemon=True),
        ]
        for peer in self._peers:
            peer.start()
        for end in (there, back, token):
            end.close()

    def close(self) -> None:
        """Ends it."""
        for end in (self._to, self._from, self._token):
            end.close()
        for peer in self._peers:
            peer.join(LONG_S)

    def measure(self, arm: str, request: Request, calls: int) -> list[float]:
        """Seconds of each call."""
        source = np.concatenate([np.ravel(array).view(np.uint8) for array in arrays_of(request)])
        target, raw = np.frombuffer(self._memory, np.uint8, len(source)), source.tobytes()
        reply = bytearray(self._reply)

        def pipe() -> None:
            self._to.send_bytes(raw)
            if not self._from.poll(LONG_S):
                raise TimeoutError(f"pipe: no bytes within {LONG_S:g} s")
            self._from.recv_bytes_into(reply)

        def slot() -> None:
            target[:] = source
            self._token.send(b"x")
            self._token.recv(1)

        def memcpy() -> None:
            target[:] = source

        return timed({PIPE: pipe, MEMCPY: memcpy}.get(arm, slot), calls)


def _reply_to_bytes(there: Connection, back: Connection, size: int) -> None:
    buffer, reply = bytearray(1 << 20), bytes(size)
    try:
        while there.poll(LONG_S * 10):
            there.recv_bytes_into(buffer)
            back.send_bytes(reply)
    except (EOFError, OSError):
        return


def _reply_to_tokens(token: socket.socket) -> None:
    token.settimeout(LONG_S * 10)
    while token.recv(1):
        token.send(b"x")
