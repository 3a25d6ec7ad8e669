# SPDX-License-Identifier: Apache-2.0
"""The two ends of what `transport` measures: callers and a service, which are Ray's actors.

All arms are measured in the same processes, by a clock around one call after the other: Ray gives its workers
a lower priority than others have, which on a busy machine is most of what a call costs.
"""

from __future__ import annotations

import mmap
import secrets
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import ray

from accerl_lerobot.engines.ray_session import start_ray
from accerl_lerobot.experience import Decision, Request
from accerl_lerobot.transport.connection import Address, Client, Server
from benchmarks.transport import RAY, SLOT, decision, request_of

LONG_S = 120.0
"""Seconds after which an end counts as hung."""
BEGIN_S = 0.05
"""How long before the first call callers are told when it is."""


class Answering:
    """The service: answers at once, always the same; becomes an asynchronous Ray actor."""

    def __init__(self) -> None:
        self._decision = decision()

    async def listen(self) -> Address:
        """Serves sockets on a thread, as inference does."""
        server = Server(lambda asked: asked.answer([self._decision] * len(asked.message)))

        def serve() -> None:
            while True:
                server.poll(1.0)

        threading.Thread(target=serve, daemon=True).start()
        return server.address

    async def floor(self) -> str:
        """Name of a socket that sends bytes back."""
        name, listener = secrets.token_hex(16), socket.socket(socket.AF_UNIX)
        listener.bind(f"\0{name}")
        listener.listen(1)

        def serve() -> None:
            token, _ = listener.accept()
            while token.recv(1):
                token.send(b"x")

        threading.Thread(target=serve, daemon=True).start()
        return name

    async def decide(self, requests: list[Request]) -> list[Decision]:
        """Ray's way in."""
        return [self._decision] * len(requests)


class Calling:
    """One caller, which becomes a Ray actor; `floor` names the socket of `Answering.floor`, if it has one."""

    def __init__(self, service: Any, address: Address, floor: str | None) -> None:
        self._service, self._client = service, Client("answering", address)
        self._token = None if floor is None else _connected(floor)

    def measure(self, arm: str, size: str, seed: int, calls: int, begin: float) -> tuple[list[float], float]:
        """Seconds of each call, and the moment of the last one's end, on `time.monotonic`."""
        message, seconds = [request_of(size, seed)], []
        if arm == SLOT:
            call = self._slot(message[0])
        elif arm == RAY:
            call = lambda: ray.get(self._service.decide.remote(message), timeout=LONG_S)  # noqa: E731
        else:
            call = lambda: _one(self._client, message)  # noqa: E731
        time.sleep(max(0.0, begin - time.monotonic()))
        for _ in range(calls):
            started = time.perf_counter()
            call()
            seconds.append(time.perf_counter() - started)
        return seconds, time.monotonic()

    def _slot(self, request: Request) -> Callable[[], None]:
        """A copy into shared memory, and a byte there and back."""
        token = self._token
        assert token is not None
        arrays = [value for value in request.observation.values() if isinstance(value, np.ndarray)]
        source = np.concatenate([np.ravel(array).view(np.uint8) for array in arrays])
        target = np.frombuffer(mmap.mmap(-1, len(source)), np.uint8)

        def call() -> None:
            target[:] = source
            token.send(b"x")
            token.recv(1)

        return call


def _connected(name: str) -> socket.socket:
    token = socket.socket(socket.AF_UNIX)
    token.settimeout(LONG_S)
    token.connect(f"\0{name}")
    return token


def _one(caller: Client, message: list[Request]) -> None:
    caller.send(message)
    if not caller.done(LONG_S):
        raise TimeoutError(f"{caller.name}: no decision within {LONG_S:g} s")


class Crowd:
    """A service and so many callers, which send what `seed` gives, while the context lasts."""

    def __init__(self, callers: int, seed: int) -> None:
        self._count, self._seed = callers, seed
        self._started = False

    def __enter__(self) -> Crowd:
        self._started = not ray.is_initialized()
        if self._started:
            start_ray()
        self._service = ray.remote(Answering).options(num_cpus=0, max_concurrency=1000).remote()
        address = ray.get(self._service.listen.remote(), timeout=LONG_S)
        actor = ray.remote(Calling).options(num_cpus=0)
        floor = ray.get(self._service.floor.remote(), timeout=LONG_S)
        self._callers = [
            actor.remote(self._service, address, None if i else floor) for i in range(self._count)
        ]
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
