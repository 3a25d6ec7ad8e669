# SPDX-License-Identifier: Apache-2.0
"""Weights through Ray's object store, read by processes that hold nothing but a shelf."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import ray

from accerl_lerobot.weights.factory import RayPublisher
from accerl_lerobot.weights.publisher import Publisher, Tensors
from tests.light_workers import light_ray
from tests.weights.contract import CHECKS, Check, filled, values_of

__all__ = ["light_ray"]


class Shelf:
    """A reader process with room for many readers; as slow as it is told to be."""

    def __init__(self) -> None:
        self._received: dict[str, list[tuple[int, Tensors]]] = {}
        self._open = threading.Event()
        self._open.set()

    def shut(self) -> None:
        self._open.clear()

    def open(self) -> None:
        self._open.set()

    def receive(self, name: str, version: int, tensors: Tensors) -> int:
        self._open.wait(60)
        self._received.setdefault(name, []).append((version, tensors))
        return version

    def newest(self, name: str) -> tuple[int, Tensors] | None:
        received = self._received.get(name)
        return received[-1] if received else None

    def versions(self, name: str) -> list[int]:
        return [version for version, _ in self._received.get(name, [])]


class Reader:
    """One name on a shelf, looking like an actor handle with ``receive_weights``."""

    count = 0

    def __init__(self, shelf: Any) -> None:
        Reader.count += 1
        self.shelf, self.name = shelf, f"reader{Reader.count}"
        self.receive_weights = self

    def remote(self, version: int, tensors: Any, published_s: float) -> Any:
        return self.shelf.receive.remote(self.name, version, tensors)

    def newest(self) -> tuple[int, Tensors] | None:
        return ray.get(self.shelf.newest.remote(self.name))

    def versions(self) -> list[int]:
        return ray.get(self.shelf.versions.remote(self.name))


@pytest.fixture(scope="module")
def shelves(light_ray: None) -> Iterator[list[Any]]:
    made = [ray.remote(Shelf).options(num_cpus=0, max_concurrency=4).remote() for _ in range(2)]
    yield made
    for shelf in made:
        ray.kill(shelf)


def until(holds: Callable[[], bool]) -> None:
    """Waits for it, a minute at most."""
    deadline = time.monotonic() + 60
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.005)


class Delivered:
    """The publisher with its reader, as one channel: what is published has arrived."""

    def __init__(self, reader: Any, publisher: Publisher) -> None:
        self.reader, self.publisher = reader, publisher

    def publish(self, version: int, tensors: Tensors) -> None:
        self.publisher.publish(version, tensors)
        self.publisher.flush(60)

    def newest(self) -> tuple[int, Tensors] | None:
        return self.reader.newest()


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_contract(check: Check, shelves: list[Any]):
    check(lambda: Delivered(reader := Reader(shelves[0]), RayPublisher([reader])))


def test_a_slow_reader_skips_versions_and_does_not_hold_up_the_publisher(shelves: list[Any]):
    slow, quick = Reader(shelves[0]), Reader(shelves[1])
    publisher = RayPublisher([slow, quick])
    ray.get(shelves[0].shut.remote())
    publisher.publish(0, filled(0.0))
    until(lambda: quick.versions() == [0])
    for version in range(1, 10):  # would not return if it waited for the reader whose gate is shut
        publisher.publish(version, filled(float(version)))
    until(lambda: quick.versions()[-1] == 9)
    assert slow.versions() == []
    ray.get(shelves[0].open.remote())
    publisher.flush()
    publisher.flush()
    # One set was under way; those between were skipped; the last one was delivered once by `flush`.
    assert slow.versions() == [0, 9]
    assert quick.versions() == sorted(set(quick.versions())) and quick.versions()[-1] == 9
    for reader in (slow, quick):
        found = reader.newest()
        assert found is not None and values_of(found[1]) == {9.0}


def test_what_a_reader_holds_stays_whole_when_many_more_are_published(shelves: list[Any]):
    reader = Reader(shelves[0])
    publisher = RayPublisher([reader])
    buffers = filled(0.0, size=50_000)  # large enough to lie in shared memory
    for version in range(1, 31):
        for tensor in buffers.values():
            tensor[:] = version
        publisher.publish(version, buffers)
    publisher.flush()
    held = ray.get(shelves[0].versions.remote(reader.name))
    assert held == sorted(set(held)) and held[-1] == 30
    found = reader.newest()
    assert found is not None and found[0] == 30 and values_of(found[1]) == {30.0}


def test_a_dead_reader_is_let_go_of_and_another_takes_its_place(light_ray: None, shelves: list[Any]):
    shelf = ray.remote(Shelf).options(num_cpus=0).remote()
    quick = Reader(shelves[0])
    publisher = RayPublisher([Reader(shelf), quick])
    publisher.publish(0, filled(0.0))
    publisher.flush()
    ray.kill(shelf)
    version = 0
    while len(publisher._readers) > 1:
        version += 1
        publisher.publish(version, filled(float(version)))
        publisher.flush(60)
    assert quick.versions() == list(range(version + 1))
    late = Reader(shelves[1])
    publisher.add(late)
    until(lambda: late.versions() == [version])
    publisher.publish(version + 1, filled(version + 1.0))
    publisher.flush(60)
    assert late.versions() == [version, version + 1] and quick.versions()[-1] == version + 1
    publisher.close()


def test_a_reader_that_comes_before_anything_is_published_waits(shelves: list[Any]):
    publisher, reader = RayPublisher([]), Reader(shelves[0])
    publisher.add(reader)
    publisher.flush(0.1)
    publisher.publish(2, filled(2.0))
    publisher.flush(60)
    assert reader.versions() == [2]
    publisher.close()
