# SPDX-License-Identifier: Apache-2.0
"""Weights through memory that trainer and readers map."""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.weights import shared_memory
from accerl_lerobot.weights.publisher import BufferLayout, Tensors, TornSetError, WeightBuffer, digest
from accerl_lerobot.weights.shared_memory import Received, SharedMemoryPublisher, SharedMemoryReader
from tests.weights.contract import CHECKS, Check, filled, values_of

OPEN: list[Any] = []
"""Publishers of the test that runs."""


@pytest.fixture(autouse=True)
def _closed() -> Iterator[None]:
    yield
    while OPEN:
        OPEN.pop().close()


def published(readers: int) -> SharedMemoryPublisher:
    OPEN.append(SharedMemoryPublisher(readers))
    return OPEN[-1]


class Parameters:
    """Copies sets into arrays of its own, and lets them go."""

    def __init__(self, publisher: SharedMemoryPublisher) -> None:
        self.tensors: Tensors = {}
        self.versions: list[int] = []
        self.failure: BaseException | None = None
        self.gate = threading.Event()
        self.gate.set()
        self.reader = SharedMemoryReader(publisher.address, self.apply, self.fail)

    def fail(self, error: BaseException) -> None:
        self.failure = error

    def apply(self, received: Received) -> None:
        assert self.gate.wait(60)
        assert not any(tensor.flags.writeable for tensor in received.tensors.values())
        self.tensors = {name: tensor.copy() for name, tensor in received.tensors.items()}
        self.versions.append(received.version)
        received.release()


class Delivered:
    """The publisher with two readers, as one channel: what is published has been applied by both."""

    def __init__(self) -> None:
        self.publisher = published(2)
        self.readers = [Parameters(self.publisher) for _ in range(2)]

    def publish(self, version: int, tensors: Tensors) -> None:
        self.publisher.publish(version, tensors)
        self.publisher.flush(60)

    def newest(self) -> tuple[int, Tensors] | None:
        first, second = self.readers
        assert first.versions == second.versions
        for name, tensor in first.tensors.items():
            np.testing.assert_array_equal(tensor, second.tensors[name])
        return (first.versions[-1], first.tensors) if first.versions else None


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_contract(check: Check):
    check(Delivered)


def until(holds: Callable[[], object]) -> None:
    deadline = time.monotonic() + 60
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def test_a_writer_at_full_speed_never_gives_a_mixture():
    """Nobody waits for anybody; each set is of one value, so a mixture shows even without a digest."""
    publisher = published(2)
    seen: list[tuple[int, set[float]]] = []

    def check(received: Received) -> None:
        seen.append((received.version, values_of(received.tensors)))
        received.release()

    failures: list[BaseException] = []
    readers = [SharedMemoryReader(publisher.address, check, failures.append) for _ in range(2)]
    buffers = filled(0.0, size=100_000)
    for version in range(300):
        for tensor in buffers.values():
            tensor[:] = version
        publisher.publish(version, buffers)
    publisher.flush(60)
    assert not failures and all(values == {float(version)} for version, values in seen)
    assert sum(version == 299 for version, _ in seen) == 2 and len(readers) == 2


def test_a_torn_set_is_refused(monkeypatch: pytest.MonkeyPatch):
    """Somebody writes into a set after its digest has been reckoned: no reader uses any of it."""
    publisher = published(1)
    reader = Parameters(publisher)
    publisher.publish(1, filled(1.0, size=1000))
    publisher.flush(60)

    def then_torn(version: int, layout: BufferLayout, buffer: WeightBuffer) -> bytes:
        right = digest(version, layout, buffer)
        if threading.current_thread().name == "publisher":
            buffer.memory[layout.specs["b"].offset] ^= 1
        return right

    monkeypatch.setattr(shared_memory, "digest", then_torn)
    publisher.publish(2, filled(2.0, size=1000))
    publisher.flush(60)  # nobody is left who would be owed it
    assert isinstance(reader.failure, TornSetError) and "version 2" in str(reader.failure)
    assert reader.versions == [1] and values_of(reader.tensors) == {1.0}


@pytest.mark.parametrize("what", ["version", "name", "value"])
def test_the_digest_is_of_everything(what: str):
    tensors = filled(1.0)
    layout = BufferLayout.of(tensors)
    buffer = WeightBuffer(layout.end)
    buffer.fill(layout, tensors)
    before = digest(3, layout, buffer)
    if what == "version":
        assert digest(4, layout, buffer) != before
    elif what == "name":
        assert digest(3, BufferLayout.of({**filled(1.0), "c.weight": tensors["a"].T}), buffer) != before
    else:
        buffer.memory[layout.specs["c.weight"].offset + 5] ^= 1
        assert digest(3, layout, buffer) != before


def test_a_slow_reader_keeps_what_it_holds_and_holds_up_nobody():
    publisher = published(2)
    slow, quick = Parameters(publisher), Parameters(publisher)
    slow.gate.clear()
    publisher.publish(0, filled(0.0, size=5000))
    until(lambda: quick.versions == [0])
    for version in range(1, 30):  # would not return if it waited for the reader whose gate is shut
        publisher.publish(version, filled(float(version), size=5000))
    until(lambda: quick.versions[-1] == 29)
    assert slow.versions == []
    with pytest.raises(
        TimeoutError, match=r"weights of version 29, after 0.2 s: not applied by readers [01]$"
    ):
        publisher.flush(0.2)
    slow.gate.set()
    publisher.flush(60)
    assert slow.versions == [0, 29] and values_of(slow.tensors) == {29.0}
    assert len(publisher._buffers) <= 4


