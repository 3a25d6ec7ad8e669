# SPDX-License-Identifier: Apache-2.0
"""The trainer process: the run's clock.

consumes    batches of segments from replay, the next one drawn while the current one is learned from
produces    weights, published after each update for the replicas that ask, also after the last update
waits for   a batch
ends        after `updates` updates, or when replay is closed
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import ray

from accerl_lerobot import errors
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import PRETRAINED, TRAINING_STATE, WEIGHTS
from accerl_lerobot.experience import Metrics, Segment
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.replay.buffer import ASYNCHRONOUS, Schedule
from accerl_lerobot.timeline import CHECKPOINT, COMPUTE, TRANSPORT, WAIT_IN, WEIGHT_SYNC, open_clock
from accerl_lerobot.trainer.peers import LearnerSettings, Peers
from accerl_lerobot.transport.weights import WeightPublisher


class TrainerWorker:
    """Becomes a threaded Ray actor in `engines.ray_engine`: `run` on one thread, everything else beside it.

    `world_model` is the handle of a `WorldModelWorker`, where the algorithm learns on its states; `readers`
    are the inference replicas; `online` is the handle of an `OnlineLearningWorker`, which gets the batches
    too.
    """

    def __init__(
        self,
        settings: LearnerSettings,
        timeline: Path | None = None,
        peers: Sequence[Any] = (),
        world_model: Any = None,
        readers: Sequence[str] = (),
        online: Any = None,
    ) -> None:
        errors.collect_warnings()
        self._clock = open_clock(timeline, "trainer")
        self._policy = settings.policy
        self._config = settings.trainer
        self._peers = Peers(peers, self._config, settings.timeout_s)
        self._update = self._peers.begin(settings)
        if world_model is not None:
            from accerl_lerobot.algorithms.chunk_critic import ChunkCriticUpdate

            assert isinstance(self._update, ChunkCriticUpdate)
            self._update.learn_states_in(world_model, settings.timeout_s)
        self._online = online
        self._lock = threading.Lock()
        self._kept: Any = None
        self._in_turn = False
        self._publisher = WeightPublisher(readers, ray.put)
        self._history: deque[Metrics] = deque()  # filled on one thread, emptied on another
        self._clock.enter(WAIT_IN)

    def ready(self) -> int:
        """Answers once the policy is loaded; returns this process's id."""
        return os.getpid()

    def run(self, replay: Any) -> int:
        """Train; returns the number of updates made."""
        self._clock.enter(WEIGHT_SYNC)
        # A checkpoint need not hold a critic: all start from this one.
        with self._lock:
            self._publish()
        self._train(replay)
        self._clock.enter(WEIGHT_SYNC)
        self._publisher.flush()
        self._clock.enter(WAIT_IN)
        return self._update.version

    def newer_than(self, reader: str, version: int) -> tuple[int, list[Any]]:
        """The newest weights for a replica that has applied `version`; see `WeightPublisher`."""
        return self._publisher.newer_than(reader, version)

    def _train(self, replay: Any) -> None:
        """Until the last update: take the batch, ask for the next one, step, publish."""
        decisions = self._config.batch_decisions
        updates = self._config.updates
        upcoming = replay.sample.remote(decisions, self._update.version)
        asked = time.monotonic()
        while self._update.version < updates:
            batch = upcoming
            self._clock.enter(WAIT_IN)
            ray.wait([batch], timeout=None)
            self._clock.enter(TRANSPORT)
            segments = ray.get(batch)
            if not segments:
                break
            waited = time.monotonic() - asked
            if self._online is not None:
                self._online.learn.remote(batch)
            if self._update.version + 1 < updates:
                upcoming = replay.sample.remote(decisions, self._update.version + 1)
            self._clock.enter(CHECKPOINT)  # while another thread holds the lock
            with self._lock:
                self._step(batch, segments, waited)
            asked = time.monotonic()
            replay.learnt.remote()

    def _step(self, batch: Any, segments: list[Segment], waited: float) -> None:
        """Make an update on segments, of which `batch` is the reference, and publish its weights."""
        self._clock.enter(COMPUTE)
        started = time.monotonic()
        fault_point("trainer.update")
        with self._peers.joining("step", batch):
            metrics = self._update.step(segments)
        updated = time.monotonic()
        self._clock.enter(WEIGHT_SYNC)
        self._publish()
        if self._in_turn:
            self._publisher.flush()
        metrics["update"] = float(self._update.version)
        metrics["wait_s"] = waited
        metrics["update_s"] = updated - started
        metrics["publish_s"] = time.monotonic() - updated
        self._history.append(metrics)

    def _publish(self) -> None:
        """Hand over the weights of now."""
        with self._peers.gathering("gather_weights"):
            weights = self._update.adapter.view_trainable()
        fault_point("trainer.publish")
        self._publisher.publish(self._update.version, weights)

    def metrics(self) -> list[Metrics]:
        """One record per update since the last call."""
        self._clock.beat()
        return [self._history.popleft() for _ in range(len(self._history))]

    def follow(self, schedule: Schedule) -> None:
        """From now on, turns are taken with those who collect like this."""
        self._in_turn = schedule != ASYNCHRONOUS

    def hold(self) -> tuple[int, list[Metrics]]:
        """Keeps a copy of all that is to be saved, as it is between two updates, for `write`.

        Returns its version, and the records up to it that `metrics` has not given.
        """
        with self._lock:
            with self._peers.gathering("gather_state"):
                adapter = self._update.adapter
                self._kept = adapter.copy_weights(), adapter.export_trainable(), self._update.state()
            return self._update.version, self.metrics()

    def write(self, directory: Path) -> None:
        """Writes what is kept: ``pretrained_model`` and its part of ``training_state``."""
        weights, trained, state = self._kept
        self._kept = None
        fault_point("trainer.write")
        self._update.adapter.save(directory / PRETRAINED, self._policy, weights)
        snapshot.save(directory / TRAINING_STATE / WEIGHTS, trained)
        snapshot.save(directory / TRAINING_STATE / "trainer", state)
