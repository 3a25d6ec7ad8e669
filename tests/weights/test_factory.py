# SPDX-License-Identifier: Apache-2.0
"""Which transport the trainer takes."""

from __future__ import annotations

import time
from concurrent.futures import Future
from typing import Any

import pytest
import ray as real_ray

from accerl_lerobot.transport.endpoint import Transport
from accerl_lerobot.weights import factory
from accerl_lerobot.weights.factory import RayPublisher, make_publisher
from accerl_lerobot.weights.publisher import monotonic_clock, wall_clock
from accerl_lerobot.weights.shared_memory import Received, SharedMemoryPublisher, SharedMemoryReader
from tests.local_ray import Handle, Local
from tests.weights.contract import filled, values_of


class Ray(Local):
    exceptions = real_ray.exceptions

    @staticmethod
    def get(reference: Future[Any], timeout: float | None = None) -> Any:
        try:
            return Local.get(reference, timeout)
        except TimeoutError as error:
            raise real_ray.exceptions.GetTimeoutError from error


@pytest.fixture(autouse=True)
def _without_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(factory, "ray", Ray)


class Inference:
    """A handle of a worker on this machine, or on another one."""

    def __init__(self, here: bool = True) -> None:
        self.received: list[tuple[int, set[float]]] = []
        self.here = here
        self.handle = Handle(open_weights=self.open, receive_weights=self.receive)

    def open(self, address: str) -> bool:
        if self.here:
            SharedMemoryReader(address, self.apply, lambda error: None)
        return self.here

    def apply(self, received: Received) -> None:
        self.received.append((received.version, values_of(received.tensors)))
        received.release()

    def receive(self, version: int, tensors: Any, published_s: float) -> int:
        self.received.append((version, values_of(tensors)))
        return version


@pytest.mark.parametrize(
    ("here", "transport", "expected"),
    [
        ((True, True), "auto", [SharedMemoryPublisher]),
        ((True, True), "ray", [RayPublisher]),
        ((True, False), "auto", [SharedMemoryPublisher, RayPublisher]),
        ((False, False), "auto", [RayPublisher]),
    ],
)
def test_the_choice(here: tuple[bool, ...], transport: Transport, expected: list[type]):
    workers = [Inference(each) for each in here]
    publisher = make_publisher([worker.handle for worker in workers], transport)
    assert [type(part) for part in publisher.parts] == expected
    publisher.publish(3, filled(3.0))
    publisher.flush(60)
    publisher.close()
    assert [worker.received for worker in workers] == [[(3, {3.0})]] * 2


@pytest.mark.parametrize("transport", ["auto", "ray"])
def test_one_that_joins_is_reached_in_the_same_way(transport: Transport):
    first, late = Inference(), Inference()
    publisher = make_publisher([first.handle], transport)
    publisher.publish(3, filled(3.0))
    publisher.flush(60)
    publisher.add(late.handle)
    publisher.publish(4, filled(4.0))
    while late.received[-1:] != [(4, {4.0})]:
        publisher.flush(60)  # one that has just come may not have been let in
    publisher.close()
    assert first.received == [(3, {3.0}), (4, {4.0})] and late.received in (first.received, [(4, {4.0})])


def test_one_that_cannot_be_reached_does_not_join():
    publisher = make_publisher([Inference().handle])
    with pytest.raises(RuntimeError, match="a restarted worker cannot reach"):
        publisher.add(Inference(here=False).handle)
    publisher.close()


def test_each_reader_has_its_own_way_and_the_slowest_is_named():
    near, far = Inference(), Inference(here=False)
    publisher = make_publisher([near.handle, far.handle])
    for version in (1, 2):
        publisher.publish(version, filled(float(version)))
        publisher.flush(60)
    assert near.received == far.received == [(1, {1.0}), (2, {2.0})]
    silent: Future[int] = Future()
    far.handle.receive_weights = Handle(call=lambda *_: silent).call
    publisher.publish(3, filled(3.0))
    with pytest.raises(TimeoutError, match="version 3, after .* s: not received by readers 0"):
        publisher.flush(0.3)
    assert near.received[-1] == (3, {3.0})
    silent.set_result(3)
    publisher.flush(60)
    publisher.close()
    with pytest.raises(RuntimeError, match="closed"):
        publisher.publish(4, filled(4.0))


def test_a_moment_survives_the_way_to_another_machine_s_clock():
    now = time.monotonic()
    assert abs(monotonic_clock(wall_clock(now - 500)) - (now - 500)) < 60
    assert monotonic_clock(time.time() + 100) <= time.monotonic()  # the other clock is ahead


def test_a_reader_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(factory, "CONNECT_S", 0.1)
    silent: Future[bool] = Future()
    with pytest.raises(TimeoutError, match="has not answered `open_weights` within 0.1 s"):
        make_publisher([Handle(open_weights=lambda address: silent)])