def test_flush_names_readers_that_never_came():
    publisher = published(2)
    Parameters(publisher)
    publisher.flush(0.1)  # nothing is owed before the first publication
    publisher.publish(0, filled(0.0))
    with pytest.raises(TimeoutError, match="1 readers have not connected"):
        publisher.flush(0.3)


def test_a_failure_of_the_thread_is_raised_to_the_trainer(monkeypatch: pytest.MonkeyPatch):
    publisher = published(1)
    Parameters(publisher)

    def broken(*_: Any) -> bytes:
        raise ArithmeticError("no digest")

    monkeypatch.setattr(shared_memory, "digest", broken)
    publisher.publish(0, filled(0.0))
    with pytest.raises(ArithmeticError, match="no digest"):
        publisher.flush(60)
    with pytest.raises(ArithmeticError, match="no digest"):
        publisher.publish(1, filled(1.0))


def test_sets_that_grow_find_room():
    channel = Delivered()
    for version, size in enumerate((4, 40_000, 10, 400_000, 3)):
        channel.publish(version, filled(float(version), size=size))
        found = channel.newest()
        assert found is not None and found[1]["a"].shape == (2, size)
        assert values_of(found[1]) == {float(version)}
    mapped = channel.readers[0].reader._buffers
    assert len(mapped) <= len(channel.publisher._buffers) <= 4


def test_a_stranger_is_turned_away(monkeypatch: pytest.MonkeyPatch):
    publisher = published(1)
    monkeypatch.setattr(shared_memory, "same_user", lambda connection: False)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stranger:
        stranger.settimeout(30)
        stranger.connect(f"\0{publisher.address}")
        publisher.publish(0, filled(0.0))
        assert stranger.recv(100) == b""
    monkeypatch.undo()
    reader = Parameters(publisher)
    publisher.flush(60)
    assert reader.versions == [0]


def _read_for_ever(address: str, started: Any) -> None:
    reader = SharedMemoryReader(address, lambda received: started.set(), lambda error: None)
    reader._thread.join(120)


def test_a_reader_that_comes_later_gets_the_newest_set_at_once():
    """As a service does that takes the place of one that was lost."""
    publisher = published(1)
    first = Parameters(publisher)
    tensors = filled(0.0, size=1000)
    for version in (0, 1):
        tensors["a"][0, version] = version
        publisher.publish(version, tensors)
        publisher.flush(60)
    late = Parameters(publisher)
    until(lambda: late.versions == [1])
    first.gate.clear()  # a third one is there before anybody has seen that the first is gone
    tensors["a"][0, 2] = 2.0
    publisher.publish(2, tensors)
    third = Parameters(publisher)
    first.reader.close()
    for version in range(3, 9):
        tensors["a"][0, version] = version
        publisher.publish(version, tensors)
    first.gate.set()
    publisher.flush(60)
    assert [reader.versions[-1] for reader in (late, third)] == [8, 8] and first.versions[-1] < 8
    for reader in (late, third):
        for name, tensor in tensors.items():
            np.testing.assert_array_equal(reader.tensors[name], tensor)
    assert [reader.number for reader in publisher._readers] == [1, 2]


def test_a_reader_that_is_killed_is_let_go_of_and_leaves_nothing():
    context = multiprocessing.get_context("spawn")
    publisher, started = published(1), context.Event()
    process = context.Process(target=_read_for_ever, args=(publisher.address, started), daemon=True)
    process.start()
    try:
        publisher.publish(0, filled(0.0, size=10_000))
        assert started.wait(60)  # it holds the set now, and never lets it go
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        publisher.flush(60)
        assert publisher._readers == [] and publisher._held() == []
    finally:
        process.kill()
        process.join(60)
    for version in range(1, 20):  # to nobody, and no buffer is missing
        publisher.publish(version, filled(float(version), size=10_000))
    reader = Parameters(publisher)
    until(lambda: reader.versions == [19])


_TRAINER = """
import sys, time
import numpy as np
from accerl_lerobot.weights.shared_memory import SharedMemoryPublisher
publisher = SharedMemoryPublisher(1)
sys.stdout.write(publisher.address + "\\n"); sys.stdout.flush()
for version in range(10**9):
    publisher.publish(version, {"a": np.full(100_000, version, np.float32)})
"""


def test_a_trainer_that_is_killed_ends_the_reader_quietly_and_leaves_nothing():
    """Held weights stay readable; no name is left in a file system, and no memory once it is let go of."""
    before = set(os.listdir("/dev/shm"))
    process = subprocess.Popen([sys.executable, "-c", _TRAINER], stdout=subprocess.PIPE, text=True)
    held: list[Received] = []
    failures: list[BaseException] = []
    try:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        reader = SharedMemoryReader(address, held.append, failures.append)
        until(lambda: held)
        process.kill()
        process.wait(60)
        reader._thread.join(60)
        assert not reader._thread.is_alive() and failures == [] and len(held) == 1
        assert set(np.unique(held[0].tensors["a"])) == {np.float32(held[0].version)}
        held[0].release()
    finally:
        process.kill()
        process.wait(60)
        with contextlib.suppress(ValueError):
            process.communicate()
    assert set(os.listdir("/dev/shm")) <= before
    with open("/proc/net/unix") as names:
        assert address not in names.read()


def test_closing_lets_go_of_all_descriptors():
    gc.collect()
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(10):
        publisher = SharedMemoryPublisher(1)
        reader = Parameters(publisher)
        publisher.publish(0, filled(0.0))
        publisher.flush(60)
        publisher.close()
        publisher.close()
        reader.reader._thread.join(60)
        reader.reader.close()
    # Not exactly as many: what other tests have left may be closed meanwhile.
    assert len(os.listdir("/proc/self/fd")) < before + 10
