# SPDX-License-Identifier: Apache-2.0
"""The inference service on an event loop of the test's own, with an adapter that only counts."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.experience import TASK, Decision, Request
from accerl_lerobot.inference import worker as inference
from accerl_lerobot.inference.worker import InferenceConfig, InferenceWorker
from accerl_lerobot.policies import loading
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.transport.contract import ServiceStoppedError
from accerl_lerobot.transport.endpoint import Endpoint
from accerl_lerobot.transport.weights import WeightPublisher, WeightUpdate
from tests.runs import HANGS_S

NAMES = ("a", "b", "c")


class CountingAdapter:
    """Weights are three numbers that belong together; reading and writing them takes a while."""

    def __init__(self, delay: float = 0.0) -> None:
        self.delay = delay
        self.weights = dict.fromkeys(NAMES, 0.0)
        self.batches: list[list[int]] = []
        self.loaded: list[int] = []
        self.broken: Exception | None = None
        self.gate: threading.Event | None = None
        self.inside = 0
        self.entered = threading.Event()

    def decide(self, requests: Sequence[Request], version: int) -> list[Decision]:
        self._enter()
        if self.gate is not None:
            assert self.gate.wait(HANGS_S)
        if self.broken is not None:
            raise self.broken
        self.batches.append([r.noise_seed for r in requests])
        answers = []
        for request in requests:
            read = []
            for name in NAMES:
                read.append(self.weights[name])
                time.sleep(self.delay)
            latent = {"seed": np.array(request.noise_seed)}
            zero = np.zeros(1, np.float32)
            answers.append(Decision(chunk=np.array([read]), latent=latent, log_prob=zero, version=version))
        self._leave()
        return answers

    def load_trainable(self, tensors: dict[str, np.ndarray]) -> None:
        self._enter()
        if self.broken is not None:
            raise self.broken
        for name in NAMES:
            self.weights[name] = float(tensors[name])
            time.sleep(self.delay)
        self.loaded.append(int(tensors["a"]))
        self._leave()

    def _enter(self) -> None:
        self.inside += 1
        assert self.inside == 1, "weights were touched while a batch was decided"
        self.entered.set()

    def _leave(self) -> None:
        self.inside -= 1


def requests(*seeds: int) -> list[Request]:
    return [Request(observation={TASK: "push"}, noise_seed=seed) for seed in seeds]


def weights(version: int) -> dict[str, np.ndarray]:
    return {name: np.array(float(version)) for name in NAMES}


def update(version: int) -> WeightUpdate:
    return WeightUpdate(version, weights(version))


Scene = Callable[[InferenceWorker, CountingAdapter], Awaitable[Any]]


@pytest.fixture
def play(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Runs a scene beside a serving worker; a scene that takes so long hangs."""

    def run(scene: Scene, adapter: CountingAdapter | None = None, **config: Any) -> Any:
        adapter = adapter or CountingAdapter()
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


def test_a_lonely_request_is_served_when_it_has_waited(play):
    async def scene(worker, adapter):
        await worker.receive(requests(5))
        assert adapter.batches == [[5]]
        metrics = await worker.metrics()
        assert metrics["wait_mean_s"] >= 0.05 and metrics["batches"] == 1

    play(scene, max_batch=4, max_wait_s=0.05)


def test_answers_go_to_those_who_asked_in_their_order(play):
    async def scene(worker, adapter):
        seeds = [[1, 2, 3], [4], [5, 6], [7, 8], [9]]
        answers = await asyncio.gather(*(worker.receive(requests(*some)) for some in seeds))
        assert [[int(d.latent["seed"]) for d in some] for some in answers] == seeds

    play(scene, max_batch=4, max_wait_s=0.01)


def test_no_batch_sees_two_versions(play):
    """Weights arrive in the middle of every batch; every answer is of one version, the one it states."""
    last = 60

    async def scene(worker, adapter):
        async def publish() -> None:
            for version in range(1, last + 1):
                while len(adapter.batches) < version:
                    await asyncio.sleep(0.0002)
                await worker.receive(update(version))

        async def ask(first: int) -> list[Decision]:
            answers = []
            while worker._version < last:
                answers += await worker.receive(requests(first, first + 1))
            return answers

        _, *answers = await asyncio.gather(publish(), *(ask(10 * i) for i in range(4)))
        return [decision for some in answers for decision in some], adapter.loaded

    answers, loaded = play(scene, CountingAdapter(delay=0.0002), max_batch=4, max_wait_s=0.001)
    for decision in answers:
        assert set(decision.chunk.ravel()) == {decision.version}
    versions = {decision.version for decision in answers}
    assert len(versions) > last / 2 and max(versions) <= last
    assert loaded == sorted(set(loaded)) and loaded[-1] == last


