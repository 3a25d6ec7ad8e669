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
"""The trainer process: the run's clock.

consumes    batches of segments from replay, the next one drawn while the current one is learned from
produces    weights, published every `publish_every` updates without waiting for anyone
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

from accerl_lerobot import snapshot
from accerl_lerobot.algorithms import AlgorithmConfig
from accerl_lerobot.checkpoint import PRETRAINED, TRAINING_STATE, WEIGHTS
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.trainer.config import TrainerConfig
from accerl_lerobot.trainer.peers import Learner, Peers
from accerl_lerobot.weights.held_back import HeldBack
from accerl_lerobot.weights.ray_channel import RayPublisher


class TrainerWorker:
    """Becomes a threaded Ray actor in `launch`: `run` on one thread, everything else beside it.

    Args:
        policy: the checkpoint to start from.
        algorithm: the objective.
        config: the optimiser.
        seed: of torch's global generator.
        state: the ``training_state`` to go on from; None: begin.
        peers: handles of the other ranks.
    """

    def __init__(
        self,
        policy: PolicyConfig,
        algorithm: AlgorithmConfig,
        config: TrainerConfig,
        seed: int,
        state: Path | None = None,
        peers: Sequence[Any] = (),
    ) -> None:
        self._policy, self._config = policy, config
        self._peers = Peers(peers, config)
        self._update = self._peers.begin(Learner(policy, algorithm, config, seed, state))
        self._lock = threading.Lock()
        self._kept: Any = None
        self._history: deque[dict[str, float]] = deque()  # filled on one thread, emptied on another

    def ready(self) -> int:
        """Answers once the policy is loaded; returns this process's id."""
        return os.getpid()

    def run(self, replay: Any, readers: list[Any]) -> int:
        """Trains; returns the number of updates made."""
        publisher, held = RayPublisher(readers), HeldBack(self._config.hold_back)
        n, config = self._config.batch_decisions, self._config
        # A checkpoint need not hold a critic: all start from this one.
        publisher.publish(self._update.version, self._export())
        upcoming = replay.sample.remote(n, self._update.version)
        while self._update.version < config.updates:
            asked = time.monotonic()
            batch, segments = upcoming, ray.get(upcoming)
            if not segments:
                break
            waited = time.monotonic() - asked
            if self._update.version + 1 < config.updates:
                upcoming = replay.sample.remote(n, self._update.version + 1)
            with self._lock:
                started = time.monotonic()
                with self._peers.joining("step", batch):
                    metrics = self._update.step(segments)
                updated = time.monotonic()
                version = self._update.version
                if config.publishes(version):
                    for due in held.push(version, self._export(), last=version == config.updates):
                        publisher.publish(*due)
                metrics |= {
                    "update": float(self._update.version),
                    "wait_s": waited,
                    "update_s": updated - started,
                    "publish_s": time.monotonic() - updated,
                }
                self._history.append(metrics)
        version = self._update.version
        if version < config.updates and (config.hold_back or not config.publishes(version)):
            # It has ended early, and what is evaluated is to be what is saved.
            for due in held.push(version, self._export(), last=True):
                publisher.publish(*due)
        publisher.flush()
        return self._update.version

    def metrics(self) -> list[dict[str, float]]:
        """One record per update since the last call."""
        return [self._history.popleft() for _ in range(len(self._history))]

    def hold(self) -> tuple[int, list[dict[str, float]]]:
        """Keeps a copy of all that is to be saved, as it is between two updates, for `write`.

        Returns:
            Its version, and the records up to it that `metrics` has not given.
        """
        from accerl_lerobot.policies.loading import copy_weights

        with self._lock:
            with self._peers.lending("lend_state"):
                adapter = self._update.adapter
                self._kept = copy_weights(adapter), adapter.export_trainable(), self._update.state()
            return self._update.version, self.metrics()

    def write(self, directory: Path) -> None:
        """Writes what is kept: ``pretrained_model`` and its part of ``training_state``."""
        from accerl_lerobot.policies.loading import save_pretrained

        (weights, trained, state), self._kept = self._kept, None
        save_pretrained(self._update.adapter, directory / PRETRAINED, self._policy, weights)
        snapshot.save(directory / TRAINING_STATE / WEIGHTS, trained)
        snapshot.save(directory / TRAINING_STATE / "trainer", state)

    def _export(self) -> dict[str, Any]:
        with self._peers.lending("lend_weights"):
            return self._update.adapter.export_trainable()
