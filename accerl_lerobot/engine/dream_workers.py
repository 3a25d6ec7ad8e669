# SPDX-License-Identifier: Apache-2.0
"""The processes that imagine: one or several dream, another learns what they dream with.

    Dreaming      consumes    decisions from inference, real segments from replay, promoted models
                  produces    imagined segments for replay
                  waits for   decisions; and replay, while what it imagined stands at the door
                  outlives    inference: its successor is asked again what has not been answered
    WorldLearning consumes    real segments from replay
                  produces    world models that have passed their trial, for all who dream
                  waits for   real experience

Both end with the process, or when replay says that the run is over. Until a model has passed, batches are
real; from then on the trainer waits for dreams as it does for real segments.
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
from accerl_lerobot.engine.dreaming import make_imagination, make_learner
from accerl_lerobot.experience import Segment
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.metrics import numbered
from accerl_lerobot.timeline import CHECKPOINT, COMPUTE, TRANSPORT, WAIT_IN, WAIT_OUT, WEIGHT_SYNC, open_clock
from accerl_lerobot.transport.endpoint import Endpoint, ReconnectingClient
from accerl_lerobot.world_model.online import Promotion
from accerl_lerobot.world_model.pool import DREAMS, check_workers

if TYPE_CHECKING:
    from accerl_lerobot.engine.config import RunConfig

AT_THE_DOOR = 2
"""Messages to replay that may be waiting before dreams pause."""
LEARNER = "world_learner"
"""Name of its state."""
PAUSE_S = 0.02
"""How long a worker with nothing to do sleeps."""
TAKEN_OVER_S = 30.0
"""How long a promoted model may take to be taken over at most; a moment, unless nobody decides."""
LOOK_S = 0.2
"""How often replay is asked for new real segments."""


class DreamWorker:
    """Becomes a threaded Ray actor in `launch`: `run` on one thread, everything else beside it.

    Args:
        config: the run; its ``policy.path`` must be set.
        state: the ``training_state`` to go on from; None: begin.
        timeline: folder of the timeline; None: none is kept.
        index: which one of `ImaginationConfig.workers` it is.

    Raises:
        InputError: the state is of a run with another number of them.
    """

    def __init__(
        self, config: RunConfig, state: Path | None = None, timeline: Path | None = None, index: int = 0
    ) -> None:
        workers = config.imagination.workers
        name = numbered("dream", workers)[index]
        self._clock = open_clock(timeline, name)
        import torch

        torch.set_num_threads(config.trainer.num_threads)
        self._limit = config.launch.stall_s
        # Inference that hangs is the conductor's to notice, which takes `stall_s`; this is for the worst.
        self._patience_s = 2 * self._limit
        self._share, self._batch = config.imagination.share, config.inference.max_batch
        self._outbox: list[Segment] = []
        self._dreams = make_imagination(config, name.replace(" ", ""), self._outbox.append, index)
        self._index, self._saved = index, f"{DREAMS}{index or ''}"
        self._lock = threading.Lock()
        self._dreaming = threading.Lock()
        """Held while dreams change; outside, nothing stands in the outbox."""
        self._deciding = ReconnectingClient("inference")
        self._promoted: Promotion | None = None
        self._promising = config.imagination.learns
        self._cursor = 0
        if state is not None:
            check_workers(state, workers)
            saved = snapshot.load(state / self._saved)
            self._dreams.restore(saved["dreams"])
            self._cursor = saved["cursor"]
        self._clock.enter(WAIT_IN)

    def ready(self) -> int:
        """Answers once the world model is loaded; returns this process's id."""
        return os.getpid()

    def promote(self, promotion: Promotion) -> None:
        """Dreams of this model from the next chunk on."""
        with self._lock:
            self._promoted = promotion

    def expect(self, promising: bool) -> None:
        """True if another model may be promoted later on."""
        with self._lock:
            self._promising = promising

    def move(self, inference: Endpoint) -> None:
        """From now on inference is there."""
        self._deciding.move(inference)

    def metrics(self) -> dict[str, float]:
        """See `Imagination.metrics`."""
        self._clock.beat()
        return self._dreams.metrics()

    def save(self, directory: Path) -> None:
        """Writes its part of a checkpoint, once it has taken over what was promoted.

        Raises:
            TimeoutError: it hangs.
        """
        began = time.monotonic()
        while self._promoted is not None and time.monotonic() < began + min(TAKEN_OVER_S, self._limit / 2):
            time.sleep(PAUSE_S)
        left = began + self._limit - time.monotonic()
        with _within(left, self._dreaming, "a step of dreams"):
            saved = {"dreams": self._dreams.state(), "cursor": self._cursor}
            snapshot.save(directory / TRAINING_STATE / self._saved, saved)
            if not self._index:  # all dream of the same one
                self._dreams.save_promoted(directory / WORLD_MODEL)

    def run(self, inference: Endpoint, inserting: Endpoint, replay: Any) -> None:
        """Dreams until replay is closed."""
        news, told = _News(replay, self._cursor), None
        deciding, door = self._deciding, inserting.connect()
        deciding.move(inference)
        at_the_door: set[int] = set()
        while not news.closed:
            self._clock.enter(CHECKPOINT)
            with self._dreaming:
                self._clock.enter(COMPUTE)
                promising = self._swap() or self._dreams.prepares
                for segment in news.fresh():
                    self._dreams.remember(segment)
                if news.ended:
                    self._dreams.end_real()
                self._cursor = news.cursor
            # Both at once: a run in which nothing is imagined and nothing expected has nothing to wait for.
            if told != (self._dreams.on, promising):
                told = (self._dreams.on, promising)
                share = self._share if self._dreams.on else 0.0
                ray.get(replay.mix.remote(share, any(told), self._index))
            self._clock.enter(TRANSPORT)
            for ticket, stored in door.done(0.0):
                at_the_door.discard(ticket)
                if not stored:
                    return
            self._clock.enter(COMPUTE)
            with self._dreaming:
                requests = [] if len(at_the_door) >= AT_THE_DOOR else self._dreams.requests()
            if not requests:
                self._clock.enter(WAIT_OUT if len(at_the_door) >= AT_THE_DOOR else WAIT_IN)
                time.sleep(PAUSE_S)
                continue
            parts = [requests[i : i + self._batch] for i in range(0, len(requests), self._batch)]
            self._clock.enter(WAIT_IN)
            answers = deciding.ask(parts, self._patience_s)
            self._clock.enter(CHECKPOINT)
            with self._dreaming:
                self._clock.enter(COMPUTE)
                fault_point("dream.step")
                self._dreams.advance([decision for answer in answers for decision in answer])
                self._clock.enter(TRANSPORT)
                if self._outbox:
                    at_the_door.add(door.send(self._outbox))
                    self._outbox.clear()

    def _swap(self) -> bool:
        """Takes over what was promoted; whether more may come."""
        with self._lock:
            promoted, self._promoted = self._promoted, None
            promising = self._promising
        if promoted is not None:
            self._clock.enter(WEIGHT_SYNC)
            self._dreams.swap(promoted)
            self._clock.enter(COMPUTE)
        return promising


