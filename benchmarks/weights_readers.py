# SPDX-License-Identifier: Apache-2.0
"""Processes that receive weights as the inference service does, and note when they had them."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import ray

from accerl_lerobot.engine.ray_session import start_ray
from accerl_lerobot.transport.contract import PendingRequest
from accerl_lerobot.transport.endpoint import Endpoint
from accerl_lerobot.transport.shared_memory import Address, SharedMemoryServer
from accerl_lerobot.transport.weights import WeightUpdate

READY_S = 120.0
"""How long they may take to start, and to answer."""


class ReadingWorker:
    """Becomes a threaded Ray actor; to a publisher it is an inference worker that has nothing to decide."""

    def __init__(self, tensors: int, elements: int) -> None:
        self._parameters = {f"t{i}": np.zeros(elements, np.float32) for i in range(tensors)}
        self._server = SharedMemoryServer(self._take, copy=False)
        self._notes: dict[int, dict[str, float]] = {}
        threading.Thread(target=self._serve, daemon=True).start()

    def ready(self) -> Address:
        """Where it can be reached through shared memory, once it has its memory."""
        return self._server.address

    def decide(self, update: WeightUpdate) -> None:
        """See `InferenceWorker`."""
        self._server.call(update).result()

    def note(self, version: int) -> dict[str, float]:
        """When a set was applied, on `time.monotonic`, how long that took, and its bytes."""
        return self._notes[version]

    def some(self) -> np.ndarray:
        """A few of its values, to be compared."""
        return np.stack([tensor[:: max(1, len(tensor) // 100)] for tensor in self._parameters.values()])

    def _serve(self) -> None:
        while True:
            self._server.poll(1.0)

    def _take(self, asked: PendingRequest) -> None:
        update: WeightUpdate = asked.message
        started = time.monotonic()
        for name, tensor in update.tensors.items():
            np.copyto(self._parameters[name], tensor)
        self._notes[update.version] = {
            "applied_at": time.monotonic(),
            "pause_s": time.monotonic() - started,
            "bytes": float(sum(tensor.nbytes for tensor in update.tensors.values())),
        }
        asked.answer(None)


@contextmanager
def reading(count: int, tensors: int, elements: int) -> Iterator[list[Endpoint]]:
    """Endpoints of so many of them, ready, for `tensors` of `elements` each; they end with the block."""
    if not ray.is_initialized():
        start_ray()
    worker = ray.remote(ReadingWorker).options(num_cpus=0, max_concurrency=4)
    handles = [worker.remote(tensors, elements) for _ in range(count)]
    try:
        yield [
            Endpoint(name=f"reader {i}", method=handle.decide, address=ask(handle, "ready"), actor=handle)
            for i, handle in enumerate(handles)
        ]
    finally:
        for handle in handles:
            ray.kill(handle)


def ask(handle: Any, method: str, *arguments: Any) -> Any:
    """The answer of one of them."""
    try:
        return ray.get(getattr(handle, method).remote(*arguments), timeout=READY_S)
    except ray.exceptions.GetTimeoutError as error:
        raise TimeoutError(f"a reader has not answered `{method}` within {READY_S:g} s") from error
