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
from pathlib import Path
from typing import Any

import ray

from accerl_lerobot import snapshot
from accerl_lerobot.algorithms import AlgorithmConfig
from accerl_lerobot.checkpoint import PRETRAINED, TRAINING_STATE, WEIGHTS
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.timeline import CHECKPOINT, COMPUTE, TRANSPORT, WAIT_IN, WEIGHT_SYNC, open_clock
from accerl_lerobot.trainer.config import TrainerConfig
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
        timeline: folder of the timeline; None: none is kept.
    """

    def __init__(
        self,
        policy: PolicyConfig,
        algorithm: AlgorithmConfig,
        config: TrainerConfig,
        seed: int,
        state: Path | None = None,
        timeline: Path | None = None,
    ) -> None:
        self._clock = open_clock(timeline, "trainer")
        import torch

        from accerl_lerobot.policies.loading import load_adapter
        from accerl_lerobot.trainer.update import Update

        torch.set_num_threads(config.num_threads)
        torch.manual_seed(seed)
        self._policy, self._config = policy, config
        adapter = load_adapter(policy)
        self._update = Update(adapter, algorithm, config)
        if state is not None:
            adapter.load_trainable(snapshot.load(state / WEIGHTS))
            self._update.restore(snapshot.load(state / "trainer"))
        self._lock = threading.Lock()
        self._kept: Any = None
        self._history: deque[dict[str, float]] = deque()  # filled on one thread, emptied on another
        self._clock.enter(WAIT_IN)

    def ready(self) -> int:
        """Answers once the policy is loaded; returns this process's id."""
        return os.getpid()

    def run(self, replay: Any, readers: list[Any]) -> int:
        """Trains; returns the number of updates made."""
        publisher, held = RayPublisher(readers), HeldBack(self._config.hold_back)
        n, config = self._config.batch_decisions, self._config
        # A checkpoint need not hold a critic: all start from this one.
        self._clock.enter(WEIGHT_SYNC)
        publisher.publish(self._update.version, self._export())
        upcoming = replay.sample.remote(n, self._update.version)
        while self._update.version < config.updates:
            asked = time.monotonic()
            self._clock.enter(WAIT_IN)
            ray.wait([upcoming])
            self._clock.enter(TRANSPORT)
            segments = ray.get(upcoming)
            if not segments:
                break
            waited = time.monotonic() - asked
            if self._update.version + 1 < config.updates:
                upcoming = replay.sample.remote(n, self._update.version + 1)
            self._clock.enter(CHECKPOINT)
            with self._lock:
                self._clock.enter(COMPUTE)
                started = time.monotonic()
                metrics = self._update.step(segments)
                updated = time.monotonic()
                self._clock.enter(WEIGHT_SYNC)
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
        self._clock.enter(WEIGHT_SYNC)
        publisher.flush()
        self._clock.enter(WAIT_IN)
        return self._update.version

    def metrics(self) -> list[dict[str, float]]:
        """One record per update since the last call."""
        self._clock.beat()
        return [self._history.popleft() for _ in range(len(self._history))]

    def hold(self) -> tuple[int, list[dict[str, float]]]:
        """Keeps a copy of all that is to be saved, as it is between two updates, for `write`.

        Returns:
            Its version, and the records up to it that `metrics` has not given.
        """
        from accerl_lerobot.policies.loading import copy_weights

        with self._lock:
            self._kept = copy_weights(self._update.adapter), self._export(), self._update.state()
            return self._update.version, self.metrics()

    def write(self, directory: Path) -> None:
        """Writes what is kept: ``pretrained_model`` and its part of ``training_state``."""
        from accerl_lerobot.policies.loading import save_pretrained

        (weights, trained, state), self._kept = self._kept, None
        save_pretrained(self._update.adapter, directory / PRETRAINED, self._policy, weights)
        snapshot.save(directory / TRAINING_STATE / WEIGHTS, trained)
        snapshot.save(directory / TRAINING_STATE / "trainer", state)

    def _export(self) -> dict[str, Any]:
        return self._update.adapter.export_trainable()