class WorldLearningWorker:
    """Becomes a threaded Ray actor in `launch`: `run` on one thread, everything else beside it.

    Args:
        config: the run; its ``policy.path`` must be set.
        state: the ``training_state`` to go on from; None: begin.
        timeline: folder of the timeline; None: none is kept.
    """

    def __init__(self, config: RunConfig, state: Path | None = None, timeline: Path | None = None) -> None:
        self._clock = open_clock(timeline, "world learning")
        import torch

        torch.set_num_threads(config.trainer.num_threads)
        torch.manual_seed(config.seed)
        self._limit = config.launch.stall_s
        self._learner = make_learner(config)
        self._learning = threading.Lock()
        """Held while it changes, but not during a trial, which is of a copy."""
        self._cursor = 0
        if state is not None:
            saved = snapshot.load(state / LEARNER)
            self._learner.restore(saved["learner"])
            self._cursor = saved["cursor"]
        self._clock.enter(WAIT_IN)

    def ready(self) -> int:
        """Answers once the world model and its dataset are loaded; returns this process's id."""
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

    def run(self, dreamers: list[Any], replay: Any) -> None:
        """Learns until replay is closed."""
        news, learner = _News(replay, self._cursor), self._learner
        promising: bool | None = None
        held: bool | None = None
        """Replay's state as last reported to it; None: nothing by this process."""
        while not news.closed:
            self._clock.enter(TRANSPORT)
            with self._learning:
                for segment in news.fresh():
                    learner.add(segment)
                self._cursor = news.cursor
            last = news.ended
            due = learner.due(last=False) and not last
            if held is not due:
                held = due
                ray.get(replay.hold.remote(held))
            if promising is not learner.promising(last):
                promising = learner.promising(last)
                ray.get([dreamer.expect.remote(promising) for dreamer in dreamers])
            if learner.owed >= 1:
                self._clock.enter(CHECKPOINT)
                with self._learning:
                    self._clock.enter(COMPUTE)
                    fault_point("learning.step")
                    learner.step()
            elif learner.due(last):
                self._clock.enter(COMPUTE)
                if promotion := learner.promote(last):
                    self._clock.enter(WEIGHT_SYNC)
                    promoted = ray.put(promotion)
                    ray.get([dreamer.promote.remote(promoted) for dreamer in dreamers])
                    learner.handed_over()
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
    """News in replay, asked for every now and then and never waited for."""

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
        self._asked, self._next = None, time.monotonic() + LOOK_S
        self.cursor, self.ended, self.closed = news.cursor, news.ended, news.closed
        return list(news.segments)
