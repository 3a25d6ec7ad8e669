# SPDX-License-Identifier: Apache-2.0
"""States exclude each other, leave no time out, and are on disk as they were; shares of roles; the trace."""

import itertools
import json
import threading
from pathlib import Path

import pytest

from accerl_lerobot import timeline
from accerl_lerobot.cli import main
from accerl_lerobot.timeline import COMPUTE, RECOVERY, STATES, TIMELINE, WAIT_IN, open_clock, read_timeline
from tests.timeline.folders import SECOND, write_worker


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
    monkeypatch.setattr(timeline, "MOST_BYTES", 1000 * timeline.ENTRY.itemsize)
    write_worker(tmp_path, "trainer", [("wait_in", 1), ("compute", 1)] * 1500)
    (row,) = read_timeline(tmp_path).rows
    assert 900 < len(row.states) <= 1000


def test_a_process_that_was_killed_leaves_all_but_what_was_on_its_way(tmp_path: Path) -> None:
    spans = [("recovery", 0), ("compute", 1), ("wait_in", 2), ("compute", 3)]
    write_worker(tmp_path, "trainer", spans)
    (path,) = (tmp_path / TIMELINE).iterdir()
    data = path.read_bytes()
    for size in range(len(data), 2 * timeline.ENTRY.itemsize - 1, -1):
        path.write_bytes(data[:size])
        (row,) = read_timeline(tmp_path).rows
        names = [STATES[state] for state in row.states]
        lengths = (row.ends - row.starts) / SECOND
        assert [*zip(names, lengths, strict=True)] == spans[: size // timeline.ENTRY.itemsize - 1]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Ten seconds; the driver trains from the second to the eighth, with a checkpoint in between."""
    driver = [("recovery", 1), ("evaluation", 1), ("training", 3), ("checkpoint", 1), ("training", 2)]
    write_worker(tmp_path, "driver", [*driver, ("evaluation", 2)])
    write_worker(tmp_path, "rollout 0", [("compute", 6), ("wait_in", 4)])
    write_worker(tmp_path, "rollout 1", [("compute", 2), ("wait_out", 8)])
    write_worker(tmp_path, "trainer", [("wait_in", 4), ("compute", 4), ("wait_in", 1)], at_s=1)
    return tmp_path


def test_shares_are_of_the_time_of_all_workers_of_a_role(run: Path) -> None:
    whole = read_timeline(run)
    found = whole.shares()
    assert found["rollout"] == pytest.approx({"compute": 0.4, "wait_in": 0.2, "wait_out": 0.4})
    assert found["trainer"] == pytest.approx({"compute": 4 / 9, "wait_in": 5 / 9})
    assert whole.shares((9.0, 10.0))["rollout"] == pytest.approx({"wait_in": 0.5, "wait_out": 0.5})
    assert whole.shares((0.0, 0.5)).keys() == {"driver", "rollout"}, "the trainer had not begun"
    assert whole.training() == (2.0, 8.0)
    assert whole.shares((2.0, 8.0))["trainer"] == pytest.approx({"wait_in": 0.5, "compute": 0.5})


def test_a_worker_that_was_started_again_is_one_row_with_a_gap(tmp_path: Path) -> None:
    write_worker(tmp_path, "rollout 3", [("compute", 2)])
    write_worker(tmp_path, "rollout 3", [("recovery", 1), ("compute", 1)], at_s=4)
    (row,) = read_timeline(tmp_path).rows
    assert (row.starts / SECOND).tolist() == [0, 0, 4, 5] and (row.ends / SECOND).tolist() == [0, 2, 5, 6]
    assert read_timeline(tmp_path).shares()["rollout"] == pytest.approx({"compute": 0.75, "recovery": 0.25})
    # The next process begins before the last entries of this one end.
    write_worker(tmp_path, "rollout 3", [("compute", 1)], at_s=5.5)
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
    assert main(["timeline", str(run), str(run)]) == 0
    assert {e["pid"] for e in json.loads(Path("timeline.json").read_text())} == {0, 1}
