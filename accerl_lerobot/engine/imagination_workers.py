# SPDX-License-Identifier: Apache-2.0
"""The process that imagines, and the one that trains its world model.

    Imagination   consumes    decisions from inference, real segments from replay, promoted models
                  produces    imagined segments for replay
                  waits for   decisions; and replay, while segments are pending there
                  outlives    inference: unanswered requests go to its successor
    WorldLearning consumes    real segments from replay
                  produces    world models that have passed validation, for imagination
                  waits for   real experience

Both end with the process, or when replay says that the run is over. Until a model has passed, batches are
real; from then on the trainer waits for imagined segments as it does for real ones.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import ray

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import TRAINING_STATE, WORLD_MODEL
from accerl_lerobot.engine.imagination import make_imagination, make_learner
from accerl_lerobot.experience import Segment
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.timeline import CHECKPOINT, COMPUTE, TRANSPORT, WAIT_IN, WAIT_OUT, WEIGHT_SYNC, open_clock
from accerl_lerobot.transport.endpoint import Endpoint, ReconnectingClient
from accerl_lerobot.world_model.config import IMAGINATION, WORLD_LEARNING
from accerl_lerobot.world_model.online import Promotion

if TYPE_CHECKING:
    from accerl_lerobot.engine.config import RunConfig

MAX_PENDING = 2
"""Messages to replay that may be pending before imagination pauses."""
LEARNER = "world_learner"
"""Name of the learner's state."""
PAUSE_S = 0.02
"""Sleep of a worker with nothing to do."""
SWAP_S = 30.0
"""Largest wait of a checkpoint for a promoted model to be taken over."""
POLL_S = 0.2
"""Interval at which replay is asked for new real segments."""


class ImaginationWorker:
    """Becomes a threaded Ray actor in `launch`: `run` on one thread, everything else beside it.

    Args:
        config: of the run; its ``policy.path`` must be set.
        state: the ``training_state`` to resume from; None: begin.
        timeline: folder of the timeline; None: none is kept.
    """

    def __init__(self, config: RunConfig, state: Path | None = None, timeline: Path | None = None) -> None:
        self._clock = open_clock(timeline, IMAGINATION)
        import torch

        torch.set_num_threads(config.trainer.num_threads)
        self._limit = config.launch.stall_s
        # The engine notices inference that hangs after `stall_s`; this is in case it does not.
        self._patience_s = 2 * self._limit
        self._share, self._batch = config.imagination.share, config.inference.max_batch
        self._outbox: list[Segment] = []
        self._imagination = make_imagination(config, self._outbox.append)
        self._lock = threading.Lock()
        self._imagining = threading.Lock()
        """Held while the imagination changes; outside, the outbox is empty."""
        self._deciding = ReconnectingClient("inference")
        self._promoted: Promotion | None = None
        self._may_promote = config.imagination.learns
        self._cursor = 0
        if state is not None:
            saved = snapshot.load(state / IMAGINATION)
            self._imagination.restore(saved["imagination"])
            self._cursor = saved["cursor"]
        self._clock.enter(WAIT_IN)

    def ready(self) -> int:
        """Returns this process's id once the world model is loaded."""
        return os.getpid()

    def promote(self, promotion: Promotion) -> None:
        """Uses this model from the next chunk on."""
        with self._lock:
            self._promoted = promotion

    def expect(self, may_promote: bool) -> None:
        """Notes whether another model may be promoted."""
        with self._lock:
            self._may_promote = may_promote

    def move(self, inference: Endpoint) -> None:
        """Sends requests to this endpoint from now on."""
        self._deciding.move(inference)

    def metrics(self) -> dict[str, float]:
        """See `Imagination.metrics`."""
        self._clock.beat()
        return self._imagination.metrics()

    def save(self, directory: Path) -> None:
        """Writes its part of a checkpoint, once it has taken over what was promoted.

        Raises:
            TimeoutError: it hangs.
        """
        began = time.monotonic()
        while self._promoted is not None and time.monotonic() < began + min(SWAP_S, self._limit / 2):
            time.sleep(PAUSE_S)
        left = began + self._limit - time.monotonic()
        with _within(left, self._imagining, "an imagination step"):
            saved = {"imagination": self._imagination.state(), "cursor": self._cursor}
            snapshot.save(directory / TRAINING_STATE / IMAGINATION, saved)
            self._imagination.save_promoted(directory / WORLD_MODEL)

    def run(self, inference: Endpoint, inserting: Endpoint, replay: Any) -> None:
        """Imagines until replay is closed."""
        news, reported = _News(replay, self._cursor), None
        deciding, connection = self._deciding, inserting.connect()
        deciding.move(inference)
        pending: set[int] = set()
        while not news.closed:
            self._clock.enter(CHECKPOINT)
            with self._imagining:
                self._clock.enter(COMPUTE)
                may_promote = self._swap()
                for segment in news.fresh():
                    self._imagination.remember(segment)
                self._cursor = news.cursor
            # Both at once: a run that imagines nothing and expects no model has nothing to wait for.
            if reported != (self._imagination.on, may_promote):
                reported = (self._imagination.on, may_promote)
                share = self._share if self._imagination.on else 0.0
                ray.get(replay.mix.remote(share, any(reported)))
            self._clock.enter(TRANSPORT)
            for ticket, stored in connection.done(0.0):
                pending.discard(ticket)
                if not stored:
                    return
            self._clock.enter(COMPUTE)
            with self._imagining:
                requests = [] if len(pending) >= MAX_PENDING else self._imagination.requests()
            if not requests:
                self._clock.enter(WAIT_OUT if len(pending) >= MAX_PENDING else WAIT_IN)
                time.sleep(PAUSE_S)
                continue
            parts = [requests[i : i + self._batch] for i in range(0, len(requests), self._batch)]
            self._clock.enter(WAIT_IN)
            answers = deciding.ask(parts, self._patience_s)
            self._clock.enter(CHECKPOINT)
            with self._imagining:
                self._clock.enter(COMPUTE)
                fault_point("imagination.step")
                self._imagination.advance([decision for answer in answers for decision in answer])
                self._clock.enter(TRANSPORT)
                if self._outbox:
                    pending.add(connection.send(self._outbox))
                    self._outbox.clear()

    def _swap(self) -> bool:
        """Takes over what was promoted; True if more may come."""
        with self._lock:
            promoted, self._promoted = self._promoted, None
            may_promote = self._may_promote
        if promoted is not None:
            self._clock.enter(WEIGHT_SYNC)
            self._imagination.swap(promoted)
            self._clock.enter(COMPUTE)
        return may_promote


