# SPDX-License-Identifier: Apache-2.0
"""A page tells a run's facts and nothing else, and cannot be turned against its reader."""

from __future__ import annotations

import json
import os
import re
import time
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.console import Console
from accerl_lerobot.engines.config import LaunchConfig
from accerl_lerobot.evaluation import EvaluationConfig
from accerl_lerobot.report import ReportConfig, write_report
from accerl_lerobot.report.page import Chart, Series, evaluated, exploring
from accerl_lerobot.report.read import read_run
from accerl_lerobot.run import train as run
from accerl_lerobot.timeline import COMPUTE, RECOVERY, TRAINING, WAIT_IN
from tests.report.folders import HOSTILE, imagined, imagining, ppo, run_config, write_run
from tests.runs import tiny_run
from tests.timeline.folders import write_worker


class Seen(HTMLParser):
    """Text and elements of a page; its style is no text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self._words: list[str] = []
        self._in_style = False
        self.feed(html)
        self.text = " ".join(" ".join(self._words).split())

    def named(self, tag: str) -> list[dict[str, str]]:
        """Attributes of all elements of a kind."""
        return [attributes for name, attributes in self.elements if name == tag]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        self._in_style = tag == "style"

    def handle_data(self, data: str) -> None:
        if not self._in_style:
            self._words.append(data)


def page_of(*runs: Path, **fields: Any) -> Seen:
    """Writes the report of runs, and reads it."""
    path = write_report(ReportConfig(runs=tuple(map(str, runs)), **fields))
    return Seen(path.read_text())


@pytest.fixture
def pictures() -> None:
    """Charts are drawn, which takes a second a page; tests of other things do without."""


@pytest.fixture(autouse=True)
def stand_in(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "pictures" not in request.fixturenames:
        monkeypatch.setattr(Chart, "png", lambda chart: "")


def test_a_run_that_was_really_made(pictures: None, tiny_checkpoint: Path, tmp_path: Path) -> None:
    evaluation = EvaluationConfig(episodes=8, every_updates=6, episodes_during=4, videos=1)
    launch, directory = LaunchConfig(engine="local"), tmp_path / "run"
    config = tiny_run(tiny_checkpoint, evaluation=evaluation, launch=launch, output_dir=str(directory))
    run.Run(config, run.make_output_dir(config), Console()).execute()
    seen = page_of(directory)
    summary = json.loads((directory / "summary.json").read_text())
    after, (low, high) = summary["success_after"], (f"{100 * end:.0f}" for end in summary["ci95_after"])
    for part in (
        f"success {100 * after:.3g} % [{low}, {high}]", f"{100 * after:.3g} % [{low}, {high}] 8",
        f"env steps {summary['env_steps']:,}", "gipo", "seed 0", "finished", "updates 12",
        "trainer.updates 12 1000", "env.type simulated metaworld",
    ):  # fmt: skip
        assert part in seen.text
    charts = [image["alt"] for image in seen.named("img")]
    assert {"Success rate", "lag_mean, lag_max", "policy_loss", "value_loss"} <= set(charts)
    assert len(evaluated(read_run(directory)).x) == 3
    (video,) = seen.named("video")
    assert video["src"].startswith("data:video/mp4;base64,") and "controls" in video


def test_everything_needed_is_inside(pictures: None, tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    (folder / "before_after.mp4").write_bytes(b"not really a video")
    html = write_report(ReportConfig(runs=(str(folder),))).read_text()
    seen = Seen(html)
    for tag, attributes in seen.elements:
        for name in ("src", "href", "srcset", "poster", "data", "action"):
            value = attributes.get(name, "")
            assert value == "" or value.startswith(("data:", "#")), (tag, value)
    assert not re.search(r"@import|url\((?!#)", html) and seen.named("script") == []
    (policy,) = [m["content"] for m in seen.named("meta") if m.get("http-equiv") == "Content-Security-Policy"]
    assert "default-src 'none'" in policy and "script" not in policy


def test_a_chart_is_drawn_whatever_its_numbers_and_names(pictures: None) -> None:
    line = Series(np.arange(30.0), np.full(30, np.nan))
    point = Series(np.array([1.0]), np.array([0.5]), np.array([[0.4], [0.6]]))
    assert not Chart("none", "x", {"a": line}).drawable
    chart = Chart("some", "x", {HOSTILE: line, "$\\frac{": point}, share=True, limit=3.0)
    assert chart.drawable and chart.png().startswith("iVBOR"), "a PNG"


def test_numbers_of_a_known_run(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    seen, run = page_of(folder), read_run(folder)
    assert "Success on door-open-v3: 40 % [31, 50] → 90 % [83, 94]" in seen.text
    assert not [a for _, a in seen.elements if a.get("class") == "warnings"], "nothing went wrong"
    points = evaluated(run)
    assert (points.x.tolist(), points.y.tolist()) == ([0, 4000], [0.4, 0.9])
    # The 1000 env steps of the evaluation before are not experience; the first 24 episodes say nothing.
    assert exploring(run).x.tolist() == [100.0 * i for i in range(25, 41)]
    assert "mean lag 3.5" in seen.text and "bound of the lag 39 updates" in seen.text


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ({"restarts": 2.0}, "2 restarts of a rollout worker"),
        ({"dropped_nonfinite": 1.0}, "1 decisions thrown away, because the environment returned NaN"),
        ({"skipped": 4.0}, "4 updates skipped"),
        ({"success_exploring": 0.0}, "No exploring episode succeeded"),
        ({"low_weight": 0.4}, "Many samples hardly counted"),
        (imagined(success=1.0), "Imagined episodes succeed far more often than real ones, 100 % and"),
    ],
)
def test_what_went_wrong_is_said(tmp_path: Path, numbers: dict[str, float], said: str) -> None:
    assert said in page_of(write_run(tmp_path / "run", rollout=numbers, train=numbers)).text


def test_what_was_noted_of_episodes_is_said(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    summary, metrics = folder / "summary.json", folder / "metrics.jsonl"
    summary.write_text(json.dumps(json.loads(summary.read_text()) | {"note": "no such key"}))
    noted = '"notes": ["3 of 9 episodes: no such key"], "group": "after"'
    metrics.write_text(metrics.read_text().replace('"group": "after"', noted))
    text = page_of(folder).text
    assert "Evaluation after, 3 of 9 episodes: no such key." in text
    assert "While exploring, no such key." in text and "Evaluation before" not in text


def test_a_recipe_with_types_of_another_package_is_compared_with_the_usual_defaults(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    recipe = (folder / "config.yaml").read_text()
    (folder / "config.yaml").write_text(recipe.replace("type: gipo", "type: cispo\n  cap: 7.5"))
    text = page_of(folder).text
    assert "algorithm.type cispo gipo" in text and "algorithm.cap 7.5 –" in text


def test_how_workers_spent_their_time_in_the_training(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    write_worker(folder, "driver", [(RECOVERY, 1), (TRAINING, 4)])
    write_worker(folder, "rollout 0", [(RECOVERY, 1), (COMPUTE, 3), (WAIT_IN, 1)])
    assert "rollout compute 75 % wait in 25 %" in page_of(folder).text


def test_a_run_that_is_going_on_and_one_that_has_died(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", finished=False)
    with (folder / "metrics.jsonl").open("a") as file:
        file.write('{"kind": "tr')
    going = page_of(folder)
    assert "The run is still going: there is no summary.json" in going.text
    assert "40 of 40 updates on door-open-v3" in going.text and "success – algorithm" in going.text
    assert "The last line of metrics.jsonl is incomplete" in going.text and len(going.named("img")) >= 9
    (folder / "error.log").write_text("Traceback …\nValueError: no film\n")
    assert "The run failed: ValueError: no film The traceback is in error.log." in page_of(folder).text
    for path in folder.iterdir():
        os.utime(path, (time.time() - 7200, time.time() - 7200 - (path.name == "error.log")))
    assert "The run is not finished" in page_of(folder).text
    (folder / "metrics.jsonl").unlink()
    begun = page_of(folder)
    assert begun.named("img") == [] and "0 of 40 updates on match" in begun.text


def test_imagined_rollouts(tmp_path: Path) -> None:
    for name, numbers, shown in (("on", imagined(), True), ("off", {}, False)):
        text = page_of(write_run(tmp_path / name, config=imagining(), rollout=numbers)).text
        assert ("Imagined rollouts" in text) is shown


def test_runs_side_by_side(tmp_path: Path) -> None:
    a = write_run(tmp_path / "a" / "seed0", successes=(40, 90))
    b = write_run(tmp_path / "b" / "seed0", config=ppo(seed=1), successes=(30, 60))
    c = write_run(tmp_path / "c", finished=False)
    text = page_of(a, b, c, output=str(tmp_path / "all.html")).text
    assert "2 of 3 finished" in text and "3 training runs" in text
    assert f"{a} 40 % [31, 50] 90 % [83, 94] gipo 0 40 40 4,000 3.5" in text
    assert f"{b} 30 % [22, 40] 60 % [50, 69] ppo 1 40 40 4,000 3.5" in text
    assert "c 40 % [31, 50] – gipo" in text and "c: The run is still going" in text
    assert "algorithm.type gipo ppo gipo" in text and "replay.capacity" not in text


def test_text_of_a_run_is_text(tmp_path: Path) -> None:
    """In tasks, recipes and file names; no element of it comes to be."""
    config = run_config(job_name=HOSTILE, output_dir=HOSTILE)
    folder = write_run(tmp_path / "<b>&run", config=config, tasks=(HOSTILE, "door-open-v3"))
    (folder / "<i onclick='x'>.mp4").write_bytes(b"")
    other = write_run(tmp_path / "<script>2", config=config, tasks=(HOSTILE,))
    for seen in (page_of(folder), page_of(folder, other, output=str(tmp_path / "both.html"))):
        assert seen.named("script") == seen.named("i onclick") == []
        assert not any(name.startswith("on") for _, attributes in seen.elements for name in attributes)
        assert "<b>&run" in seen.text
    assert HOSTILE in page_of(folder).text


def test_a_large_video_is_linked(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "a run")
    (folder / "before_after.mp4").write_bytes(bytes(20_000_001))
    seen = page_of(folder, output=str(tmp_path / "elsewhere.html"))
    assert seen.named("video") == [] and {"href": "a%20run/before_after.mp4"} in seen.named("a")
