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
"""The inference process: one device answers many worlds.

    consumes    requests from rollout workers; published weights
    produces    decisions, each stamped with the version of the weights that made it
    waits for   a full batch, or for the oldest request to have waited `max_wait_s`
    weights     are swapped between batches: no batch ever sees two versions

    ends        with the process; an exception fails every caller that waits or comes later, and ends the run

The event loop only queues and answers; forward passes run on a thread of their own, so requests are
accepted meanwhile.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from accerl_lerobot import snapshot
from accerl_lerobot.checkpoint import WEIGHTS
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Decision, Request
from accerl_lerobot.inference.batcher import Batcher
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.timeline import COMPUTE, TRANSPORT, WAIT_IN, WEIGHT_SYNC, open_clock


@dataclass(frozen=True, kw_only=True)
class InferenceConfig:
    """How decisions are batched."""

    max_batch: int = 16
    """Observations per forward pass at most."""
    max_wait_s: float = 0.002
    """How long the oldest request waits for others, seconds."""
    num_threads: int = 1
    """CPU threads of the forward pass."""

    def __post_init__(self) -> None:
        for name in ("max_batch", "num_threads"):
            if getattr(self, name) < 1:
                raise InputError(f"inference.{name}", getattr(self, name), "use at least 1")
        if not 0 <= self.max_wait_s < 10:
            raise InputError("inference.max_wait_s", self.max_wait_s, "use seconds in [0, 10)")


class ServiceStoppedError(RuntimeError):
    """The caller did nothing wrong: the service behind it had failed, and says why where it failed."""


class _Waiting:
    """Requests of one caller and where their answer goes."""

    def __init__(self, requests: Sequence[Request], future: asyncio.Future[list[Decision]]) -> None:
        self.requests, self.future = requests, future

    def __len__(self) -> int:
        return len(self.requests)


class InferenceWorker:
    """Becomes an asynchronous Ray actor in `launch`.

    Args:
        policy: which checkpoint to load; every inference worker and the trainer load the same one.
        config: batching.
        version: of the weights it begins with.
        state: the ``training_state`` that holds these; None: they are the checkpoint's.
        timeline: folder of the timeline; None: none is kept.
    """

    def __init__(
        self,
        policy: PolicyConfig,
        config: InferenceConfig,
        version: int = 0,
        state: Path | None = None,
        timeline: Path | None = None,
    ) -> None:
        self._clock = open_clock(timeline, "inference")
        import torch

        from accerl_lerobot.policies.loading import load_adapter

        torch.set_num_threads(config.num_threads)
        self._adapter = load_adapter(policy)
        self._batcher: Batcher[_Waiting] = Batcher(config.max_batch, config.max_wait_s)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="forward")
        self._wake = asyncio.Event()
        self._version = version
        if state is not None:
            self._adapter.load_trainable(snapshot.load(state / WEIGHTS))
        self._received = -1
        self._published: tuple[int, dict[str, np.ndarray]] | None = None
        self._failure: BaseException | None = None
        self._busy_s = 0.0
        self._since = time.monotonic()
        self._clock.enter(WAIT_IN)

    async def ready(self) -> int:
        """Answers once the policy is loaded; returns this process's id."""
        return os.getpid()

    async def decide(self, requests: list[Request]) -> list[Decision]:
        """Answers a caller's requests, in order, as part of some batch.

        Raises:
            ServiceStoppedError: `serve` has failed, before or after this call began.
        """
        if self._failure is not None:
            raise _stopped(self._failure)
        waiting = _Waiting(requests, asyncio.get_running_loop().create_future())
        self._batcher.add(waiting, time.monotonic())
        self._wake.set()
        return await waiting.future

    async def receive_weights(self, version: int, tensors: dict[str, np.ndarray]) -> int:
        """Takes a published set; it serves from the next batch on. What is not newer is ignored."""
        if version > self._received:
            self._received = version
            self._published = (version, tensors)
            self._wake.set()
        return version

    async def serve(self) -> None:
        """Serves until the process ends; an exception here ends the run."""
        try:
            while True:
                self._clock.enter(WAIT_IN)
                await self._wait()
                await self._swap()
                if self._batcher.due(time.monotonic()):
                    await self._serve_batch(self._batcher.take(time.monotonic()))
        except BaseException as error:
            self._failure = error
            while batch := self._batcher.take(time.monotonic()):
                _fail(batch, error)
            raise

    async def metrics(self) -> dict[str, float]:
        """Batching statistics, the version served and the busy share since the last call."""
        self._clock.beat()
        now = time.monotonic()
        share, self._busy_s = self._busy_s / max(1e-9, now - self._since), 0.0
        self._since = now
        return {**self._batcher.stats.metrics(), "version": float(self._version), "busy_share": share}

    async def _wait(self) -> None:
        """Returns when a batch is due or weights have arrived.

        The event only says that something may have changed. It is cleared before the state is looked at, and
        nothing runs in between, so a request that arrives at any moment is either seen or sets it again.
        """
        while True:
            self._wake.clear()
            deadline, now = self._batcher.next_deadline(), time.monotonic()
            if self._published is not None or (deadline is not None and now >= deadline):
                return
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._wake.wait(), None if deadline is None else deadline - now)

    async def _swap(self) -> None:
        if self._published is None:
            return
        version, tensors = self._published
        self._published = None
        self._clock.enter(WEIGHT_SYNC)
        await asyncio.get_running_loop().run_in_executor(self._pool, self._adapter.load_trainable, tensors)
        self._version = version

    async def _serve_batch(self, batch: list[_Waiting]) -> None:
        requests = [r for waiting in batch for r in waiting.requests]
        started = time.monotonic()
        self._clock.enter(COMPUTE)
        try:
            decisions = await asyncio.get_running_loop().run_in_executor(
                self._pool, self._adapter.decide, requests, self._version
            )
        except BaseException as error:
            _fail(batch, error)
            raise
        self._busy_s += time.monotonic() - started
        self._clock.enter(TRANSPORT)
        start = 0
        for waiting in batch:
            if not waiting.future.done():  # the caller may have been cancelled meanwhile
                waiting.future.set_result(decisions[start : start + len(waiting)])
            start += len(waiting)


def _stopped(error: BaseException) -> ServiceStoppedError:
    return ServiceStoppedError(f"the inference service has stopped: {error!r}")


def _fail(batch: list[_Waiting], error: BaseException) -> None:
    for waiting in batch:
        if not waiting.future.done():
            waiting.future.set_exception(_stopped(error))