def test_older_weights_are_ignored_even_while_newer_ones_are_loaded(play):
    async def scene(worker, adapter):
        newer = asyncio.create_task(worker.receive(update(4)))
        while not adapter.entered.is_set():
            await asyncio.sleep(0.0005)
        await asyncio.gather(newer, worker.receive(update(3)))  # version 4 is being written just now
        versions = [(await worker.receive(requests(i)))[0].version for i in range(3)]
        assert versions == [4, 4, 4] and adapter.loaded == [4]

    play(scene, CountingAdapter(delay=0.01), max_batch=1, max_wait_s=0.0)


@pytest.mark.parametrize("weights_too", [False, True], ids=["forward pass", "loading weights"])
def test_a_failure_reaches_everyone_who_waits_and_everyone_after(play, weights_too: bool):
    adapter = CountingAdapter()

    async def scene(worker, adapter):
        # A batch holds one request, so that of those who wait only one is in the batch that fails.
        adapter.broken = ValueError("no such weights")
        calls = [worker.receive(update(1))] if weights_too else []
        calls += [worker.receive(requests(i)) for i in range(5)]
        answers = await asyncio.gather(*calls, return_exceptions=True)
        assert all(isinstance(a, ServiceStoppedError) for a in answers), answers
        assert "no such weights" in str(answers[-1])
        with pytest.raises(ServiceStoppedError, match="no such weights"):
            await worker.receive(requests(9))

    play(scene, adapter, max_batch=1, max_wait_s=0.0)


def test_weights_that_cannot_be_loaded_are_heard_of_by_those_who_wait_for_a_batch(play):
    async def scene(worker, adapter):
        worker._batcher.max_wait_s = 1e9
        waiting = [asyncio.create_task(worker.receive(requests(i))) for i in range(2)]
        while len(worker._batcher) < 2:
            await asyncio.sleep(0.001)
        adapter.broken = ValueError("no such weights")
        waiting.append(worker.receive(update(1)))
        answers = await asyncio.gather(*waiting, return_exceptions=True)
        assert all(isinstance(a, ServiceStoppedError) and "no such weights" in str(a) for a in answers)

    play(scene, max_batch=4)


def test_a_caller_who_gave_up_does_not_disturb_the_others(play):
    adapter = CountingAdapter()
    adapter.gate = threading.Event()

    async def scene(worker, adapter):
        quitter = asyncio.create_task(worker.receive(requests(0)))
        patient = asyncio.create_task(worker.receive(requests(1)))
        while not adapter.entered.is_set():
            await asyncio.sleep(0.001)
        quitter.cancel()
        await asyncio.gather(quitter, return_exceptions=True)
        adapter.gate.set()
        assert (await patient)[0].latent["seed"] == 1
        assert (await worker.receive(requests(2)))[0].latent["seed"] == 2

    play(scene, adapter, max_batch=2, max_wait_s=1.0)


class Near(Endpoint):
    """A replica of this process, reached through shared memory; notes that it was ended."""

    ended = False

    def kill(self) -> None:
        object.__setattr__(self, "ended", True)


async def near(worker: InferenceWorker) -> Near:
    return Near(name="inference", method=None, address=await worker.listen())


def test_weights_through_shared_memory_are_swapped_in_and_let_go_of(play):
    async def scene(worker, adapter):
        publisher = WeightPublisher([await near(worker)])
        for version in range(30):
            publisher.publish(version, weights(version))
            await asyncio.to_thread(publisher.flush, HANGS_S)  # applied, though nobody has asked
            (decision,) = await worker.receive(requests(0))
            assert decision.version == version and set(decision.chunk.ravel()) == {version}
        publisher.close()

    play(scene, max_batch=1, max_wait_s=0.0)


def test_a_service_that_fails_is_let_go_of_by_the_trainer(play):
    async def scene(worker, adapter):
        endpoint = await near(worker)
        publisher = WeightPublisher([endpoint])
        adapter.broken = ValueError("no such weights")
        publisher.publish(1, weights(1))
        await asyncio.to_thread(publisher.flush, HANGS_S)
        assert endpoint.ended
        with pytest.raises(ServiceStoppedError, match="no such weights"):
            await worker.receive(requests(0))

    play(scene, max_batch=1)


def test_a_service_that_hangs_is_silent(play, monkeypatch: pytest.MonkeyPatch):
    """Its event loop is fine, and must not answer for the thread that is not."""
    monkeypatch.setattr(inference, "LOOK_S", 0.05)

    async def scene(worker, adapter):
        await worker.metrics()
        adapter.gate = threading.Event()
        asked = asyncio.create_task(worker.receive(requests(1)))
        await asyncio.to_thread(adapter.entered.wait, HANGS_S)
        await asyncio.sleep(0.2)
        answer = asyncio.create_task(worker.metrics())
        await asyncio.sleep(0.3)
        assert not answer.done()
        adapter.gate.set()
        assert (await answer)["batches"] == 1 and await asked

    play(scene, max_batch=1)