class WorldLearningWorker:
    """Becomes a threaded Ray actor in `launch`: `run` on one thread, everything else beside it.

    Args:
        config: of the run; its ``policy.path`` must be set.
        state: the ``training_state`` to resume from; None: begin.
        timeline: folder of the timeline; None: none is kept.
    """

    def __init__(self, config: RunConfig, state: Path | None = None, timeline: Path | None = None) -> None:
        self._clock = open_clock(timeline, WORLD_LEARNING)
        import torch

        torch.set_num_threads(config.trainer.num_threads)
        torch.manual_seed(config.seed)
        self._limit = config.launch.stall_s
        self._learner = make_learner(config)
        self._learning = threading.Lock()
        """Held while the learner changes, but not during a validation, which is of a copy."""
        self._cursor = 0
        if state is not None:
            saved = snapshot.load(state / LEARNER)
            self._learner.restore(saved["learner"])
            self._cursor = saved["cursor"]
        self._clock.enter(WAIT_IN)

    def ready(self) -> int:
        """Returns this process's id once the world model and its datasets are loaded."""
        return os.getpid()

    def metrics(self) -> dict[str, float]:
        """See `OnlineLearner.metrics`."""
        self._clock.beat()
        return self._learner.metrics()

    def save(self, directory: Path) -> None:
        """Writes its part of ``training_state``.

        Raises:
            TimeoutError: it hangs.
        """
        with _within(self._limit, self._learning, "a step of learning"):
            saved = {"learner": self._learner.state(), "cursor": self._cursor}
        snapshot.save(directory / TRAINING_STATE / LEARNER, saved)

    def run(self, imaginer: Any, replay: Any) -> None:
        """Trains until replay is closed."""
        news, learner = _News(replay, self._cursor), self._learner
        may_promote: bool | None = None
        hold: bool | None = None
        """As last reported to replay."""
        while not news.closed:
            self._clock.enter(TRANSPORT)
            with self._learning:
                for segment in news.fresh():
                    learner.add(segment)
                self._cursor = news.cursor
            last = news.ended
            due = learner.validation_due(last=False) and not last
            if hold is not due:
                hold = due
                ray.get(replay.hold.remote(hold))
            if may_promote is not learner.may_promote(last):
                may_promote = learner.may_promote(last)
                ray.get(imaginer.expect.remote(may_promote))
            if learner.pending_steps >= 1:
                self._clock.enter(CHECKPOINT)
                with self._learning:
                    self._clock.enter(COMPUTE)
                    fault_point("learning.step")
                    learner.step()
            elif learner.validation_due(last):
                self._clock.enter(COMPUTE)
                if promotion := learner.promote(last):
                    self._clock.enter(WEIGHT_SYNC)
                    ray.get(imaginer.promote.remote(promotion))
                    learner.mark_served()
            else:
                self._clock.enter(WAIT_IN)
                time.sleep(PAUSE_S)


@contextmanager
def _within(seconds: float, lock: threading.Lock, what: str) -> Iterator[None]:
    """Holds a lock that others hold for a moment.

    Raises:
        TimeoutError: one of them has held it for so long.
    """
    if not lock.acquire(timeout=seconds):
        remedy = "raise launch.stall_s if one takes that long"
        raise TimeoutError(f"{what} has not ended for {seconds:.0f} s or more; {remedy}")
    try:
        yield
    finally:
        lock.release()


class _News:
    """New real segments in replay, polled without waiting."""

    def __init__(self, replay: Any, cursor: int) -> None:
        self._replay, self._asked, self._next = replay, None, 0.0
        self.cursor = cursor
        self.ended = self.closed = False

    def fresh(self) -> list[Segment]:
        """Real segments that have come since."""
        if self._asked is None:
            if time.monotonic() < self._next:
                return []
            self._asked = self._replay.news.remote(self.cursor)
        done, _ = ray.wait([self._asked], timeout=0)
        if not done:
            return []
        news = ray.get(self._asked)
        self._asked, self._next = None, time.monotonic() + POLL_S
        self.cursor, self.ended, self.closed = news.cursor, news.ended, news.closed
        return list(news.segments)
