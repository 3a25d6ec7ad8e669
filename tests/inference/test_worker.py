# SPDX-License-Identifier: Apache-2.0
"""The inference service on an event loop of the test's own; dynamic batching with the test's own clock."""

import asyncio
import os
import threading
import time
from collections.abc import Awaitable, Callable, Sequence
from contextlib import closing
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.experience import TASK, Decision, Request
from accerl_lerobot.inference import worker as inference
from accerl_lerobot.inference.batcher import Batcher, merge_metrics
from accerl_lerobot.inference.worker import InferenceConfig, InferenceWorker
from accerl_lerobot.policies import loading
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.trainer import worker as trainer_worker
from accerl_lerobot.trainer.worker import WeightPublisher
from accerl_lerobot.transport import Client, ServiceStoppedError
from tests.runs import HANGS_S


class CountingAdapter:
    """Its weight is one number; deciding takes a while, before and after which it looks at it."""

    def __init__(self, delay: float = 0.0) -> None:
        self.delay = delay
        self.weight = 0.0
        self.batches = 0
        self.loaded: list[int] = []
        self.broken: Exception | None = None
        self.gate: threading.Event | None = None
        self.entered = threading.Event()

    def decide(self, requests: Sequence[Request], version: int) -> list[Decision]:
        self.entered.set()
        if self.gate is not None:
            assert self.gate.wait(HANGS_S)
        if self.broken is not None:
            raise self.broken
        before = self.weight
        time.sleep(self.delay)
        self.batches += 1
        seen = np.array([[before, self.weight]])
        return [Decision(chunk=seen, latent={}, log_prob=seen[0], version=version) for _ in requests]

    def load_trainable(self, tensors: dict[str, Any]) -> None:
        if self.broken is not None:
            raise self.broken
        self.weight = tensors["w"]
        self.loaded.append(tensors["w"])


class Trainer:
    def __init__(self) -> None:
        self._publisher = WeightPublisher(["inference"], put=lambda tensors: tensors)
        self.next_weights = SimpleNamespace(remote=self._next_weights)

    def publish(self, version: int) -> None:
        self._publisher.publish(version, {"w": version})

    async def wait_until_applied(self) -> None:
        await asyncio.to_thread(self._publisher.wait_until_applied, HANGS_S)

    async def _next_weights(self, reader: str, version: int) -> tuple[int, list[Any]]:
        found, references = await asyncio.to_thread(self._publisher.next_weights, reader, version)
        return found, [asyncio.sleep(0, tensors) for tensors in references]


async def ask(worker: InferenceWorker) -> list[Decision]:
    """Decisions for two requests, over a connection of their own."""
    address = await worker.listen()

    def asked() -> list[Decision]:
        with closing(Client("inference", address)) as client:
            client.send([Request(observation={TASK: "push"}, noise_seed=seed) for seed in range(2)])
            ((_, decisions),) = client.done(HANGS_S)
        return decisions

    return await asyncio.to_thread(asked)


