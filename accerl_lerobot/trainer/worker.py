# SPDX-License-Identifier: Apache-2.0
"""The trainer process: the run's clock.

consumes    batches of segments from replay, the next one drawn while the current one is learned from
produces    weights, published after each update without waiting for more than a copy of them;
            to readers that come later as well, even after the last update
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
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.replay.pacing import ASYNCHRONOUS, Schedule
from accerl_lerobot.timeline import CHECKPOINT, COMPUTE, TRANSPORT, WAIT_IN, WEIGHT_SYNC, open_clock
from accerl_lerobot.trainer.batch import save_batch_if_not_finite
from accerl_lerobot.trainer.peers import LearnerSettings, Peers
from accerl_lerobot.transport.endpoint import Endpoint
from accerl_lerobot.transport.weights import PublishDelay, WeightPublisher

FIRST_S = 120.0  # timeout for the first weights to be published
RESEND_S = 0.2  # interval at which busy replicas get the newest weights while the trainer waits for a batch


class TrainerWorker:
    """Becomes a threaded Ray actor in `launch`: `run` on one thread, everything else beside it.

    The run's `directory` is for batches that nothing could be learnt from; `world_model` is the handle of a
    `WorldModelWorker`, where the algorithm learns on its states.
    """

    def __init__(
        self,
        settings: LearnerSettings,
        timeline: Path | None = None,
        peers: Sequence[Any] = (),
        directory: Path | None = None,
        world_model: Any = None,
    ) -> None:
        errors.collect_warnings()
        self._clock = open_clock(timeline, "trainer")
        self._policy, self._config, self._directory = settings.policy, settings.trainer, directory
        self._peers = Peers(peers, self._config, settings.timeout_s)
        self._update = self._peers.begin(settings)
        if world_model is not None:
            from accerl_lerobot.trainer.chunk_critic import ChunkCriticUpdate

            assert isinstance(self._update, ChunkCriticUpdate)
            self._update.learn_states_in(world_model, settings.timeout_s)
        self._lock = threading.Lock()
        self._kept: Any = None
        self._in_turn = False
        self._publisher: WeightPublisher | None = None
        self._publishing = threading.Event()  # set once the first weights have been published
        self._handed_over = -1  # version of the weights that were published last
        self._history: deque[dict[str, float]] = deque()  # filled on one thread, emptied on another
        self._clock.enter(WAIT_IN)

    def ready(self) -> int:
        """Answers once the policy is loaded; returns this process's id."""
        return os.getpid()

    def run(self, replay: Any, readers: list[Endpoint]) -> int:
        """Trains; returns the number of updates made."""
        self._clock.enter(WEIGHT_SYNC)
        publisher = WeightPublisher(readers)
        try:
            # A checkpoint need not hold a critic: all start from this one.
            with self._lock:
                self._publish(publisher, PublishDelay(0), last=False)
            self._publisher = publisher
            self._publishing.set()
            self._train(replay, publisher)
            self._clock.enter(WEIGHT_SYNC)
            publisher.flush()
        except BaseException:
            publisher.close()
            raise
        finally:
            self._clock.enter(WAIT_IN)
        return self._update.version

    def join(self, reader: Endpoint) -> int:
        """Has another replica receive the weights, none older than the version that is returned."""
        if not self._publishing.wait(FIRST_S):
            raise TimeoutError(f"the trainer has published no weights for {FIRST_S:g} s")
        assert self._publisher is not None
        with self._lock:  # the newest set is sent from where it was published from
            self._publisher.add(reader)
            return self._handed_over

    def _train(self, replay: Any, publisher: WeightPublisher) -> None:
        held = PublishDelay(self._config.hold_back)
        n, config = self._config.batch_decisions, self._config
        upcoming = replay.sample.remote(n, self._update.version)
        asked = time.monotonic()
        while self._update.version < config.updates:
            self._clock.enter(WAIT_IN)
            while not ray.wait([upcoming], timeout=RESEND_S)[0]:
                publisher.resend()
            self._clock.enter(TRANSPORT)
            batch, segments = upcoming, ray.get(upcoming)
            if not segments:
                break
            waited = time.monotonic() - asked
            if self._update.version + 1 < config.updates:
                upcoming = replay.sample.remote(n, self._update.version + 1)
            self._clock.enter(CHECKPOINT)
            with self._lock:
                self._clock.enter(COMPUTE)
                started = time.monotonic()
                fault_point("trainer.update")
                with (
                    self._peers.joining("step", batch),
                    save_batch_if_not_finite(self._directory, self._update, segments),
                ):
                    metrics = self._update.step(segments)
                updated = time.monotonic()
                self._clock.enter(WEIGHT_SYNC)
                self._publish(publisher, held, last=self._update.version == config.updates)
                if self._in_turn:
                    publisher.flush()
                metrics |= {"update": float(self._update.version), "wait_s": waited}
                metrics |= {"update_s": updated - started, "publish_s": time.monotonic() - updated}
                self._history.append(metrics)
            asked = time.monotonic()
            replay.learnt.remote()
        with self._lock:
            if self._handed_over < self._update.version:
                # It has ended early, and what is evaluated is to be what is saved.
                self._publish(publisher, held, last=True)

    def _publish(self, publisher: WeightPublisher, held: PublishDelay, last: bool) -> None:
        """Hands the weights of now over, or those that are old enough."""
        adapter = self._update.adapter
        with self._peers.lending("lend_weights"):
            weights = adapter.export_trainable() if self._config.hold_back else adapter.view_trainable()
        for version, tensors in held.push(self._update.version, weights, last=last):
            fault_point("trainer.publish")
            publisher.publish(version, tensors)
            self._handed_over = version

    def metrics(self) -> list[dict[str, float]]:
        """One record per update since the last call."""
        self._clock.beat()
        return [self._history.popleft() for _ in range(len(self._history))]

    def follow(self, schedule: Schedule) -> None:
        """From now on, turns are taken with those who collect like this."""
        self._in_turn = schedule != ASYNCHRONOUS

    def hold(self) -> tuple[int, list[dict[str, float]]]:
        """Keeps a copy of all that is to be saved, as it is between two updates, for `write`.

        Returns its version, and the records up to it that `metrics` has not given.
        """
        with self._lock:
            with self._peers.lending("lend_state"):
                adapter = self._update.adapter
                self._kept = adapter.copy_weights(), adapter.export_trainable(), self._update.state()
            return self._update.version, self.metrics()

    def write(self, directory: Path) -> None:
        """Writes what is kept: ``pretrained_model`` and its part of ``training_state``."""
        (weights, trained, state), self._kept = self._kept, None
        fault_point("trainer.write")
        self._update.adapter.save(directory / PRETRAINED, self._policy, weights)
        snapshot.save(directory / TRAINING_STATE / WEIGHTS, trained)
        snapshot.save(directory / TRAINING_STATE / "trainer", state)
