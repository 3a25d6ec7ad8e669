# SPDX-License-Identifier: Apache-2.0
"""How the time of roles divides, in all and in a part; workers that were started again; machines apart."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from accerl_lerobot.cli import main
from accerl_lerobot.errors import InputError
from accerl_lerobot.timeline import (
    CHECKPOINT,
    COMPUTE,
    EVALUATION,
    RECOVERY,
    TRAINING,
    WAIT_IN,
    WAIT_OUT,
    Moment,
    bubble,
)  # fmt: skip
from accerl_lerobot.timeline.read import (
    ABSENT,
    TimelineConfig,
    choose_window,
    read_timeline,
    show_timelines,
    timeline_table,
)
from tests.runs import printed
from tests.timeline.folders import SECOND, UP, a_clock, write_worker


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
    found = read_timeline(run).shares()
    assert found["rollout"] == pytest.approx({"compute": 0.4, "wait_in": 0.2, "wait_out": 0.4})
    assert found["trainer"] == pytest.approx({"compute": 4 / 9, "wait_in": 5 / 9})
    assert list(found) == ["driver", "rollout", "trainer"]
    assert bubble(found["rollout"]) == pytest.approx(0.6) and bubble(found["driver"]) == 0


def test_shares_of_a_part(run: Path) -> None:
    timeline = read_timeline(run)
    assert timeline.shares([(4.0, 6.0)])["trainer"] == pytest.approx({"wait_in": 0.5, "compute": 0.5})
    assert timeline.shares([(9.0, 10.0)])["rollout"] == pytest.approx({"wait_in": 0.5, "wait_out": 0.5})
    assert timeline.shares([(0.0, 0.5)]).keys() == {"driver", "rollout"}, "the trainer had not begun"
    # From second 2 to 8, the checkpoint included.
    assert timeline.shares(timeline.training())["trainer"] == pytest.approx({"wait_in": 0.5, "compute": 0.5})


def test_a_resumed_run_has_trained_twice(run: Path) -> None:
    write_worker(run, "driver", [(RECOVERY, 5), (CHECKPOINT, 1), (RECOVERY, 1), (TRAINING, 3)], at_s=100)
    write_worker(run, "trainer", [(RECOVERY, 6), (COMPUTE, 4)], at_s=100)
    timeline = read_timeline(run)
    assert timeline.training() == [(2.0, 8.0), (107.0, 110.0)]
    assert timeline.shares(timeline.training())["trainer"] == pytest.approx(
        {"wait_in": 3 / 9, "compute": 6 / 9}
    )


def test_a_worker_that_was_started_again_is_one_row_with_a_gap(tmp_path: Path) -> None:
    write_worker(tmp_path, "rollout 3", [(COMPUTE, 2)])
    write_worker(tmp_path, "rollout 3", [(RECOVERY, 1), (COMPUTE, 1)], at_s=4)
    (row,) = read_timeline(tmp_path).rows
    assert row.states.tolist() == [RECOVERY, COMPUTE, ABSENT, RECOVERY, COMPUTE]
    assert (row.times / SECOND).tolist() == [0, 0, 2, 4, 5, 6]
    assert read_timeline(tmp_path).shares()["rollout"] == pytest.approx({"compute": 0.75, "recovery": 0.25})
    # The next process begins before the last entries of this one end.
    write_worker(tmp_path, "rollout 3", [(COMPUTE, 1)], at_s=5.5)
    (row,) = read_timeline(tmp_path).rows
    assert (np.diff(row.times) >= 0).all() and len(row.states) == len(row.times) - 1
    assert row.times[-1] == 6.5 * SECOND


def test_machines_are_set_by_the_calendar_and_processes_of_one_by_its_clock(tmp_path: Path) -> None:
    """A clock that has run for another time, and a calendar that is put right meanwhile."""
    moments = {
        "trainer": Moment("here", UP, 2 * UP),
        "replay": Moment("here", UP + 5 * SECOND, 2 * UP + 9 * SECOND),
        "rollout 0": Moment("there", 77, 2 * UP + 3 * SECOND),
    }
    for worker, moment in moments.items():
        clock, hands = a_clock(tmp_path, worker, begins=moment)
        hands.now += SECOND
        clock.close()
    begins = {row.worker: int(row.times[0]) for row in read_timeline(tmp_path).rows}
    assert begins == {"trainer": 0, "replay": 5 * SECOND, "rollout 0": 3 * SECOND}


def test_workers_are_in_order(tmp_path: Path) -> None:
    for worker in ("trainer", "rollout 10", "world-model learning", "rollout 9", "driver", "someone new"):
        write_worker(tmp_path, worker, [(COMPUTE, 1)])
    names = [row.worker for row in read_timeline(tmp_path).rows]
    assert names == ["driver", "rollout 9", "rollout 10", "trainer", "world-model learning", "someone new"]


def test_a_folder_without_a_run_and_a_run_without_a_timeline(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    said = {"nowhere": "no such folder", "file": "a file", "empty": "no timeline in it"}
    for name, text in said.items():
        with pytest.raises(InputError, match=f"^runs='[^']*{name}': .*{text}"):
            read_timeline(tmp_path / name)


def write_run(folder: Path, turn: float = 0.5, turns: int = 200) -> Path:
    """The trainer computes half of each turn; the rollout worker is lost once, and the other waits then."""
    write_worker(folder, "driver", [(RECOVERY, 5), (TRAINING, turn * turns), (RECOVERY, 1)])
    write_worker(folder, "trainer", [(WAIT_IN, 5), *turns * [(COMPUTE, turn / 2), (WAIT_IN, turn / 2)]])
    write_worker(folder, "rollout 0", [(COMPUTE, 3)])
    write_worker(folder, "rollout 0", [(RECOVERY, 1), (COMPUTE, 5 + turn * turns)], at_s=4)
    write_worker(folder, "rollout 1", [(WAIT_IN, 2), (COMPUTE, 3 + turn * turns)])
    return folder


@pytest.fixture
def long_run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "run")


def test_a_window_is_in_the_middle_of_the_training_unless_it_is_chosen(long_run: Path) -> None:
    timeline = read_timeline(long_run)
    assert choose_window(timeline, None, 10.0) == pytest.approx((50.0, 60.0)), "the training is from 5 to 105"
    assert choose_window(timeline, 7.0, 3.0) == (7.0, 10.0)
    assert choose_window(timeline, 100.0, 30.0) == (100.0, timeline.seconds)
    with pytest.raises(InputError, match=r"^start_s=200\.0: use 0 or more, below 110\.0"):
        choose_window(timeline, 200.0, 10.0)


def test_pictures_stand_above_each_other_and_are_replaced(long_run, tmp_path, monkeypatch, capsys):
    assert main(["timeline", str(long_run)]) == 0
    result = json.loads(capsys.readouterr().out)
    with Image.open(long_run / "timeline.png") as image:
        one = image.size
        seen = {tuple(pixel[:3]) for _, pixel in image.convert("RGB").getcolors(2**20)}
    assert (0x3A, 0x7D, 0x44) in seen, "nobody works"
    assert result["picture"] == str(long_run / "timeline.png")
    assert result["runs"][0]["bubble"]["trainer"] == pytest.approx(0.5)
    other = write_run(tmp_path / "other")
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        show_timelines(TimelineConfig(runs=(str(long_run), str(other)), seconds=4.0))
    with Image.open(tmp_path / "timeline.png") as image:
        assert image.width == one[0] and image.height > 1.5 * one[1]
    text = printed(timeline_table(show_timelines(TimelineConfig(runs=(str(long_run), str(other))))))
    assert "other" in text and "bubble" in text and "50.0" in text


def test_a_place_that_cannot_hold_a_picture(long_run: Path, tmp_path: Path) -> None:
    for path, said in ((tmp_path / "a.svg", "PNG"), (tmp_path / "no" / "a.png", "a folder that exists")):
        with pytest.raises(InputError, match=f"^output=.*{said}"):
            show_timelines(TimelineConfig(runs=(str(long_run),), output=str(path)))
