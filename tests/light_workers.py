# SPDX-License-Identifier: Apache-2.0
"""Workers that start in no time because they hold no policy."""

import asyncio
import json
import logging
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import TRAINING_STATE
from accerl_lerobot.experience import Decision, Request
from accerl_lerobot.inference.batcher import Batcher
from accerl_lerobot.rollout.worker import Report, RolloutWorker
from accerl_lerobot.trainer.worker import LearnerSettings, WeightPublisher
from accerl_lerobot.transport import Address, Server, ServiceStoppedError, node_address, serve_on_loop

HANGS = "hangs"  # a folder that whoever writes into it hangs
FULL = "full"  # a folder that nothing can be written into


class LightInference:
    """Answers at once with noise drawn from each request's seed; breaks on request."""

    def __init__(self, *arguments: Any) -> None:
        self._name, in_cluster = arguments[-2:]
        self._host = node_address(in_cluster)
        self._broken: asyncio.Future[None] = asyncio.get_event_loop().create_future()
        self._version = 0
        self._server: Server | None = None
        self._serving = asyncio.Event()

    async def ready(self, trainer: Any = None) -> int:
        if trainer is not None:
            version, _ = await trainer.next_weights.remote(self._name, -1)
            self._version = max(0, version)
        return os.getpid()

    async def follow(self, trainer: Any) -> None:
        async def follow(version: int) -> None:
            while True:
                version, _ = await trainer.next_weights.remote(self._name, version)
                self._version = max(0, version)

        self._following = asyncio.create_task(follow(-1))

    async def serve(self) -> None:
        self._serving.set()
        await self._broken

    async def listen(self) -> Address:
        if self._server is None:
            self._server = serve_on_loop(self.decide, self._host)
        return self._server.address

    async def fail(self) -> None:
        self._broken.set_exception(ArithmeticError("the forward pass fell over"))

    async def decide(self, requests: list[Request]) -> list[Decision]:
        await self._serving.wait()
        if self._broken.done():
            raise ServiceStoppedError("the inference service has stopped")
        return [_decision(request, self._version) for request in requests]

    async def metrics(self) -> dict[str, float]:
        return Batcher(1, 0.0).counts | {"busy_share": 0.0, "version": float(self._version)}


def _decision(request: Request, version: int) -> Decision:
    chunk = np.random.default_rng(request.noise_seed).uniform(-1, 1, (4, 2)).astype(np.float32)
    return Decision(chunk=chunk, latent={"x": chunk}, log_prob=np.zeros(4, np.float32), version=version)


class WarningRollout(RolloutWorker):
    """Warns when it begins and at each report, in equal words."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        logging.getLogger("accerl_lerobot.envs").warning("info has no %s", "is_success")

    def report(self, *arguments: Any) -> Report:
        logging.getLogger("accerl_lerobot.envs").warning("info has no is_success")
        logging.getLogger("somebody.else").warning("noise")
        return super().report(*arguments)


class LightTrainer:
    """Takes batches and learns nothing from them but what they were; idles on request."""

    def __init__(self, settings: LearnerSettings, *others: Any) -> None:
        self._config, state = settings.trainer, settings.state
        self._records: list[dict[str, float]] = []
        self._lock = threading.Lock()
        self._idle = False
        self._publisher = WeightPublisher(others[-2], put=lambda tensors: None)
        self._ledger: list[dict[str, int]] = []  # keys of each update's segments, and their decisions
        if state is not None:
            self._ledger = snapshot.load(state / "trainer")["ledger"]

    def ready(self) -> int:
        return os.getpid()

    def idle(self) -> None:
        self._idle = True

    def run(self, replay: Any) -> int:
        import ray

        publisher = self._publisher
        publisher.publish(len(self._ledger), {})
        n = self._config.batch_decisions
        upcoming = replay.sample.remote(n, len(self._ledger))
        while len(self._ledger) < self._config.updates:
            while self._idle:
                time.sleep(0.05)
            segments = ray.get(upcoming)
            upcoming = replay.sample.remote(n, len(self._ledger) + 1)
            time.sleep(0.02)
            with self._lock:
                self._ledger.append({segment.key: len(segment) for segment in segments})
                version = len(self._ledger)
                self._records.append({"update": float(version)})
            publisher.publish(version, {})
            publisher.wait_until_applied()
        return self._config.updates

    def next_weights(self, reader: str, version: int) -> tuple[int, list[Any]]:
        return self._publisher.next_weights(reader, version)

    def metrics(self) -> list[dict[str, float]]:
        return self.copy_state()[1]

    def copy_state(self) -> tuple[int, list[dict[str, float]]]:
        with self._lock:
            records, self._records = self._records, []
            self._kept = list(self._ledger)
        return len(self._kept), records

    def write(self, directory: Path) -> None:
        if directory.name == HANGS:
            os.kill(os.getpid(), signal.SIGSTOP)
        if directory.name == FULL:
            raise OSError("no space left on the device")
        snapshot.save(directory / TRAINING_STATE / "trainer", {"ledger": self._kept})
        (directory / TRAINING_STATE / "training_step.json").write_text(json.dumps({"step": len(self._kept)}))
