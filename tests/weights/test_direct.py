# SPDX-License-Identifier: Apache-2.0
"""Weights by gloo: the contract; who dies, who is late, what is torn; by loopback and by an address."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import psutil
import pytest
import ray

from accerl_lerobot.transport.meeting import LOOPBACK, Meeting, host, visit
from accerl_lerobot.weights import direct, pair
from accerl_lerobot.weights.channel import Tensors
from accerl_lerobot.weights.choice import Publishers, join, make_publisher
from accerl_lerobot.weights.direct import Coming, DirectPublisher, DirectReader
from accerl_lerobot.weights.pair import PUBLISHES, READS, Pair
from accerl_lerobot.weights.slab import Layout
from tests.light_workers import light_ray
from tests.weights.contract import CHECKS, Check, filled, values_of
from tests.weights.test_ray_channel import Delivered, until

__all__ = ["light_ray"]

LARGE = 200_000
"""Elements of each of three tensors, together more than sockets keep."""
SMALL = 1 << 16
"""Bytes of a piece; both ends have to agree."""


class Library:
    """A process with room for many readers; as slow as it is told to be."""

    def __init__(self) -> None:
        self._readers: dict[str, DirectReader] = {}
        self._received: dict[str, list[tuple[int, Tensors]]] = {}
        self._node = str(ray.get_runtime_context().get_node_id())
        self._open = threading.Event()
        self._open.set()
        self._bites = False

    def shut(self, bites: bool = False) -> None:
        """From now on it receives nothing, or a piece of each set."""
        self._bites = bites
        self._open.clear()

    def piece(self, size: int) -> None:
        pair.PIECE = size

    def open(self) -> None:
        self._open.set()

    def node(self) -> str:
        return self._node

    def move(self, node: str) -> None:
        self._node = node

    def meet(self, name: str, meeting: Meeting) -> None:
        if name == "stranger":
            raise ConnectionError("no way there")
        self._readers[name] = DirectReader(meeting, lambda _: None)

    def receive(self, name: str, coming: Coming) -> int:
        if self._bites:
            self._readers[name]._pair.receive(np.empty(SMALL, np.uint8))
            self._bites = False
        self._open.wait(60)
        received = self._readers[name].take(coming, lambda: None)
        copies = {n: np.array(t) for n, t in received.tensors.items()}
        for copy in copies.values():
            copy.flags.writeable = False
        self._received.setdefault(name, []).append((received.version, copies))
        return received.version

    def part(self, name: str) -> None:
        """Loses the connection, and lives."""
        self._readers[name]._pair.close()

    def newest(self, name: str) -> tuple[int, Tensors] | None:
        received = self._received.get(name)
        return received[-1] if received else None

    def versions(self, name: str) -> list[int]:
        return [version for version, _ in self._received.get(name, [])]


class Bound:
    """``method.remote(...)`` of something that has a name."""

    def __init__(self, method: Any, name: str) -> None:
        self._method, self._name = method, name

    def remote(self, *arguments: Any) -> Any:
        return self._method.remote(self._name, *arguments)


class Reader:
    """One name in a library, looking like an actor handle."""

    count = 0

    def __init__(self, library: Any, name: str = "") -> None:
        Reader.count += 1
        self.library, self.name = library, name or f"reader{Reader.count}"
        self.node = library.node
        self.meet_publisher = Bound(library.meet, self.name)
        self.receive_directly = Bound(library.receive, self.name)

    def newest(self) -> tuple[int, Tensors] | None:
        return ray.get(self.library.newest.remote(self.name))

    def versions(self) -> list[int]:
        return ray.get(self.library.versions.remote(self.name))


def library() -> Any:
    return ray.remote(Library).options(num_cpus=0, max_concurrency=8).remote()


@pytest.fixture(scope="module")
def libraries(light_ray: None) -> Iterator[list[Any]]:
    made = [library(), library()]
    yield made
    for each in made:
        ray.kill(each)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_contract(check: Check, libraries: list[Any]):
    check(lambda: Delivered(reader := Reader(libraries[0]), DirectPublisher([reader])))


def test_a_set_without_any_values_arrives(libraries: list[Any]):
    reader = Reader(libraries[0])
    channel = Delivered(reader, DirectPublisher([reader]))
    channel.publish(1, {})
    channel.publish(2, {"a": np.zeros((0, 3), np.float32)})
    found = channel.newest(than=1)
    assert found is not None and found[0] == 2 and found[1]["a"].shape == (0, 3)


def test_a_slow_reader_skips_versions_and_holds_up_nobody(libraries: list[Any]):
    slow, quick = Reader(libraries[0]), Reader(libraries[1])
    publisher = DirectPublisher([slow, quick])
    ray.get(libraries[0].shut.remote())
    for version in range(10):  # would not return if it waited for the reader whose gate is shut
        publisher.publish(version, filled(float(version), LARGE))
        until(lambda version=version: quick.versions()[-1:] == [version])
    assert slow.versions() == []
    with pytest.raises(TimeoutError, match=r"version 9, after 0.2 s: not applied by readers 0$"):
        publisher.flush(0.2)
    ray.get(libraries[0].open.remote())
    publisher.flush(60)
    # One set was under way; those between were skipped.
    assert slow.versions() == [0, 9] and quick.versions() == list(range(10))
    found = slow.newest()
    assert found is not None and values_of(found[1]) == {9.0}
    publisher.close()
    with pytest.raises(RuntimeError, match="closed"):
        publisher.publish(10, filled(10.0))
    with pytest.raises(RuntimeError, match="closed"):
        publisher.add(Reader(libraries[0]))


@pytest.mark.parametrize("bites", [False, True], ids=["before", "amid"])
def test_one_that_dies_with_bytes_under_way_is_let_go_of_and_another_takes_its_place(
    bites: bool, light_ray: None, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(pair, "PIECE", SMALL)
    dying, other = library(), library()
    for each in (dying, other):
        ray.get(each.piece.remote(SMALL))
    ray.get(dying.shut.remote(bites))
    quick = Reader(other)
    publisher = make_publisher([Reader(dying)], "ray", way="gloo")
    assert isinstance(publisher, DirectPublisher)
    publisher.publish(1, filled(1.0, LARGE))
    (lost,) = publisher._readers
    until(lambda: lost.under_way is not None)
    time.sleep(0.3)  # a piece arrives
    ray.kill(dying)
    publisher.flush(60)
    until(lambda: lost.pair._group is None)
    assert publisher._readers == [] and lost.pair._under_way == []
    join(publisher, quick)
    until(lambda: quick.versions()[-1:] == [1])
    publisher.publish(2, filled(2.0))
    publisher.flush(60)
    assert quick.versions()[-2:] == [1, 2]
    publisher.close()
    ray.kill(other)


def test_pieces_arrive_in_their_order(libraries: list[Any], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(pair, "PIECE", 1000)
    receives: list[np.ndarray] = []
    store, meeting = host(LOOPBACK, 2, 30)
    sent = np.random.default_rng(0).integers(0, 256, 12_345, np.uint8)

    def read() -> None:
        end = Pair(visit(meeting, 2, 30), READS, LOOPBACK, meet_s=30, timeout_s=30)
        for _ in range(2):
            memory = np.zeros(12_345, np.uint8)
            end.receive(memory)
            receives.append(memory)

    thread = threading.Thread(target=read)
    thread.start()
    end = Pair(store, PUBLISHES, LOOPBACK, meet_s=30, timeout_s=30)
    end.send(sent)
    end.send(sent[::-1].copy())
    thread.join(30)
    assert np.array_equal(receives[0], sent) and np.array_equal(receives[1], sent[::-1])
    assert len(end._under_way) == 26
    end.sent()
    assert end._under_way == []


def test_one_that_lives_but_has_lost_the_connection_is_ended(libraries: list[Any]):
    parted, quick = library(), Reader(libraries[0])
    reader = Reader(parted)
    killed: list[Any] = []
    publisher = DirectPublisher([reader, quick])
    publisher.publish(0, filled(0.0))
    publisher.flush(60)
    ray.get(parted.part.remote(reader.name))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(direct.ray, "kill", killed.append)
        publisher.publish(1, filled(1.0))
        publisher.flush(60)
        until(lambda: killed == [reader])
    assert quick.versions() == [0, 1] and [r.number for r in publisher._readers] == [1]
    publisher.close()
    ray.kill(parted)


def test_a_reader_that_comes_before_anything_is_published_waits(libraries: list[Any]):
    publisher, reader = DirectPublisher([]), Reader(libraries[0])
    publisher.add(reader)
    publisher.flush(0.1)
    publisher.publish(2, filled(2.0))
    publisher.flush(60)
    assert reader.versions() == [2]
    publisher.close()


def test_what_arrives_torn_is_used_by_nobody_and_ends_the_publisher(
    libraries: list[Any], monkeypatch: pytest.MonkeyPatch
):
    true = direct.digest
    monkeypatch.setattr(direct, "digest", lambda *found: true(*found)[::-1])
    reader = Reader(libraries[0])
    publisher = DirectPublisher([reader])
    publisher.publish(5, filled(5.0))
    torn = "version 5 are not what their digest says"
    with pytest.raises(ray.exceptions.RayTaskError, match=torn):
        publisher.flush(60)
    with pytest.raises(ray.exceptions.RayTaskError, match=torn):
        publisher.publish(6, filled(6.0))
    with pytest.raises(ray.exceptions.RayTaskError, match=torn):
        publisher.add(Reader(libraries[0]))
    assert reader.newest() is None


def test_a_publisher_that_is_gone_fails_who_waits_for_its_bytes():
    store, meeting = host(LOOPBACK, 2, 30)
    made: list[DirectReader] = []
    meets = threading.Thread(target=lambda: made.append(DirectReader(meeting, lambda _: None)), daemon=True)
    meets.start()
    end = Pair(store, PUBLISHES, LOOPBACK, meet_s=30, timeout_s=30)
    meets.join(30)
    end.close()
    with pytest.raises(RuntimeError, match="Connection closed"):
        made[0].take(Coming(1, 0.0, Layout.of(filled(1.0)).text), lambda: None)


def test_one_that_does_not_come_is_heard_of_at_once(libraries: list[Any], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(direct, "MEET_S", 600.0)
    started = time.monotonic()
    with pytest.raises(ConnectionError, match="no way there"):
        DirectPublisher([Reader(libraries[0], "stranger")])
    with pytest.raises(ray.exceptions.RayActorError):
        dead = library()
        ray.kill(dead)
        DirectPublisher([Reader(dead)])
    assert time.monotonic() - started < 300


def bound() -> set[str]:
    """Addresses at which this process listens."""
    gc.collect()
    return {c.laddr.ip for c in psutil.Process().net_connections("tcp") if c.status == "LISTEN"}


def test_those_on_another_machine_are_reached_by_its_address(
    libraries: list[Any], monkeypatch: pytest.MonkeyPatch
):
    """Both ends are here; the interface is not the loopback."""
    addresses = [a.address for name, found in psutil.net_if_addrs().items() for a in found if name != "lo"]
    outside = [address for address in addresses if address.count(".") == 3]
    if not outside:
        pytest.skip("this machine has no address but the loopback's")
    monkeypatch.setattr(direct.ray.util, "get_node_ip_address", lambda: outside[0])
    met: list[Meeting] = []
    made: list[DirectReader] = []

    class There:
        """A reader in this process."""

        class node:  # noqa: N801
            @staticmethod
            def remote() -> Any:
                return ray.put("another node")

        class meet_publisher:  # noqa: N801
            @staticmethod
            def remote(meeting: Meeting) -> Any:
                met.append(meeting)
                thread = threading.Thread(
                    target=lambda: made.append(DirectReader(meeting, lambda _: None)), daemon=True
                )
                thread.start()
                return ray.put(None)

    publisher = DirectPublisher([There()])
    until(lambda: len(made) == 1)
    assert [meeting.address for meeting in met] == [outside[0]]
    assert "0.0.0.0" not in bound() and outside[0] in bound()  # noqa: S104
    (reader,) = publisher._readers
    reader.pair.send(np.full(100, 7, np.uint8))
    memory = np.zeros(100, np.uint8)
    made[0]._pair.receive(memory)
    assert (memory == 7).all()
    publisher.close()
    made[0]._pair.close()
    until(lambda: outside[0] not in bound())


def test_near_ones_have_shared_memory_and_far_ones_gloo(libraries: list[Any]):
    class Near(Reader):
        def __init__(self, there: Any, here: bool) -> None:
            super().__init__(there)
            self._here = here
            self.open_weights = self

        def remote(self, address: str) -> Any:
            return ray.put(self._here)

    publisher = make_publisher([Near(libraries[0], True), Near(libraries[1], False)], way="gloo")
    assert isinstance(publisher, Publishers)
    shared, far = publisher.parts
    assert isinstance(far, DirectPublisher) and [r.handle.library for r in far._readers] == [libraries[1]]
    join(publisher, Near(libraries[0], False))
    assert len(far._readers) == 2
    publisher.close()
