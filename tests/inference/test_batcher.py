# SPDX-License-Identifier: Apache-2.0
"""Dynamic batching, with a clock that the test holds."""

import random

import pytest

from accerl_lerobot.inference.batcher import Batcher, merge_metrics

WAIT = 0.01


def make_batcher(max_batch: int = 4, max_wait_s: float = WAIT) -> Batcher[str]:
    """A request is a string: its characters are the observations."""
    return Batcher(max_batch=max_batch, max_wait_s=max_wait_s)


def test_a_batch_that_cannot_grow_is_full_and_the_clock_goes_on_with_the_rest() -> None:
    batcher = make_batcher()
    batcher.add("abc", now=0.0)
    assert not batcher.due(now=0.0) and len(batcher) == 1
    batcher.add("de", now=0.004)
    assert batcher.due(now=0.005)
    assert batcher.take(now=0.005) == ["abc"]
    assert batcher.next_deadline() == 0.004 + WAIT
    assert not batcher.due(now=WAIT) and batcher.due(now=0.004 + WAIT)


def test_the_oldest_request_sets_the_clock() -> None:
    batcher = make_batcher(max_batch=100)
    for i in range(9):  # a trickle, each arrival younger than the wait
        batcher.add("a", now=i * WAIT / 10)
    assert batcher.next_deadline() == WAIT
    assert not batcher.due(now=0.99 * WAIT)
    assert batcher.due(now=WAIT)


def test_first_in_first_out_nothing_lost_nobody_starves() -> None:
    """A random load, served when due by a server that takes its time; large requests are not overtaken."""
    rng = random.Random(1)
    batcher: Batcher[list[int]] = Batcher(max_batch=8, max_wait_s=WAIT)
    now, sent, served, busy_until = 0.0, 0, [], 0.0
    arrived: dict[int, float] = {}
    for _ in range(5000):
        now += rng.expovariate(1.0) * WAIT / 4
        if sent < 2000:
            batcher.add([sent] * rng.choice([1, 1, 1, 2, 5, 8, 11]), now)
            arrived[sent] = now
            sent += 1
        if now >= busy_until and batcher.due(now):
            ahead = len(batcher)
            batch = batcher.take(now)
            assert sum(map(len, batch)) <= 8 or len(batch) == 1
            assert 1 <= len(batch) <= ahead
            served += [request[0] for request in batch]
            busy_until = now + WAIT / 8
    assert served == list(range(2000)) and len(batcher) == 0


def test_counts_of_all_replicas_are_merged() -> None:
    batcher = make_batcher()
    batcher.add("ab", now=0.0)
    batcher.add("cd", now=1.0)
    batcher.take(now=3.0)
    batcher.add("e", now=3.0)
    batcher.take(now=4.0)
    batcher.take(now=9.0)  # nothing there: not a batch
    assert batcher.counts == {"batches": 2, "requests": 3, "observations": 5, "waited_s": 3 + 2 + 1}
    one = batcher.counts | {"version": 7.0, "busy_share": 0.2}
    found = merge_metrics([one, make_batcher().counts | {"version": 6.0, "busy_share": 0.6}])
    assert found == {
        "batches": 2,
        "batch_size_mean": 2.5,
        "wait_mean_s": 2.0,
        "version": 6.0,
        "busy_share": pytest.approx(0.4),
    }
    assert merge_metrics([]) == {}


def test_in_lock_step_all_are_waited_for_and_served_in_as_many_batches_as_they_need() -> None:
    batcher = make_batcher(max_batch=2)
    batcher.lock_step(5)
    batcher.add("ab", now=0.0)
    batcher.add("cd", now=1.0)  # a full batch waits for those that are not here
    assert not batcher.due(now=1e6) and batcher.next_deadline() is None
    batcher.add("e", now=2.0)
    assert batcher.due(now=2.0)
    assert batcher.take(now=2.0) == ["ab"]
    batcher.add("f", now=2.0)  # of the next round
    assert batcher.due(now=2.0) and batcher.take(now=2.0) == ["cd"]
    assert batcher.due(now=2.0) and batcher.take(now=2.0) == ["e"]
    assert not batcher.due(now=1e6) and len(batcher) == 1
