# SPDX-License-Identifier: Apache-2.0
"""Views for people: the picture and the shares."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from PIL import Image
from rich.console import Console

from accerl_lerobot.cli import main
from accerl_lerobot.errors import InputError
from accerl_lerobot.timeline import COMPUTE, RECOVERY, TRAINING, WAIT_IN
from accerl_lerobot.timeline.read import (
    TimelineConfig,
    choose_window,
    read_timeline,
    show_timelines,
    timeline_table,
)
from tests.timeline.folders import write_worker


def write_run(folder: Path, turn: float = 0.5, turns: int = 200) -> Path:
    """The trainer computes half of each turn; the rollout worker is lost once, and the other waits then."""
    write_worker(folder, "driver", [(RECOVERY, 5), (TRAINING, turn * turns), (RECOVERY, 1)])
    write_worker(folder, "trainer", [(WAIT_IN, 5), *turns * [(COMPUTE, turn / 2), (WAIT_IN, turn / 2)]])
    write_worker(folder, "rollout 0", [(COMPUTE, 3)])
    write_worker(folder, "rollout 0", [(RECOVERY, 1), (COMPUTE, 5 + turn * turns)], at_s=4)
    write_worker(folder, "rollout 1", [(WAIT_IN, 2), (COMPUTE, 3 + turn * turns)])
    return folder


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "run")


def test_a_window_is_in_the_middle_of_the_training_unless_it_is_chosen(run: Path) -> None:
    timeline = read_timeline(run)
    assert choose_window(timeline, None, 10.0) == pytest.approx((50.0, 60.0)), "the training is from 5 to 105"
    assert choose_window(timeline, 7.0, 3.0) == (7.0, 10.0)
    assert choose_window(timeline, 100.0, 30.0) == (100.0, timeline.seconds)
    with pytest.raises(InputError, match=r"^start_s=200\.0: use 0 or more, below 110\.0"):
        choose_window(timeline, 200.0, 10.0)


def test_pictures_stand_above_each_other_and_are_replaced(run, tmp_path, monkeypatch, capsys):
    assert main(["timeline", str(run)]) == 0
    result = json.loads(capsys.readouterr().out)
    with Image.open(run / "timeline.png") as image:
        one = image.size
        seen = {tuple(pixel[:3]) for _, pixel in image.convert("RGB").getcolors(2**20)}
    assert (0x3A, 0x7D, 0x44) in seen, "nobody works"
    assert result["picture"] == str(run / "timeline.png")
    assert result["runs"][0]["bubble"]["trainer"] == pytest.approx(0.5)
    other = write_run(tmp_path / "other")
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        show_timelines(TimelineConfig(runs=(str(run), str(other)), seconds=4.0))
    with Image.open(tmp_path / "timeline.png") as image:
        assert image.width == one[0] and image.height > 1.5 * one[1]
    console = Console(width=79, record=True, file=io.StringIO())
    console.print(timeline_table(show_timelines(TimelineConfig(runs=(str(run), str(other))))))
    text = console.export_text()
    assert "other" in text and "bubble" in text and "50.0" in text


def test_a_place_that_cannot_hold_a_picture(run: Path, tmp_path: Path) -> None:
    for path, said in ((tmp_path / "a.svg", "PNG"), (tmp_path / "no" / "a.png", "a folder that exists")):
        with pytest.raises(InputError, match=f"^output=.*{said}"):
            show_timelines(TimelineConfig(runs=(str(run),), output=str(path)))
