# SPDX-License-Identifier: Apache-2.0
"""The replay process, between rollout workers and the trainer.

consumes    segments from rollout workers, and the trainer's notes that a batch has been learned from
produces    batches for the trainer, and a line of the journal for each real segment
waits for   in `insert`, until rollouts are not too far ahead; in `sample`, for enough that is new; and where
            the schedule says so, each waits for the other
ends        with `close`, which ends all waits, or with an exception in storing or drawing
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path

import numpy as np

from accerl_lerobot import errors
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.experience import Metrics, Segment
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.replay.buffer import ASYNCHRONOUS, SYNCHRONOUS, Replay, ReplayConfig, Schedule
from accerl_lerobot.replay.journal import EPISODES, Journal
from accerl_lerobot.timeline import CHECKPOINT, COMPUTE, WAIT_IN, open_clock
from accerl_lerobot.transport import Address, Server, node_address, serve_on_loop, stopped


class ReplayWorker:
    """Becomes an asynchronous Ray actor in `engines.ray_engine`."""

    def __init__(
        self,
        config: ReplayConfig,
        seed: int,
        state: Path | None = None,
        directory: Path | None = None,
        timeline: Path | None = None,
        in_cluster: bool = False,
    ) -> None:
        errors.collect_warnings()
        self._clock = open_clock(timeline, "replay")
        journal = None
        if directory is not None:
            journal = Journal(directory / EPISODES)
        self._replay = Replay(config, journal)
        self._rng = np.random.default_rng(seed)
        self._changed = asyncio.Condition()
        self._schedule: Schedule = ASYNCHRONOUS
        self._learning = 0  # batches drawn of which the trainer has not handed over the weights
        self._batch = 0  # decisions the trainer asked for last
        self._closed = False
        self._failure: Exception | None = None
        self._in_cluster = in_cluster
        self._server: Server | None = None
        if state is not None:
            saved = snapshot.load(state / "replay")
            self._replay.restore(saved["replay"])
            self._rng.bit_generator.state = saved["rng"]
        self._clock.enter(WAIT_IN)

    async def ready(self) -> int:
        return os.getpid()

    async def listen(self) -> Address:
        """Where `insert` is reached by other processes."""
        if self._server is None:
            self._server = serve_on_loop(self.insert, node_address(self._in_cluster))
        return self._server.address

    async def run(self) -> None:
        """Lasts until `close`. The engine learns of this process's death by an earlier end."""
        async with self._changed:
            await self._changed.wait_for(lambda: self._closed or self._failure is not None)
            if self._failure is not None:
                raise self._failure

    async def insert(self, segments: list[Segment]) -> bool:
        """Stores segments once the pace allows it; returns when more may be collected.

        False when the run is over and they were not stored. A `ServiceStoppedError` if storing has failed,
        now or before; `run` says why.
        """
        async with self._changed:
            await self._changed.wait_for(lambda: self._closed or self._replay.may_insert())
            if self._closed:
                return False
            with self._working():
                for segment in segments:
                    fault_point("replay.insert")
                    self._replay.insert(segment)
            await self._changed.wait_for(lambda: self._closed or self._may_collect())
        return True

    async def sample(self, num_decisions: int, trainer_version: int) -> list[Segment]:
        """A batch once the pace allows it; empty when the run is over, or nothing will come any more."""

        def ended() -> bool:
            return self._closed or self._replay.exhausted(num_decisions)

        self._batch = num_decisions
        async with self._changed:
            while True:
                await self._changed.wait_for(lambda: ended() or self._may_draw())
                if ended():
                    return []
                with self._working():
                    fault_point("replay.sample")
                    segments = self._replay.sample(num_decisions, trainer_version, self._rng)
                if segments:
                    self._learning += 1
                    return segments

    async def learnt(self) -> None:
        """Note that the trainer has learned from a batch and handed over its weights.

        Only schedules in which both sides take turns look at it. Draws are counted in `sample`.
        """
        async with self._changing():
            self._learning -= 1

    async def set_schedule(self, schedule: Schedule) -> None:
        async with self._changing():
            self._schedule = schedule

    async def end(self) -> None:
        """Note that no segment will come any more."""
        async with self._changing():
            self._replay.ended = True

    async def close(self) -> None:
        async with self._changing():
            self._closed = True

    async def save(self, directory: Path, version: int) -> None:
        """Writes its part of ``training_state``, as it was when the trainer had made `version` updates."""
        if self._failure is not None:  # a segment may be stored that the journal could not take
            raise self._failure
        self._clock.enter(CHECKPOINT)
        fault_point("replay.save")
        state = {"replay": self._replay.state(version), "rng": self._rng.bit_generator.state}
        self._clock.enter(WAIT_IN)
        await asyncio.to_thread(snapshot.save, directory / "replay", state)

    async def metrics(self) -> Metrics:
        self._clock.beat()
        return self._replay.metrics()

    def _has_batch(self) -> bool:
        return self._batch > 0 and self._replay.may_sample(self._batch)

    def _may_collect(self) -> bool:
        """True if rollouts may go on. Where not, a batch is ready or learned from, and an update follows."""
        if self._schedule == ASYNCHRONOUS:
            return True
        if self._schedule == SYNCHRONOUS:
            return not self._has_batch() and self._learning == 0
        return not self._has_batch() or self._learning == 0

    def _may_draw(self) -> bool:
        return self._has_batch() and (self._schedule == ASYNCHRONOUS or self._learning <= 0)

    @asynccontextmanager
    async def _changing(self) -> AsyncIterator[None]:
        async with self._changed:
            yield
            self._changed.notify_all()

    @contextmanager
    def _working(self) -> Iterator[None]:
        """An exception inside is this worker's failure, and not that of the caller."""
        if self._failure is not None:
            raise stopped(self._failure)
        self._clock.enter(COMPUTE)
        try:
            yield
        except Exception as error:
            self._failure = error
            raise stopped(error) from error
        finally:
            self._clock.enter(WAIT_IN)
            self._changed.notify_all()
