# SPDX-License-Identifier: Apache-2.0
"""Tests that every transport must pass.

Use, in the test file of a transport::

    @pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
    def test_contract(check: Check) -> None:
        check(make)

A factory is called without arguments and gives a new caller of a `Service`, which lives in another process.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.experience import Decision, Request
from accerl_lerobot.transport.contract import Client, ServiceStoppedError
from accerl_lerobot.transport.shared_memory import Address, serve_on_loop
from tests.replay.segments import make_segment

Factory = Callable[[], Client]
Check = Callable[[Factory], None]
LONG_S = 240.0  # seconds after which an end counts as hung


class Service:
    """Does what messages say; becomes an asynchronous Ray actor."""

    def __init__(self) -> None:
        self._held: dict[str, asyncio.Event] = {}

    async def listen(self) -> Address:
        return serve_on_loop(self.obey).address

    async def obey(self, message: Any) -> Any:
        what, rest = message
        if what == "hold":
            await self._event(rest["until"]).wait()
            return rest["reply"]
        if what == "release":
            self._event(rest).set()
        if what == "fail":
            raise ArithmeticError(rest)
        if what == "fill":
            return np.full(rest, 7, np.uint8)
        return os.getpid() if what == "pid" else rest

    def _event(self, name: str) -> asyncio.Event:
        return self._held.setdefault(name, asyncio.Event())


def same(a: Any, b: Any) -> bool:
    """True if two messages are equal, types, dtypes and shapes included."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray | np.generic):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return same(vars(a), vars(b)) if hasattr(a, "__dict__") else bool(a == b or a != a)


def messages() -> list[Any]:
    """Messages of every kind that travels, and of the kinds easily lost on the way."""
    draw = np.random.default_rng(0)
    image = draw.integers(0, 255, (24, 16, 3)).astype(np.uint8)
    chunk = draw.normal(size=(4, 2)).astype(np.float32)
    arrays = {
        "strided": image[::2, :, 1],
        "turned": np.arange(12, dtype=np.float64).reshape(3, 4).T,
        "none": np.zeros((0, 3), np.float32),
        "scalar": np.array(0.5, np.float16),
        "bits": np.array([True, False]),
        "other way round": np.arange(3, dtype=">i4"),
    }
    observation = {
        "observation.images.front": image,
        "observation.state": arrays["turned"],
        "task": "öffne 🚪",
    }
    chunk = draw.normal(size=(4, 2)).astype(np.float32)
    decision = Decision(chunk=chunk, latent={"x": chunk}, log_prob=chunk[0], version=2**40)
    return [
        arrays,
        [Request(observation=observation, noise_seed=2**63 + 5), Request(observation={}, noise_seed=0)],
        [decision],
        [make_segment("a", 3), make_segment("b", 2, world_version=7)],
        [True, None, 1, -0.0, float("inf"), "", (1, [2, {3: {}}])],
    ]


def what_is_sent_arrives_whole(make: Factory) -> None:
    caller = make()
    for message in messages():
        (reply,) = caller.ask([("echo", message)], LONG_S)
        assert same(reply, message), message


def replies_go_to_the_messages_they_answer(make: Factory) -> None:
    caller, other = make(), make()
    late = caller.send(("hold", {"until": "now", "reply": "late"}))
    early = [caller.send(("echo", i)) for i in range(8)]
    got: list[tuple[int, Any]] = []
    while len(got) < len(early):
        got += caller.done(LONG_S)
    assert sorted(got) == [(ticket, i) for i, ticket in enumerate(early)]
    other.ask([("release", "now")], LONG_S)
    assert caller.done(LONG_S) == [(late, "late")]
    assert caller.done(0.0) == []


def any_number_may_be_asked(make: Factory) -> None:
    assert make().ask([("echo", i) for i in range(300)], LONG_S) == list(range(300))


def callers_do_not_get_each_others_replies(make: Factory) -> None:
    callers = [make() for _ in range(3)]
    tickets = [[caller.send(("echo", [i, j])) for j in range(5)] for i, caller in enumerate(callers)]
    for i, caller in enumerate(callers):
        got: dict[int, Any] = {}
        while len(got) < 5:
            got |= dict(caller.done(LONG_S))
        assert [got[ticket] for ticket in tickets[i]] == [[i, j] for j in range(5)]


def what_was_sent_stays_when_the_caller_changes_it(make: Factory) -> None:
    caller, other = make(), make()
    array = np.arange(60_000)
    caller.send(("hold", {"until": "changed", "reply": array}))
    array[:] = -1
    other.ask([("release", "changed")], LONG_S)
    ((_, reply),) = caller.done(LONG_S)
    np.testing.assert_array_equal(reply, np.arange(60_000))
    caller.ask([("echo", np.zeros(60_000, np.int64))], LONG_S)
    np.testing.assert_array_equal(reply, np.arange(60_000))


def messages_and_replies_grow_and_shrink(make: Factory) -> None:
    caller = make()
    for size in (10, 300_000, 70, 5_000_000, 0, 1_000):
        sent, made = caller.ask([("echo", np.full(size, 3, np.uint8)), ("fill", size)], LONG_S)
        assert sent.shape == made.shape == (size,) and (sent == 3).all() and (made == 7).all()


def nobody_waits_for_ever(make: Factory) -> None:
    caller = make()
    assert caller.done(0.01) == []
    with pytest.raises(TimeoutError, match=r"service: 1 of 2 replies did not come within 0\.2 s"):
        caller.ask([("hold", {"until": "given up", "reply": "late"}), ("echo", 1)], 0.2)


def a_failure_says_what_it_was(make: Factory) -> None:
    caller = make()
    with pytest.raises(ServiceStoppedError, match=r"service: (.|\n)*it fell over"):
        caller.ask([("fail", "it fell over")], LONG_S)


def a_closed_caller_disturbs_nobody(make: Factory) -> None:
    caller, other = make(), make()
    caller.send(("hold", {"until": "closed", "reply": "nobody is there"}))
    caller.close()
    caller.close()
    assert other.ask([("release", "closed"), ("echo", 1)], LONG_S)[1] == 1


def a_service_that_is_killed_is_noticed_at_once(make: Factory) -> None:
    waiting, idle = make(), make()
    (pid,) = waiting.ask([("pid", None)], LONG_S)
    waiting.send(("hold", {"until": "never", "reply": None}))
    os.kill(pid, 9)
    started = time.monotonic()
    for caller, deed in (
        (waiting, lambda: waiting.done(LONG_S)),
        (idle, lambda: idle.ask([("echo", 1)], LONG_S)),
    ):
        with pytest.raises(ServiceStoppedError, match="service"):
            deed()
        caller.close()
    assert time.monotonic() - started < LONG_S, "it was the time that was over"


CHECKS: tuple[Check, ...] = (
    what_is_sent_arrives_whole,
    replies_go_to_the_messages_they_answer,
    any_number_may_be_asked,
    callers_do_not_get_each_others_replies,
    what_was_sent_stays_when_the_caller_changes_it,
    messages_and_replies_grow_and_shrink,
    nobody_waits_for_ever,
    a_failure_says_what_it_was,
    a_closed_caller_disturbs_nobody,
    a_service_that_is_killed_is_noticed_at_once,  # the last one, as there is no service after it
)
