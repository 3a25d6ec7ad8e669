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
"""Weights by gloo: the contract, with slabs of host and device; who dies, who is late, what is torn."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import ray
import torch

from accerl_lerobot.errors import InputError
from accerl_lerobot.transport.meeting import LOOPBACK, Meeting, host, only_at, visit
from accerl_lerobot.weights import direct
from accerl_lerobot.weights.channel import Tensors, WeightChannel
from accerl_lerobot.weights.choice import join, make_publisher
from accerl_lerobot.weights.device_slab import DeviceSlab, digest_there
from accerl_lerobot.weights.direct import Coming, DirectPublisher, DirectReader
from accerl_lerobot.weights.pair import PUBLISHES, READS, Backend, Pair, Place, place_of
from accerl_lerobot.weights.slab import Layout
from tests.light_workers import light_ray
from tests.weights.contract import CHECKS, Check, filled, values_of
from tests.weights.test_ray_channel import until

__all__ = ["light_ray"]

CPU = torch.device("cpu")


class Library:
    """A process with room for many readers; as slow as it is told to be."""

    def __init__(self) -> None:
        self._readers: dict[str, DirectReader] = {}
        self._received: dict[str, list[tuple[int, Tensors]]] = {}
        self._place = tuple(place_of(CPU))
        self._open = threading.Event()
        self._open.set()

    def shut(self) -> None:
        self._open.clear()

    def open(self) -> None:
        self._open.set()

    def place(self, device: str | None = None) -> tuple[str, ...]:
        if device is not None:
            self._place = (self._place[0], device)
        return self._place

    def meet(self, name: str, there: bool, meeting: Meeting, backend: Backend) -> None:
        self._readers[name] = DirectReader(meeting, backend, CPU if there else None, lambda _: None)

    def receive(self, name: str, coming: Coming) -> int:
        self._open.wait(60)
        received = self._readers[name].take(coming, lambda: None)
        copies = {n: np.array(t) for n, t in received.tensors.items()}
        for copy in copies.values():
            copy.flags.writeable = False
        self._received.setdefault(name, []).append((received.version, copies))
        return received.version

    def newest(self, name: str) -> tuple[int, Tensors] | None:
        received = self._received.get(name)
        return received[-1] if received else None

    def versions(self, name: str) -> list[int]:
        return [version for version, _ in self._received.get(name, [])]


class Bound:
    """``method.remote(...)`` with some arguments already given."""

    def __init__(self, method: Any, *given: Any) -> None:
        self._method, self._given = method, given

    def remote(self, *arguments: Any) -> Any:
        return self._method.remote(*self._given, *arguments)


class Reader:
    """One name in a library, looking like an actor handle."""

    count = 0

    def __init__(self, library: Any, there: bool = False) -> None:
        Reader.count += 1
        self.library, self.name = library, f"reader{Reader.count}"
        self.weights_place = library.place
        self.meet_publisher = Bound(library.meet, self.name, there)
        self.receive_directly = Bound(library.receive, self.name)

    def newest(self) -> tuple[int, Tensors] | None:
        return ray.get(self.library.newest.remote(self.name))

    def versions(self) -> list[int]:
        return ray.get(self.library.versions.remote(self.name))


class OnDevice(DirectPublisher):
    """As with NCCL, but that the device is the CPU."""

    def __init__(self, readers: list[Any]) -> None:
        super().__init__(readers, "gloo", CPU)

    def publish(self, version: int, tensors: Any) -> None:
        given = {name: torch.from_numpy(np.array(tensor)) for name, tensor in tensors.items()}
        super().publish(version, given)


@pytest.fixture(scope="module")
def libraries(light_ray: None) -> Iterator[list[Any]]:
    made = [ray.remote(Library).options(num_cpus=0, max_concurrency=8).remote() for _ in range(2)]
    yield made
    for library in made:
        ray.kill(library)


class Delivered(WeightChannel):
    """The publisher with its reader, as one channel: what is published has arrived."""

    def __init__(self, library: Any, there: bool) -> None:
        self.reader = Reader(library, there)
        self.publisher = OnDevice([self.reader]) if there else DirectPublisher([self.reader], "gloo")

    def publish(self, version: int, tensors: Tensors) -> None:
        self.publisher.publish(version, tensors)
        self.publisher.flush(60)

    def newest(self, than: int) -> tuple[int, Tensors] | None:
        found = self.reader.newest()
        return None if found is None or found[0] <= than else found


@pytest.mark.parametrize("there", [False, True], ids=["host", "device"])
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_contract(check: Check, there: bool, libraries: list[Any]):
    check(lambda: Delivered(libraries[0], there))


def test_a_slow_reader_skips_versions_and_holds_up_nobody(libraries: list[Any]):
    slow, quick = Reader(libraries[0]), Reader(libraries[1])
    publisher = DirectPublisher([slow, quick], "gloo")
    ray.get(libraries[0].shut.remote())
    size = 200_000  # more than sockets keep
    for version in range(10):  # would not return if it waited for the reader whose gate is shut
        publisher.publish(version, filled(float(version), size))
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


def test_a_dead_reader_is_let_go_of_and_another_takes_its_place(libraries: list[Any]):
    dying = ray.remote(Library).options(num_cpus=0, max_concurrency=2).remote()
    quick = Reader(libraries[0])
    publisher = make_publisher([Reader(dying), quick], way="gloo")
    assert isinstance(publisher, DirectPublisher)
    publisher.publish(0, filled(0.0))
    publisher.flush(60)
    ray.get(dying.shut.remote())
    publisher.publish(1, filled(1.0, 200_000))  # dies with it under way
    until(lambda: quick.versions() == [0, 1])
    ray.kill(dying)
    publisher.flush(60)
    assert [reader.number for reader in publisher._readers] == [1]
    late = Reader(libraries[1])
    join(publisher, late)
    until(lambda: late.versions() == [1])
    publisher.publish(2, filled(2.0))
    publisher.flush(60)
    assert late.versions() == [1, 2] and quick.versions() == [0, 1, 2]
    publisher.close()


def test_a_reader_that_comes_before_anything_is_published_waits(libraries: list[Any]):
    publisher, reader = DirectPublisher([], "gloo"), Reader(libraries[0])
    publisher.add(reader)
    publisher.flush(0.1)
    publisher.publish(2, filled(2.0))
    publisher.flush(60)
    assert reader.versions() == [2]
    publisher.close()


def test_what_arrives_torn_is_used_by_nobody_and_ends_the_publisher(
    libraries: list[Any], monkeypatch: pytest.MonkeyPatch
):
    true = direct.digest_of
    monkeypatch.setattr(direct, "digest_of", lambda *found: true(*found)[::-1])
    reader = Reader(libraries[0])
    publisher = DirectPublisher([reader], "gloo")
    publisher.publish(5, filled(5.0))
    with pytest.raises(ray.exceptions.RayTaskError, match="version 5 are not what their digest says"):
        publisher.flush(60)
    with pytest.raises(ray.exceptions.RayTaskError, match="version 5 are not what their digest says"):
        publisher.publish(6, filled(6.0))
    assert reader.newest() is None


def test_a_publisher_that_is_gone_fails_who_waits_for_its_bytes():
    only_at(LOOPBACK)
    store, meeting = host(LOOPBACK, 2, 30)
    made: list[DirectReader] = []
    meets = threading.Thread(
        target=lambda: made.append(DirectReader(meeting, "gloo", None, lambda _: None)), daemon=True
    )
    meets.start()
    pair = Pair(store, PUBLISHES, "gloo", meet_s=30, timeout_s=30)
    meets.join(30)
    layout = Layout.of(filled(1.0))
    del pair
    with pytest.raises(RuntimeError, match="Connection closed"):
        made[0].take(Coming(1, 0.0, layout.text), lambda: None)


def test_nccl_is_refused_where_there_is_no_gpu_for_each(
    libraries: list[Any], monkeypatch: pytest.MonkeyPatch
):
    reader = Reader(libraries[0])
    with pytest.raises(InputError, match=r"^launch.weights='nccl': the trainer's policy is on cpu, and NCCL"):
        make_publisher([reader], way="nccl", device=CPU)
    here = ray.get(libraries[0].place.remote())
    monkeypatch.setattr(direct, "place_of", lambda device: Place(here[0], "GPU-1"))
    monkeypatch.setattr(direct, "DeviceSlab", lambda size, device: DeviceSlab(size, CPU))
    gpu = torch.device("cuda")
    with pytest.raises(InputError, match="an inference worker has its policy on the CPU"):
        make_publisher([reader], way="nccl", device=gpu)
    ray.get(libraries[0].place.remote("GPU-1"))
    with pytest.raises(InputError, match="an inference worker has its policy on the trainer's GPU"):
        make_publisher([reader], way="nccl", device=gpu)
    with pytest.raises(InputError, match=r"^launch.weights='mpi': use one of auto, gloo, nccl"):
        make_publisher([reader], way="mpi")
    with pytest.raises(InputError, match=r"^trainer.publish_changes=True: it needs shared memory"):
        make_publisher([reader], way="gloo", changes=True)


@pytest.mark.parametrize("spoil", [0, 7, 500, 1023])
def test_the_digest_of_a_device_sees_any_word_and_its_place(spoil: int):
    rng = np.random.default_rng(0)
    tensors = {"a": rng.integers(0, 256, 8192, np.uint8)}
    layout = Layout.of(tensors)
    slab = DeviceSlab(layout.size, CPU)
    slab.fill(layout, tensors)
    whole = digest_there(3, layout, slab.memory)
    assert len(whole) == 16 and whole != digest_there(4, layout, slab.memory)
    words = slab.memory.view(torch.int64)
    other = (spoil + 1) % 1024
    pair = words[[spoil, other]].clone()
    words[[spoil, other]] = pair.flip(0)
    assert digest_there(3, layout, slab.memory) != whole
    words[[spoil, other]] = pair
    assert digest_there(3, layout, slab.memory) == whole
    slab.memory[8 * spoil + 3] ^= 16
    assert digest_there(3, layout, slab.memory) != whole


def test_the_sum_of_a_device_is_that_of_numpy(monkeypatch: pytest.MonkeyPatch):
    """In parts or in one, it is the sum of word times mix times the odd numbers, mod 2^64."""
    from accerl_lerobot.weights import device_slab

    rng = np.random.default_rng(1)
    data = rng.integers(0, 2**63, 300, np.uint64)
    layout = Layout.of({"a": data})
    slab = DeviceSlab(layout.size, CPU)
    slab.fill(layout, {"a": data.view(np.int64)})
    words = [int(word) for word in np.frombuffer(slab.memory.numpy().tobytes(), np.uint64)]
    total = sum(w * 0x9E3779B97F4A7C15 * (2 * i + 1) for i, w in enumerate(words)) % 2**64
    told: list[bytes] = []

    class Hash:
        def __init__(self, start: bytes) -> None: ...

        def update(self, more: bytes) -> None:
            told.append(more)

        def digest(self) -> bytes:
            return b""

    monkeypatch.setattr(device_slab.xxhash, "xxh3_128", Hash)
    for at_once in (7, 1 << 20):
        monkeypatch.setattr(device_slab, "_AT_ONCE", at_once)
        digest_there(0, layout, slab.memory)
        assert int.from_bytes(told[-1], "little") == total


def test_two_ends_in_one_process_wait_for_each_other_and_keep_the_order():
    only_at(LOOPBACK)
    store, meeting = host(LOOPBACK, 2, 30)
    got: list[int] = []

    def read() -> None:
        pair = Pair(visit(meeting, 2, 30), READS, "gloo", meet_s=30, timeout_s=30)
        for _ in range(3):
            memory = np.zeros(1000, np.uint8)
            pair.receive(memory)
            got.append(int(memory[0]))

    thread = threading.Thread(target=read)
    thread.start()
    pair = Pair(store, PUBLISHES, "gloo", meet_s=30, timeout_s=30)
    kept = [pair.send(np.full(1000, value, np.uint8)) for value in (3, 1, 2)]
    thread.join(30)
    assert got == [3, 1, 2] and len(kept) == 3
