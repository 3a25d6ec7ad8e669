# SPDX-License-Identifier: Apache-2.0
"""Faults of shared memory alone: slots, their files, tokens, strangers, and what cannot be sent."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.transport import shared_memory
from accerl_lerobot.transport.contract import Client, PendingRequest, ServiceStoppedError
from accerl_lerobot.transport.shared_memory import (
    LEAST,
    SLOTS,
    SharedMemoryClient,
    SharedMemoryServer,
    available,
    pack,
)

pytestmark = pytest.mark.skipif(not available(), reason="no memfd, epoll and eventfd here")
LONG_S = 30.0


class Stage:
    """A service in the test's own process: what is asked lies in `asked` until the test answers."""

    def __init__(self, copy: bool) -> None:
        self.asked: list[PendingRequest] = []
        self.server = SharedMemoryServer(self.asked.append, copy=copy)
        self.callers: list[SharedMemoryClient] = []

    def caller(self) -> SharedMemoryClient:
        self.callers.append(SharedMemoryClient("service", self.server.address))
        return self.callers[-1]

    def await_asked(self, count: int) -> list[PendingRequest]:
        """Polls until so many messages have come; takes them."""
        self.until(lambda: len(self.asked) >= count)
        taken, self.asked[:] = list(self.asked), []
        return taken

    def until(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + LONG_S
        while not condition():
            assert time.monotonic() < deadline, "it did not happen"
            self.server.poll(0.05)

    def raw(self) -> socket.socket:
        """A connection that says what the test wants."""
        end = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        end.settimeout(LONG_S)
        end.connect(f"\0{self.server.address.name}")
        return end


@pytest.fixture
def stage() -> Iterator[Callable[..., Stage]]:
    made: list[Stage] = []

    def make(*, copy: bool = False) -> Stage:
        made.append(Stage(copy))
        return made[-1]

    yield make
    for one in made:
        for caller in one.callers:
            caller.close()
        one.server.close()


def mapped() -> int:
    """Slots that this process has mapped."""
    return len(re.findall(r"memfd:accerl", Path("/proc/self/maps").read_text()))


def test_messages_are_views_of_the_slot_until_the_answer_or_copies_if_so_asked(stage):
    image = np.arange(1000, dtype=np.int32)
    for copy in (False, True):
        one = stage(copy=copy)
        caller = one.caller()
        caller.send(image)
        (asked,) = one.await_asked(1)
        np.testing.assert_array_equal(asked.message, image)
        assert asked.message.flags.owndata is copy
        kept = asked.message
        asked.answer(None)
        assert caller.done(LONG_S) == [(1, None)]
        caller.send(-image)
        (asked,) = one.await_asked(1)
        assert (kept == (image if copy else -image)).all(), "the slot is the same, and so is its memory"


def test_a_reply_may_consist_of_what_was_asked(stage):
    one = stage()
    caller = one.caller()
    parts = [np.arange(5000) + i for i in range(4)]
    caller.send(parts)
    (asked,) = one.await_asked(1)
    asked.answer({"turned": asked.message[::-1], "twice": asked.message + asked.message, "more": "text" * 50})
    ((_, reply),) = caller.done(LONG_S)
    for i in range(4):
        np.testing.assert_array_equal(reply["turned"][i], parts[3 - i])
        np.testing.assert_array_equal(reply["twice"][4 + i], parts[i])


def test_messages_of_all_callers_are_handed_over_oldest_first(stage):
    one = stage()
    callers = [one.caller() for _ in range(3)]
    order = [2, 0, 1, 1, 0, 2, 2, 0]
    for i in order:
        callers[i].send(i)
    taken = one.await_asked(len(order))
    assert [asked.message for asked in taken] == order
    assert all(earlier.sent <= later.sent for earlier, later in zip(taken, taken[1:], strict=False))


def test_slots_are_used_again_and_replaced_by_larger_ones_only(stage):
    one, before = stage(), mapped()
    caller = one.caller()
    for size in (10, LEAST * 3, 20, LEAST * 3, LEAST * 20, 30):
        for _ in range(3):
            caller.send(np.zeros(size, np.uint8))
            (asked,) = one.await_asked(1)
            asked.answer(size)
            del asked
            assert caller.done(LONG_S)[0][1] == size
    assert mapped() - before == 2, "one slot, mapped at either end"
    for _ in range(3):
        caller.send("much")
        (asked,) = one.await_asked(1)
        asked.answer(np.full(LEAST * 50, 9, np.uint8))  # brings a slot of its own
        del asked
        ((_, reply),) = caller.done(LONG_S)
        assert reply.shape == (LEAST * 50,) and (reply == 9).all()
    assert mapped() - before == 2


def test_no_more_are_under_way_than_have_slots(stage):
    one = stage()
    caller = one.caller()
    tickets = [caller.send(i) for i in range(SLOTS)]
    with pytest.raises(TimeoutError, match=f"service: none of {SLOTS} messages under way has been answered"):
        caller.send("one more")
    for asked in one.await_asked(SLOTS):
        asked.answer(asked.message)  # nobody reads meanwhile, and no end waits for the other
    assert caller.done(LONG_S) == [(ticket, i) for i, ticket in enumerate(tickets)]
    assert caller.send("again") == SLOTS + 1


def files() -> int:
    """That this process has open, but for what the slots that it has mapped keep: one each."""
    return len(os.listdir("/proc/self/fd")) - mapped()


ASKING = """
import sys, time, numpy as np
from accerl_lerobot.transport.shared_memory import Address, SharedMemoryClient
caller = SharedMemoryClient("service", Address(*sys.argv[1:]))
for _ in range(3):
    caller.send(np.zeros(100_000, np.uint8))
time.sleep(600)
"""


def test_what_a_killed_caller_had_asked_is_forgotten_and_its_memory_freed(stage):
    one, before = stage(), mapped()
    patient = one.caller()
    process = subprocess.Popen([sys.executable, "-c", ASKING, *one.server.address])
    try:
        taken = one.await_asked(3)
        patient.send("still here")
        (other,) = one.await_asked(1)
        assert mapped() - before == 3 + 2 and not any(asked.gone() for asked in taken)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    one.until(lambda: all(asked.gone() for asked in taken))
    taken[0].answer("nobody is there")
    taken[1].fail(ValueError("nobody is there"))
    taken.clear()
    assert mapped() - before == 2 and not other.gone()
    other.answer("yes")
    assert patient.done(LONG_S)[0][1] == "yes"


def test_a_service_that_closes_is_noticed_and_refuses_new_callers(stage):
    one = stage()
    waiting, idle = one.caller(), one.caller()
    waiting.send(1)
    one.await_asked(1)
    one.server.close()
    for caller in (waiting, idle):
        with pytest.raises(ServiceStoppedError, match="service is gone"):
            caller.done(LONG_S)
        with pytest.raises(ServiceStoppedError, match="service is gone"):
            caller.send(2)
    with pytest.raises(ServiceStoppedError, match="service cannot be connected to"):
        one.caller()
    one.server = SharedMemoryServer(one.asked.append, copy=False)  # for the fixture to close


def test_threads_of_the_same_process_call_and_wake(stage):
    one = stage()
    answers: list[Any] = []
    started = time.monotonic()
    caller = threading.Thread(target=lambda: answers.append(one.server.call([1, 2]).result(LONG_S)))
    caller.start()
    while not one.asked:
        one.server.poll(LONG_S)
    one.asked.pop().answer("both")
    caller.join(LONG_S)
    one.server.wake()
    one.server.poll(LONG_S)
    assert answers == ["both"] and time.monotonic() - started < LONG_S


def test_other_users_are_refused_at_both_ends(stage, monkeypatch: pytest.MonkeyPatch):
    one = stage()
    end = one.raw()
    assert shared_memory.same_user(end)
    monkeypatch.setattr(shared_memory.os, "getuid", lambda: os.geteuid() + 1)
    with pytest.raises(ServiceStoppedError, match="service: another user's process has taken its place"):
        one.caller()
    one.server.poll(LONG_S)
    assert end.recv(1) == b"" and not one.server._connections


def test_a_service_that_takes_nothing_is_not_waited_for_for_ever(stage, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(shared_memory, "CONNECT_S", 0.05)
    one = stage()
    caller: Client = one.caller()
    with pytest.raises(TimeoutError, match=r"service: 1 of 1 replies did not come within 0\.05 s"):
        caller.ask(["nobody polls"], 0.05)
    with pytest.raises(ServiceStoppedError, match="service cannot be connected to: .*unavailable"):
        for _ in range(10 * SLOTS):
            one.caller()


@dataclass
class Stranger:
    """An object of no registered kind."""

    a: int = 1


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (Stranger(), "message: a Stranger cannot be"),
        ([{1, 2}], "message.0: a set cannot be"),
        (np.array([object()]), "an array of object cannot be"),
        (np.array(["text"]), "an array of <U4 cannot be"),
    ],
)
def test_what_cannot_be_sent_is_refused(message: Any, said: str):
    with pytest.raises(TypeError, match=said):
        pack(message)