@pytest.fixture
def play(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Runs a scene beside a serving worker; a scene that takes so long hangs."""

    def run(scene: Callable[..., Awaitable[Any]], delay: float = 0.0, **config: Any) -> Any:
        adapter = CountingAdapter(delay)
        monkeypatch.setattr(trainer_worker, "ASK_S", 0.05)
        monkeypatch.setattr(loading, "load_adapter", lambda policy: adapter)

        async def main() -> Any:
            worker = InferenceWorker(PolicyConfig(path="nowhere", device="cpu"), InferenceConfig(**config))
            serving = asyncio.create_task(worker.serve())
            try:
                return await asyncio.wait_for(scene(worker, adapter), HANGS_S)
            finally:
                serving.cancel()
                await asyncio.gather(serving, return_exceptions=True)

        return asyncio.run(main())

    return run


def test_no_batch_sees_two_versions(play):
    """Weights arrive in the middle of every batch; every answer is of one version, the one it states."""
    last = 40

    async def scene(worker, adapter):
        trainer = Trainer()
        await worker.follow(trainer)

        async def publish() -> None:
            for version in range(1, last + 1):
                while adapter.batches < version:
                    await asyncio.sleep(0.0002)
                trainer.publish(version)
                await trainer.wait_until_applied()

        async def decide() -> list[Decision]:
            answers: list[Decision] = []
            while not answers or answers[-1].version < last:
                answers += await ask(worker)
            return answers

        _, *answers = await asyncio.gather(publish(), *(decide() for _ in range(3)))
        found = [(set(decision.chunk.ravel()), decision.version) for some in answers for decision in some]
        assert all(weights == {version} for weights, version in found)
        assert len({version for _, version in found}) > last / 2
        assert adapter.loaded == list(range(1, last + 1))

    play(scene, delay=0.002, max_batch=4, max_wait_s=0.001)


def test_a_process_that_comes_later_is_ready_with_the_newest_weights(play):
    async def scene(worker, adapter):
        trainer = Trainer()
        trainer.publish(3)
        assert await worker.ready(trainer) == os.getpid() and adapter.loaded == [3]
        assert [decision.version for decision in await ask(worker)] == [3, 3]
        await worker.follow(trainer)
        trainer.publish(4)
        await trainer.wait_until_applied()
        assert adapter.loaded == [3, 4]

    play(scene)


@pytest.mark.parametrize("broken", ["decision", "weights"])
def test_a_failure_reaches_all_that_wait_and_all_that_come_after(play, broken: str):
    async def scene(worker, adapter):
        trainer = Trainer()
        await worker.follow(trainer)
        waiting = [asyncio.create_task(ask(worker)) for _ in range(5)]
        while broken == "weights" and not len(worker._batcher):
            await asyncio.sleep(0.001)
        adapter.broken = ValueError("no such weights")
        if broken == "weights":
            trainer.publish(1)
        answers = await asyncio.gather(*waiting, return_exceptions=True)
        assert all(isinstance(a, ServiceStoppedError) for a in answers), answers
        with pytest.raises(ServiceStoppedError):
            await ask(worker)

    # A batch holds one message, so that only one is in the batch that fails; or all wait.
    size, wait_s = (2, 0.0) if broken == "decision" else (99, 9.0)
    play(scene, max_batch=size, max_wait_s=wait_s)


def test_a_service_that_hangs_is_silent(play, monkeypatch: pytest.MonkeyPatch):
    """Its event loop is fine, and must not answer for the thread that is not."""
    monkeypatch.setattr(inference, "LOOK_S", 0.05)

    async def scene(worker, adapter):
        await worker.metrics()
        adapter.gate = threading.Event()
        asked = asyncio.create_task(ask(worker))
        await asyncio.to_thread(adapter.entered.wait, HANGS_S)
        await asyncio.sleep(0.2)
        answer = asyncio.create_task(worker.metrics())
        await asyncio.sleep(0.3)
        assert not answer.done()
        adapter.gate.set()
        assert (await answer)["batches"] == 1 and await asked

    play(scene, max_batch=1)


WAIT = 0.01


def test_a_batch_that_cannot_grow_is_full_and_the_clock_goes_on_with_the_rest() -> None:
    batcher: Batcher[str] = Batcher(4, WAIT)  # a request's characters are its observations
    batcher.add("abc", now=0.0)
    assert not batcher.due(now=0.0) and len(batcher) == 1
    batcher.add("de", now=0.004)
    assert batcher.due(now=0.005)
    assert batcher.take(now=0.005) == ["abc"]
    assert batcher.next_deadline() == 0.004 + WAIT
    assert not batcher.due(now=WAIT) and batcher.due(now=0.004 + WAIT)
    batcher.add("f", now=0.005)  # younger than the oldest, which sets the clock
    assert batcher.next_deadline() == 0.004 + WAIT
    batcher.add("too many", now=0.005)
    assert [batcher.take(now=0.005) for _ in range(3)] == [["de", "f"], ["too many"], []]


def test_counts_of_all_replicas_are_merged() -> None:
    batcher: Batcher[str] = Batcher(4, WAIT)
    for request, now in (("ab", 0.0), ("cd", 1.0), ("e", 3.0)):
        batcher.add(request, now)
    for now in (3.0, 4.0, 9.0):
        batcher.take(now)  # at last nothing is there: not a batch
    assert batcher.counts == {"batches": 2, "requests": 3, "observations": 5, "waited_s": 3 + 2 + 1}
    busy = batcher.counts | {"version": 7.0, "busy_share": 0.2}
    idle = Batcher(4, WAIT).counts | {"version": 6.0, "busy_share": 0.6}
    means = {"batches": 2, "batch_size_mean": 2.5, "wait_mean_s": 2.0, "version": 6.0, "busy_share": 0.4}
    assert merge_metrics([busy, idle]) == pytest.approx(means)
    assert merge_metrics([]) == {}


def test_in_lock_step_all_are_waited_for_and_served_in_as_many_batches_as_they_need() -> None:
    batcher: Batcher[str] = Batcher(2, WAIT)
    batcher.lock_step(5)
    batcher.add("ab", now=0.0)
    batcher.add("cd", now=1.0)  # a full batch waits for those that are not here
    assert not batcher.due(now=1e6) and batcher.next_deadline() is None
    batcher.add("e", now=2.0)
    assert batcher.due(now=2.0)
    assert batcher.take(now=2.0) == ["ab"]
    batcher.add("f", now=2.0)  # of the next round
    for rest in ("cd", "e"):
        assert batcher.due(now=2.0) and batcher.take(now=2.0) == [rest]
    assert not batcher.due(now=1e6) and len(batcher) == 1
