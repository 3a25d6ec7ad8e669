# SPDX-License-Identifier: Apache-2.0
"""Publishing weights: what readers get, who is waited for, and who is not sent anything any more."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.transport.contract import PendingRequest, ServiceStoppedError
from accerl_lerobot.transport.endpoint import Endpoint
from accerl_lerobot.transport.shared_memory import SharedMemoryServer, available
from accerl_lerobot.transport.weights import PublishDelay, Tensors, WeightPublisher, WeightUpdate
from tests.transport.played import PlayedEndpoint


def filled(value: float, size: int = 4) -> Tensors:
    """Three tensors that all hold `value`: a mixture of two versions shows."""
    return {name: np.full((2, size), value, np.float32) for name in ("a", "b", "c.weight")}


def values_of(tensors: Tensors) -> set[float]:
    return {float(x) for tensor in tensors.values() for x in np.unique(tensor)}


class Reader:
    """Answers when the test says so, or at once."""

    def __init__(self, answers: bool = True) -> None:
        self.answers = answers
        self.received: list[tuple[int, set[float]]] = []
        self.held: list[Future[None]] = []
        self.ended = 0

    @property
    def endpoint(self) -> Endpoint:
        reader = self

        class Here(PlayedEndpoint):
            def kill(self) -> None:
                reader.ended += 1

        return Here(name="inference 1", method=self._take)

    def _take(self, update: WeightUpdate) -> Any:
        self.received.append((update.version, values_of(update.tensors)))
        if self.answers:
            return None
        self.held.append(Future())
        return self.held[-1]

    @property
    def versions(self) -> list[int]:
        return [version for version, _ in self.received]


def test_a_slow_reader_skips_versions_and_holds_nobody_up():
    slow, quick = Reader(answers=False), Reader()
    publisher = WeightPublisher([slow.endpoint, quick.endpoint])
    for version in range(5):
        publisher.publish(version, filled(version))
    assert quick.received == [(version, {float(version)}) for version in range(5)]
    assert slow.versions == [0, 1], "one that it applies, and the next"
    with pytest.raises(TimeoutError, match=r"weights not applied within 0\.1 s by inference 1"):
        publisher.flush(0.1)
    slow.held[0].set_result(None)
    publisher.resend()
    assert slow.received[2:] == [(4, {4.0})] and quick.versions == list(range(5))
    for held in slow.held[1:]:
        threading.Timer(0.1, held.set_result, (None,)).start()
    publisher.flush(30)


def test_a_reader_that_comes_later_gets_the_newest_set_at_once():
    publisher, early, late = WeightPublisher(), Reader(), Reader()
    publisher.add(early.endpoint)
    publisher.flush(30)
    publisher.publish(3, filled(3.0))
    publisher.add(late.endpoint)
    assert early.received == late.received == [(3, {3.0})]


def test_a_reader_that_fails_is_ended_and_the_others_go_on():
    broken, good = Reader(answers=False), Reader()
    publisher = WeightPublisher([broken.endpoint, good.endpoint])
    publisher.publish(1, filled(1.0))
    broken.held[0].set_exception(ServiceStoppedError("it has died"))
    publisher.publish(2, filled(2.0))
    publisher.flush(30)
    assert broken.ended == 1 and broken.versions == [1] and good.versions == [1, 2]


def test_a_reader_that_cannot_be_reached_is_ended():
    ended = []

    class Nowhere(Endpoint):
        def connect(self) -> Any:
            raise ServiceStoppedError("nobody listens there")

        def kill(self) -> None:
            ended.append(self.name)

    publisher = WeightPublisher([Nowhere(name="inference", method=None)])
    publisher.publish(1, filled(1.0))
    assert ended == ["inference"]


@pytest.fixture
def served() -> Iterator[Callable[[Callable[[WeightUpdate], None]], Endpoint]]:
    """Makes endpoints that lead through shared memory to a function on another thread."""
    over = threading.Event()
    servers: list[tuple[SharedMemoryServer, threading.Thread]] = []

    def make(apply: Callable[[WeightUpdate], None]) -> Endpoint:
        def take(asked: PendingRequest) -> None:
            apply(asked.message)
            asked.answer(None)

        server = SharedMemoryServer(take, copy=False)

        def serve() -> None:
            while not over.is_set():
                server.poll(0.05)

        servers.append((server, threading.Thread(target=serve)))
        servers[-1][1].start()
        return Endpoint(name="inference", method=None, address=server.address)

    yield make
    over.set()
    for server, thread in servers:
        thread.join()
        server.close()


@pytest.mark.skipif(not available(), reason="no memfd, epoll and eventfd here")
def test_through_shared_memory_sets_arrive_whole_and_are_copied_when_they_are_published(served):
    seen: list[tuple[int, set[float]]] = []
    sent: Tensors = {
        "weight": np.arange(6, dtype=np.float32).reshape(2, 3),
        "strided": np.arange(12, dtype=np.float64).reshape(3, 4).T,
        "scalar": np.array(0.5, np.float32),
        "empty": np.zeros((0, 3), np.float32),
        "half": np.array([1.5, -2.0], np.float16),
    }

    def apply(update: WeightUpdate) -> None:
        if update.version:
            seen.append((update.version, values_of(update.tensors)))
            return
        assert update.tensors.keys() == sent.keys()
        for name, tensor in sent.items():
            assert update.tensors[name].dtype == tensor.dtype
            np.testing.assert_array_equal(update.tensors[name], tensor)
        seen.append((0, set()))

    publisher = WeightPublisher([served(apply)])
    publisher.publish(0, sent)
    publisher.flush(30)
    tensors = filled(0.0, size=50_000)
    for version in range(1, 31):
        for tensor in tensors.values():
            tensor[:] = version
        publisher.publish(version, tensors)
    publisher.flush(30)
    publisher.close()
    assert seen[0] == (0, set()) and seen[-1] == (30, {30.0})
    assert all(values == {float(version)} for version, values in seen[1:])
    versions = [version for version, _ in seen]
    assert versions == sorted(set(versions))


@pytest.mark.parametrize(
    ("updates", "published"),
    [(0, [[0], [1], [2], [3], [4], [5], [6]]), (2, [[0], [], [], [1], [2], [3], [6]])],
)
def test_each_version_comes_so_many_updates_late_and_the_last_at_once(
    updates: int, published: list[list[int]]
):
    delay = PublishDelay(updates)
    for version, expected in enumerate(published):
        due = delay.push(version, {"w": np.full(1, version)}, last=version == 6)
        assert [number for number, _ in due] == expected
        assert all(int(tensors["w"][0]) == number for number, tensors in due)
