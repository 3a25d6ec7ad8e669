# SPDX-License-Identifier: Apache-2.0
"""States exclude each other, leave no time out, and are on disk as they were; the disk never fills."""

from __future__ import annotations

import itertools
import random
import threading
from pathlib import Path

import pytest

from accerl_lerobot.errors import InputError
from accerl_lerobot.timeline import (
    COMPUTE,
    RECOVERY,
    STATES,
    TIMELINE,
    WAIT_IN,
    WAIT_OUT,
    NoClock,
    Row,
    open_clock,
    read_timeline,
)  # fmt: skip
from tests.timeline.folders import SECOND, UP, a_clock, write_worker


def lengths(row: Row) -> list[tuple[int, int]]:
    """States of a row, and how long each was."""
    return list(zip(row.states.tolist(), (row.ends - row.starts).tolist(), strict=True))


def merged(spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Spans with some length, equal neighbours taken together."""
    some = [span for span in spans if span[1]]
    return [(s, sum(n for _, n in group)) for s, group in itertools.groupby(some, key=lambda span: span[0])]


@pytest.mark.parametrize("seed", range(2))
def test_states_exclude_each_other_and_leave_no_time_out(tmp_path: Path, seed: int) -> None:
    clock, hands = a_clock(tmp_path)
    rng = random.Random(seed)
    state, spans = RECOVERY, []
    for _ in range(3000):
        length = rng.choice((0, 1, 999, 10**6, 3 * 10**9))
        hands.now += length
        spans.append((state, length))
        if rng.random() < 0.1:
            clock.beat()
        else:
            state = rng.randrange(len(STATES))
            clock.enter(state)
    clock.close()
    (row,) = read_timeline(tmp_path).rows
    assert row.starts[0] == 0 and row.ends[-1] == hands.now - UP
    assert (row.starts[1:] == row.ends[:-1]).all()
    assert merged(lengths(row)) == merged(spans)


def test_a_while_in_another_state_ends_in_the_one_before_whatever_happens(tmp_path: Path) -> None:
    clock, hands = a_clock(tmp_path)
    clock.enter(COMPUTE)
    with pytest.raises(KeyError), clock.during(WAIT_OUT):
        hands.now += 7
        raise KeyError
    hands.now += 2
    clock.beat()
    (row,) = read_timeline(tmp_path).rows
    assert lengths(row) == [(RECOVERY, 0), (COMPUTE, 0), (WAIT_OUT, 7), (COMPUTE, 2)]


def test_entries_and_beats_of_two_threads_leave_no_time_out(tmp_path: Path) -> None:
    clock = open_clock(tmp_path / TIMELINE, "trainer")
    over = threading.Event()

    def beat() -> None:
        while not over.is_set():
            clock.beat()

    thread = threading.Thread(target=beat)
    thread.start()
    for turn in range(2000):
        clock.enter((WAIT_IN, COMPUTE)[turn % 2])
    over.set()
    thread.join()
    clock.close()
    (row,) = read_timeline(tmp_path).rows
    states = [state for state, _ in itertools.groupby(row.states.tolist())]
    assert states == [RECOVERY, *[WAIT_IN, COMPUTE] * 1000] and (row.starts[1:] == row.ends[:-1]).all()


def test_a_long_run_does_not_fill_the_disk(tmp_path: Path) -> None:
    clock, hands = a_clock(tmp_path, most_bytes=8 * 1000)
    for turn in range(3000):
        hands.now += SECOND
        clock.enter((WAIT_IN, COMPUTE)[turn % 2])
    clock.close()
    (row,) = read_timeline(tmp_path).rows
    assert 900 < len(row.states) <= 1000 and row.ends[-1] == len(row.states) * SECOND


def test_a_process_that_was_killed_leaves_all_but_what_was_on_its_way(tmp_path: Path) -> None:
    write_worker(tmp_path, "trainer", [(COMPUTE, 1.0), (WAIT_IN, 2.0), (COMPUTE, 3.0)])
    (path,) = (tmp_path / TIMELINE).iterdir()
    data = path.read_bytes()
    head = data.index(b"\n") + 1
    whole = [(RECOVERY, 0), (COMPUTE, SECOND), (WAIT_IN, 2 * SECOND), (COMPUTE, 3 * SECOND)]
    for size in range(len(data), head + 7, -1):
        path.write_bytes(data[:size])
        (row,) = read_timeline(tmp_path).rows
        assert lengths(row) == whole[: (size - head) // 8]


@pytest.mark.parametrize("head", [b"no json", b'{"worker": "trainer"}', b"[]"])
def test_a_damaged_file_is_named(tmp_path: Path, head: bytes) -> None:
    write_worker(tmp_path, "trainer", [(COMPUTE, 1.0), (WAIT_IN, 1.0)])
    (path,) = (tmp_path / TIMELINE).iterdir()
    path.write_bytes(head + b"\n" + bytes(8))
    with pytest.raises(InputError, match=rf"^runs=.*{path.name} is not as a run writes it"):
        read_timeline(tmp_path)


def test_without_a_folder_nothing_is_recorded() -> None:
    clock = open_clock(None, "trainer")
    assert isinstance(clock, NoClock)
    with clock.during(COMPUTE):
        clock.beat()
    clock.close()
