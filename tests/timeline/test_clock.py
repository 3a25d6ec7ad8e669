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
    PART_BYTES,
    RECOVERY,
    STATES,
    TIMELINE,
    WAIT_IN,
    WAIT_OUT,
    Clock,
    NoClock,
    open_clock,
)
from accerl_lerobot.timeline.read import Row, read_parts, read_timeline
from tests.timeline.folders import SECOND, UP, a_clock, write_worker


def lived(clock: Clock, hands, rng: random.Random, turns: int) -> list[tuple[int, int]]:
    """Enters states at random moments; what it was in, and how long, equal neighbours taken together."""
    spans = [(RECOVERY, 0)]
    for _ in range(turns):
        length = rng.choice((0, 1, 999, 10**6, 3 * 10**9))
        hands.now += length
        spans[-1] = (spans[-1][0], spans[-1][1] + length)
        if rng.random() < 0.1:
            clock.beat()
        else:
            state = rng.randrange(len(STATES))
            clock.enter(state)
            if state != spans[-1][0]:
                spans.append((state, 0))
    return spans


@pytest.mark.parametrize("seed", range(4))
def test_states_exclude_each_other_and_leave_no_time_out(tmp_path: Path, seed: int) -> None:
    clock, hands = a_clock(tmp_path)
    spans = lived(clock, hands, random.Random(seed), turns=3000)
    clock.close()
    (row,) = read_timeline(tmp_path).rows
    assert row.starts[0] == 0 and row.ends[-1] == hands.now - UP
    assert (row.starts[1:] == row.ends[:-1]).all()
    assert merged(lengths(row)) == merged(spans)


def lengths(row: Row) -> list[tuple[int, int]]:
    """States of a row, and how long each was."""
    return list(zip(row.states.tolist(), (row.ends - row.starts).tolist(), strict=True))


def merged(spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Spans with some length, equal neighbours taken together."""
    some = [span for span in spans if span[1]]
    return [(s, sum(n for _, n in own)) for s, own in itertools.groupby(some, key=lambda span: span[0])]


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
    for turn in range(5000):
        clock.enter((WAIT_IN, COMPUTE)[turn % 2])
    over.set()
    thread.join()
    clock.close()
    (process,) = read_parts(tmp_path / TIMELINE)
    assert len(process.states) == 5001 and (process.starts[1:] == process.ends[:-1]).all()


def test_what_is_old_makes_room_and_is_counted(tmp_path: Path) -> None:
    clock, hands = a_clock(tmp_path, part_bytes=8 * 1000)
    spans = lived(clock, hands, random.Random(0), turns=60_000)
    clock.close()
    files = list((tmp_path / TIMELINE).iterdir())
    # Two parts, each beyond its size by one batch of entries and a first line at most.
    assert len(files) == 2 and sum(f.stat().st_size for f in files) < 2 * (8 * (1000 + 512) + 1000)
    (row,) = read_timeline(tmp_path).rows
    kept = merged(lengths(row))
    assert len(kept) > 500 and kept[1:] == merged(spans)[-len(kept) + 1 :]
    assert PART_BYTES / 8 >= 400_000


def test_a_process_that_was_killed_leaves_all_but_what_was_on_its_way(tmp_path: Path) -> None:
    write_worker(tmp_path, "trainer", [(COMPUTE, 1.0), (WAIT_IN, 2.0), (COMPUTE, 3.0)])
    (path,) = (tmp_path / TIMELINE).iterdir()
    data = path.read_bytes()
    head = data.index(b"\n") + 1
    whole = [(RECOVERY, 0), (COMPUTE, SECOND), (WAIT_IN, 2 * SECOND), (COMPUTE, 3 * SECOND)]
    for size in range(len(data), -1, -1):
        path.write_bytes(data[:size])
        entries = max(0, size - head) // 8
        found = [lengths(row) for row in read_timeline(tmp_path).rows] if entries else []
        assert found == ([whole[:entries]] if entries else read_parts(tmp_path / TIMELINE))


@pytest.mark.parametrize(("head", "why"), [(b"no json", "Expecting value"), (b'{"timeline": 9}', "format 9")])
def test_a_damaged_file_is_named(tmp_path: Path, head: bytes, why: str) -> None:
    write_worker(tmp_path, "trainer", [(COMPUTE, 1.0), (WAIT_IN, 1.0)])
    (path,) = (tmp_path / TIMELINE).iterdir()
    path.write_bytes(head + b"\n" + bytes(8))
    with pytest.raises(InputError, match=rf"{path.name}.*damaged \(.*{why}") as caught:
        read_timeline(tmp_path)
    assert caught.value.field == "runs"


def test_without_a_folder_nothing_is_recorded() -> None:
    clock = open_clock(None, "trainer")
    assert isinstance(clock, NoClock)
    with clock.during(COMPUTE):
        clock.beat()
    clock.close()
