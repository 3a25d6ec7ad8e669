# SPDX-License-Identifier: Apache-2.0
"""The inference process: one device answers many environments.

consumes    requests for decisions, and the newest weights that the trainer has published
produces    decisions, each stamped with the version of its weights
waits for   a full batch, or until its oldest request has waited `max_wait_s`
ends        with the run. An exception ends `serve` and all connections; the driver then kills the process,
            and Ray starts another. Its only state is weights, except in ``accerl eval`` of a policy that
            keeps something between decisions

Weights are swapped in between batches, so no batch sees two versions. One thread waits for clients and for
the batcher's clock at once, runs the forward pass and replies. Ray's calls and weights come in on the event
loop beside it.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from accerl_lerobot import errors
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import WEIGHTS
from accerl_lerobot.config.ranges import Range, Section, Threads
from accerl_lerobot.experience import Decision, Metrics, Request, Tensors
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.inference.batcher import Batcher
from accerl_lerobot.policies.config import Load, PolicyConfig, loader
from accerl_lerobot.timeline import COMPUTE, TRANSPORT, WAIT_IN, WEIGHT_SYNC, open_clock
from accerl_lerobot.transport import RETRY_S, Address, PendingRequest, Server, node_address

LOOK_S = 1.0  # longest wait of the serving thread before it checks whether it should end


@dataclass(frozen=True, kw_only=True)
class InferenceConfig(Section, section="inference"):
    """Batching of decisions."""

    workers: Annotated[int, Range("[1, 1000]")] = 1
    """Inference replicas, each with a copy of the policy; worker i asks replica i modulo their number."""
    max_batch: Annotated[int, Range("[1, 65536]")] = 16
    """Largest number of observations per forward pass."""
    max_wait_s: Annotated[float, Range("[0, 10)")] = 0.002
    """How long the oldest request waits for others, seconds."""
    num_threads: Threads = 1
    """CPU threads of the forward pass."""


class InferenceWorker:
    """Becomes an asynchronous Ray actor in `engines.ray_engine`."""

    def __init__(
        self,
        policy: PolicyConfig,
        config: InferenceConfig,
        version: int = 0,
        state: Path | None = None,
        load: Load | None = None,
        timeline: Path | None = None,
        name: str = "inference",
        in_cluster: bool = False,
    ) -> None:
        errors.collect_warnings()
        self._name = name
        self._clock = open_clock(timeline, name)
        import torch

        torch.set_num_threads(config.num_threads)
        self._adapter = loader(load)(policy)
        self._batcher: Batcher[PendingRequest] = Batcher(config.max_batch, config.max_wait_s)
        self._server = Server(self._add, node_address(in_cluster))
        self._version = version  # of the weights, for decisions; that of the checkpoint at first
        self._applied_version = -1  # newest version of the trainer's that has been applied
        if state is not None:
            self._adapter.load_trainable(snapshot.load(state / WEIGHTS))
        self._waiting_weights: deque[tuple[int, Tensors]] = deque(maxlen=1)  # used from the next batch on
        self._applied = asyncio.Event()
        self._following: asyncio.Task[None] | None = None
        self._lock_step: deque[int] = deque(maxlen=1)
        self._over = False
        self._turn_began: float | None = None  # when the serving loop's last turn began, while it runs
        self._busy_s = 0.0  # time in forward passes
        self._reported = time.monotonic(), 0.0  # when `metrics` was called last, and the busy time then
        self._clock.enter(WAIT_IN)

    async def ready(self, trainer: Any = None) -> int:
        """Loads the newest weights of the `trainer`, if it has published any; returns the process id."""
        if trainer is not None:
            version, references = await trainer.next_weights.remote(self._name, -1)
            if references:
                self._adapter.load_trainable(await references[0])
                self._version = self._applied_version = version
        return os.getpid()

    async def listen(self) -> Address:
        return self._server.address

    async def follow(self, trainer: Any) -> None:
        """Use the weights of a trainer from now on, the newest whenever those before have been applied."""
        self._loop = asyncio.get_running_loop()
        if self._following is not None:
            self._following.cancel()
        self._following = asyncio.create_task(self._follow(trainer))

    async def _follow(self, trainer: Any) -> None:
        # Not above: a config is read before Ray is imported.
        from ray.exceptions import ActorUnavailableError, RayError

        with contextlib.suppress(RayError):  # a lost trainer is the engine's to deal with
            while True:
                try:
                    version, references = await trainer.next_weights.remote(self._name, self._applied_version)
                except ActorUnavailableError:  # for a moment, as when a connection breaks
                    await asyncio.sleep(RETRY_S)
                    continue
                if references:
                    self._applied.clear()
                    self._waiting_weights.append((version, await references[0]))
                    self._server.wake()
                    await self._applied.wait()
                    self._applied_version = version

    async def lock_step(self, observations: int) -> None:
        self._lock_step.append(observations)
        self._server.wake()

    async def serve(self) -> None:
        """Serve until the process ends, or raise the serving thread's exception."""
        try:
            await asyncio.to_thread(self._serve)
        finally:
            self._over = True
            self._server.wake()

    async def metrics(self) -> Metrics:
        """Numbers for `merge_metrics`.

        Does not answer while the serving thread is stuck, which the driver takes for a hang after
        ``launch.stall_s``.
        """
        while self._turn_began is not None and time.monotonic() - self._turn_began > 2 * LOOK_S:
            await asyncio.sleep(0.1)
        self._clock.beat()
        since, busy_before = self._reported
        now = time.monotonic()
        busy = self._busy_s
        self._reported = now, busy
        share = (busy - busy_before) / max(1e-9, now - since)
        return self._batcher.counts | {"version": float(self._version), "busy_share": share}

    def _serve(self) -> None:
        try:
            while not self._over:
                self._turn_began = time.monotonic()
                self._clock.enter(WAIT_IN)
                deadline = self._batcher.next_deadline()
                wait = LOOK_S
                if deadline is not None:
                    wait = max(0.0, deadline - time.monotonic())
                self._server.poll(wait)
                if self._lock_step:
                    self._batcher.lock_step(self._lock_step.popleft())
                self._swap()
                if self._batcher.due(time.monotonic()):
                    self._serve_batch(self._batcher.take(time.monotonic()))
        finally:
            self._turn_began = None
            self._server.close()  # clients learn at once that their requests will not be answered

    def _add(self, request: PendingRequest) -> None:
        self._batcher.add(request, request.sent)

    def _swap(self) -> None:
        """Use the weights that have come."""
        if not self._waiting_weights:
            return
        version, tensors = self._waiting_weights.popleft()
        self._clock.enter(WEIGHT_SYNC)
        self._adapter.load_trainable(tensors)
        self._version = version
        fault_point("inference.swapped")
        self._loop.call_soon_threadsafe(self._applied.set)

    def _serve_batch(self, batch: list[PendingRequest]) -> None:
        """Decide for all observations of the batch, and answer each message with its decisions."""
        batch = [pending for pending in batch if not pending.gone()]
        requests: list[Request] = []
        for pending in batch:
            requests += pending.message
        started = time.monotonic()
        self._clock.enter(COMPUTE)
        broken = fault_point("inference.batch")
        decisions: list[Decision] = []
        if requests:
            decisions = self._adapter.decide(requests, self._version)
        if broken:
            for decision in decisions:
                decision.log_prob.fill(np.nan)
        self._busy_s += time.monotonic() - started
        self._clock.enter(TRANSPORT)
        start = 0
        for pending in batch:
            pending.answer(decisions[start : start + len(pending)])
            start += len(pending)
