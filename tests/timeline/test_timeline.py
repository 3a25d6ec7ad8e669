# SPDX-License-Identifier: Apache-2.0
"""States exclude each other, leave no time out, and are on disk as they were; shares of roles; the trace."""

import itertools
import json
import random
import threading
from pathlib import Path

import pytest

from accerl_lerobot import timeline
from accerl_lerobot.cli import main
from accerl_lerobot.timeline import (
    CHECKPOINT,
    COMPUTE,
    ENTRY,
    EVALUATION,
    RECOVERY,
    STATES,
    TIMELINE,
    TRAINING,
    WAIT_IN,
    WAIT_OUT,
    Row,
    TimelineConfig,
    open_clock,
    read_timeline,
    write_trace,
)  # fmt: skip
from tests.timeline.folders import BEGIN, SECOND, a_clock, write_worker


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
    assert row.starts[0] == 0 and row.ends[-1] == hands.now - BEGIN
    assert (row.starts[1:] == row.ends[:-1]).all()
    assert merged(lengths(row)) == merged(spans)


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


def test_a_long_run_does_not_fill_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timeline, "MOST_BYTES", 1000 * ENTRY.itemsize)
    clock, hands = a_clock(tmp_path)
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
    whole = [(RECOVERY, 0), (COMPUTE, SECOND), (WAIT_IN, 2 * SECOND), (COMPUTE, 3 * SECOND)]
    for size in range(len(data), 2 * ENTRY.itemsize - 1, -1):
        path.write_bytes(data[:size])
        (row,) = read_timeline(tmp_path).rows
        assert lengths(row) == whole[: size // ENTRY.itemsize - 1]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Ten seconds; the driver trains from the second to the eighth, with a checkpoint in between."""
    driver = [(RECOVERY, 1), (EVALUATION, 1), (TRAINING, 3), (CHECKPOINT, 1), (TRAINING, 2), (EVALUATION, 2)]
    write_worker(tmp_path, "driver", driver)
    write_worker(tmp_path, "rollout 0", [(COMPUTE, 6), (WAIT_IN, 4)])
    write_worker(tmp_path, "rollout 1", [(COMPUTE, 2), (WAIT_OUT, 8)])
    write_worker(tmp_path, "trainer", [(WAIT_IN, 4), (COMPUTE, 4), (WAIT_IN, 1)], at_s=1)
    return tmp_path


def test_shares_are_of_the_time_of_all_workers_of_a_role(run: Path) -> None:
    whole = read_timeline(run)
    found = whole.shares()
    assert found["rollout"] == pytest.approx({"compute": 0.4, "wait_in": 0.2, "wait_out": 0.4})
    assert found["trainer"] == pytest.approx({"compute": 4 / 9, "wait_in": 5 / 9})
    assert list(found) == ["driver", "rollout", "trainer"]
    assert whole.shares((9.0, 10.0))["rollout"] == pytest.approx({"wait_in": 0.5, "wait_out": 0.5})
    assert whole.shares((0.0, 0.5)).keys() == {"driver", "rollout"}, "the trainer had not begun"
    assert whole.training() == (2.0, 8.0)
    assert whole.shares((2.0, 8.0))["trainer"] == pytest.approx({"wait_in": 0.5, "compute": 0.5})


def test_a_worker_that_was_started_again_is_one_row_with_a_gap(tmp_path: Path) -> None:
    write_worker(tmp_path, "rollout 3", [(COMPUTE, 2)])
    write_worker(tmp_path, "rollout 3", [(RECOVERY, 1), (COMPUTE, 1)], at_s=4)
    (row,) = read_timeline(tmp_path).rows
    assert row.states.tolist() == [RECOVERY, COMPUTE, RECOVERY, COMPUTE]
    assert (row.starts / SECOND).tolist() == [0, 0, 4, 5] and (row.ends / SECOND).tolist() == [0, 2, 5, 6]
    assert read_timeline(tmp_path).shares()["rollout"] == pytest.approx({"compute": 0.75, "recovery": 0.25})
    # The next process begins before the last entries of this one end.
    write_worker(tmp_path, "rollout 3", [(COMPUTE, 1)], at_s=5.5)
    (row,) = read_timeline(tmp_path).rows
    assert (row.starts[1:] >= row.ends[:-1]).all() and row.ends[-1] == 6.5 * SECOND


def test_a_trace_that_perfetto_shows(run: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    assert main(["timeline", str(run)]) == 0
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert found["trace"] == str(run / "timeline.json") and "ui.perfetto.dev" in err
    assert found["runs"][0]["training_s"] == [2.0, 8.0] and "rollout" in found["runs"][0]["shares"]
    assert "trainer              compute 50%, wait_in 50%" in err
    events = json.loads((run / "timeline.json").read_text())
    names = {e["tid"]: e["args"]["name"] for e in events if e["name"] == "thread_name"}
    assert list(names.values()) == ["driver", "rollout 0", "rollout 1", "trainer"]
    spans = [(names[e["tid"]], e["name"], e["ts"], e["dur"]) for e in events if e["ph"] == "X" and e["dur"]]
    assert ("rollout 0", "wait_in", 6e6, 4e6) in spans and ("trainer", "compute", 5e6, 4e6) in spans
    monkeypatch.chdir(tmp_path)
    write_trace(TimelineConfig(runs=(str(run), str(run))))
    assert {e["pid"] for e in json.loads(Path("timeline.json").read_text())} == {0, 1}
