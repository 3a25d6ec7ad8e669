# SPDX-License-Identifier: Apache-2.0
"""``accerl report``: its page tells a run's facts and nothing else, and cannot be turned against a reader."""

import json
import math
import re
import subprocess
import sys
from collections.abc import Sequence
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from accerl_lerobot import cli
from accerl_lerobot.algorithms import PPOConfig
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.console import Console, count, duration, number, rate
from accerl_lerobot.engines.config import LaunchConfig, RunConfig, encode
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation import Chart, EvaluationConfig, Rate, Series, evaluations_over_steps
from accerl_lerobot.report import ReportConfig, write_report
from accerl_lerobot.report.page import exploring
from accerl_lerobot.report.read import read_run
from accerl_lerobot.run import train as run
from tests.runs import tiny_run

EPISODES = 100  # of each evaluation
HOSTILE = "<script>document.title = 'owned'</script>\"'><img src=x onerror=\"document.title = 'owned'\">"


def run_config(**fields: Any) -> RunConfig:
    """A recipe on the simulated environment."""
    return RunConfig(env=SimulatedConfig(), trainer=TrainerConfig(updates=40), **fields)


def write_run(
    folder: Path,
    *,
    config: RunConfig | None = None,
    tasks: Sequence[str] = ("door-open-v3",),
    successes: tuple[int, int] = (40, 90),
    finished: bool = True,
    rollout: dict[str, Any] | None = None,
) -> Path:
    """A run of 40 updates, one a second, with an evaluation before and, if `finished`, after.

    `rollout` are further numbers of each record of the workers.
    """
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(encode(config or run_config()), sort_keys=False))
    lines = [evaluation("before", 0, successes[0], tasks)]
    for update in range(1, 41):
        when = {"wall_s": 10.0 + update, "update": float(update)}
        learnt = {"policy_loss": 1.0, "value_loss": 1 / update, "approx_kl": 0.02, "lr": 1e-4}
        lag = {"lag_mean": 3.0 + update % 2, "lag_max": 7.0 + update % 3}
        lines.append({"kind": "train"} | when | learnt | lag)
        # 100 env steps and one episode, beside those of the evaluation, which are of 10 steps each.
        counts = {"env_steps": 10.0 * EPISODES + 100.0 * update, "episodes": EPISODES + float(update)}
        worked = {"restarts": 0.0, "success_exploring": min(1.0, 0.2 + update / 100)}
        lines.append({"kind": "rollout"} | when | counts | worked | (rollout or {}))
    if finished:
        lines.append(evaluation("after", 40, successes[1], tasks))
        counts = {"env_steps": 4000, "episodes": 40, "updates": 40, "wall_s": 75.0}
        (folder / "summary.json").write_text(json.dumps(counts))
    write_lines(folder, lines)
    return folder


def write_lines(folder: Path, lines: list[dict[str, Any]]) -> None:
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def evaluation(group: str, update: int, successes: int, tasks: Sequence[str]) -> dict[str, Any]:
    ci95 = [*Rate(successes=successes, n=EPISODES).interval()]
    rate = {"success": successes / EPISODES, "n": EPISODES, "ci95": ci95}
    each = {task: rate | {"n": EPISODES // len(tasks)} for task in tasks}
    when = {"wall_s": 12.0 + update, "update": update, "env_steps": 100.0 * update}
    return {"kind": "evaluation", "group": group, "steps_mean": 10.0, "tasks": each} | rate | when


class Seen(HTMLParser):
    """Text and elements of a page; its style is no text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self._words: list[str] = []
        self.feed(re.sub(r"(?s)(?<=<style>).*?(?=</style>)", "", html))
        self.text = " ".join(" ".join(self._words).split())

    def named(self, tag: str) -> list[dict[str, str]]:
        """Attributes of all elements of a kind."""
        return [attributes for name, attributes in self.elements if name == tag]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))

    def handle_data(self, data: str) -> None:
        self._words.append(data)


def page_of(*runs: Path, **fields: Any) -> Seen:
    """Writes the report of runs, and reads it."""
    return Seen(write_report(ReportConfig(runs=tuple(map(str, runs)), **fields)).read_text())


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing them takes a second a page."""
    monkeypatch.setattr(Chart, "png", lambda chart: b"")


def test_a_run_that_was_really_made(tiny_checkpoint: Path, tmp_path: Path) -> None:
    evaluation = EvaluationConfig(episodes=8, every_updates=6, episodes_during=4, videos=1)
    launch, directory = LaunchConfig(engine="local"), tmp_path / "run"
    config = tiny_run(tiny_checkpoint, evaluation=evaluation, launch=launch, output_dir=str(directory))
    run.Run(config, run.make_output_dir(config), Console()).execute()
    seen = page_of(directory)
    summary = json.loads((directory / "summary.json").read_text())
    after, (low, high) = summary["success_after"], (f"{100 * end:.0f}" for end in summary["ci95_after"])
    rate = f"success {100 * after:.3g} % [{low}, {high}]"
    for part in (rate, f"env steps {summary['env_steps']:,}", "updates 12", "trainer.updates 12 1000"):
        assert part in seen.text
    charts = {image["alt"] for image in seen.named("img")}
    assert {"Success rate", "lag_mean, lag_max", "policy_loss", "value_loss"} <= charts
    assert len(evaluations_over_steps(read_run(directory).evaluations).x) == 3
    (video,) = seen.named("video")
    assert video["src"].startswith("data:video/mp4;base64,") and "controls" in video


def test_a_chart_is_drawn_whatever_its_numbers_and_names() -> None:
    line = Series(np.arange(30.0), np.full(30, np.nan))
    point = Series(np.array([1.0]), np.array([0.5]), np.array([[0.4], [0.6]]))
    assert not Chart("none", "x", {"a": line}).drawable
    chart = Chart("some", "x", {HOSTILE: line, "$\\frac{": point}, share=True, limit=3.0)
    assert chart.drawable and chart.png().startswith(b"\x89PNG")


@pytest.mark.usefixtures("no_pictures")
def test_numbers_of_a_known_run(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    seen, run = page_of(folder), read_run(folder)
    assert "Success on door-open-v3: 40 % [31, 50] → 90 % [83, 94]" in seen.text
    assert not [a for _, a in seen.elements if a.get("class") == "warnings"], "nothing went wrong"
    points = evaluations_over_steps(run.evaluations)
    assert (points.x.tolist(), points.y.tolist()) == ([0, 4000], [0.4, 0.9])
    # The 1000 env steps of the evaluation before are not experience; the first 24 episodes say nothing.
    assert exploring(run).x.tolist() == [100.0 * i for i in range(25, 41)]
    assert "mean lag 3.5" in seen.text and "bound of the lag 39 updates" in seen.text
    assert "env.tolerance 0.25 – env.reward success – trainer.updates 40 1000 All of it" in seen.text


@pytest.mark.usefixtures("no_pictures")
def test_what_went_wrong_is_said(tmp_path: Path) -> None:
    numbers = {"restarts": 2.0, "dropped_nonfinite": 1.0, "success_exploring": 0.0}
    text = page_of(write_run(tmp_path / "run", rollout=numbers)).text
    assert "2 restarts of a rollout worker" in text and "No exploring episode succeeded" in text
    assert "1 decisions thrown away, because the environment returned NaN" in text


@pytest.mark.usefixtures("no_pictures")
def test_a_run_that_is_going_on_and_one_that_has_died(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", finished=False)
    metrics = folder / "metrics.jsonl"
    metrics.write_text(metrics.read_text() + '{"kind": "tr')
    going = page_of(folder)
    assert "The run is not finished: there is no summary.json" in going.text
    assert len(going.named("img")) >= 6, "the last line of its metrics is incomplete, and left out"
    (folder / "error.log").write_text("Traceback …\nValueError: no film\n")
    assert "The run failed: ValueError: no film The traceback is in error.log." in page_of(folder).text
    metrics.unlink()
    assert page_of(folder).named("img") == [], "it has hardly begun"


@pytest.mark.usefixtures("no_pictures")
def test_runs_side_by_side(tmp_path: Path) -> None:
    a = write_run(tmp_path / "a" / "seed0", successes=(40, 90))
    ppo = run_config(algorithm=PPOConfig(), seed=1)
    b = write_run(tmp_path / "b" / "seed0", config=ppo, successes=(30, 60))
    c = write_run(tmp_path / "c", finished=False)
    text = page_of(a, b, c, output=str(tmp_path / "all.html")).text
    assert f"{a} 40 % [31, 50] 90 % [83, 94] gipo 0 40 40 4,000 3.5" in text
    assert f"{b} 30 % [22, 40] 60 % [50, 69] ppo 1 40 40 4,000 3.5" in text
    assert f"{c} 40 % [31, 50] – gipo" in text and f"{c}: The run is not finished" in text
    assert "seed 0 1 0 algorithm.type gipo ppo gipo algorithm.kl_coef 0.1 0.0 0.1" in text
    assert "algorithm.clip_low – 0.2 – algorithm.clip_high – 0.28 – Made by" in text


def test_text_of_a_run_is_text_and_everything_needed_is_inside(tmp_path: Path) -> None:
    """No element comes to be of a task, a recipe or a file name, and a browser asks for nothing."""
    config = run_config(job_name=HOSTILE, output_dir=HOSTILE)
    folder = write_run(tmp_path / "<b>&run", config=config, tasks=(HOSTILE, "door-open-v3"))
    (folder / "<i onclick='x'>.mp4").write_bytes(b"not really a video")
    other = write_run(tmp_path / "<script>2", config=config, tasks=(HOSTILE,))
    for seen in (page_of(folder), page_of(folder, other, output=str(tmp_path / "both.html"))):
        assert seen.named("script") == seen.named("i onclick") == []
        for _, attributes in seen.elements:
            assert not any(name.startswith("on") for name in attributes)
            for name in {"src", "href", "srcset", "poster", "data", "action"} & attributes.keys():
                assert attributes[name].startswith(("data:", "#")), name
        (policy,) = [m["content"] for m in seen.named("meta") if "http-equiv" in m]
        assert "default-src 'none'" in policy and "script" not in policy
        assert "<b>&run" in seen.text
    html = (folder / "report.html").read_text()
    assert HOSTILE in Seen(html).text and not re.search(r"@import|url\((?!#)", html)


def test_a_page_is_made_without_torch(tmp_path: Path) -> None:
    code = "import sys; from accerl_lerobot import cli; assert cli.main(['report', sys.argv[1]]) == 0\n"
    code += "assert not {'torch', 'ray', 'transformers'} & set(sys.modules)\n"
    subprocess.run([sys.executable, "-c", code, str(write_run(tmp_path / "run"))], check=True)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (number(None), "–"), (number(math.nan), "–"), (number(136266.0), "136,266"), (number(0.0), "0"),
        (number(0.0512345), "0.05123"), (rate(0.61333, (0.5, 0.7)), "61.3\xa0% [50, 70]"),
        (rate(None, None), "–"), (duration(59.96), "60 s"), (duration(593.0), "9 min 53 s"),
        (duration(7500.0), "2 h 05 min"), (duration(None), "–"), (count(1, "run"), "1 run"),
    ],
)  # fmt: skip
def test_numbers_as_text(text: str, expected: str) -> None:
    assert text == expected


def offline_run(folder: Path) -> Path:
    """A run of ``accerl offline``."""
    folder.mkdir()
    sections = {"policy": {"path": "p"}, "algorithm": {"type": "awr"}, "trainer": {"updates": 50}}
    (folder / "config.yaml").write_text(json.dumps({"seed": 3} | sections))
    made = [{"wall_s": 1.0 * n, "update": n, "imitation_loss": 1 / n} for n in (25, 50)]
    write_lines(folder, [{"kind": "train"} | record for record in made])
    losses = {"before": {"successes": 0.5, "failures": 0.4}, "after": {"successes": 0.1, "failures": 0.3}}
    summary = {"episodes": 60, "updates": 50, "wall_s": 12.0, "imitation_loss": losses}
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


@pytest.mark.usefixtures("no_pictures")
def test_a_run_of_offline_has_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = offline_run(tmp_path / "run")
    assert cli.main(["report", str(run)]) == 0
    assert capsys.readouterr().out == f"{run / 'report.html'}\n"
    text = Seen((run / "report.html").read_text()).text
    for part in ("accerl offline", "50 updates on recorded episodes: imitation loss 0.04 → 0.02", "seed 3"):
        assert part in text
    assert "finished" in text and "episodes 60" in text and "does not know" not in text
    both = [str(run), str(write_run(tmp_path / "other"))]
    assert cli.main(["report", *both, f"--output={tmp_path / 'x.html'}"]) == 0
    capsys.readouterr()
    for verb in (["timeline", str(run)], ["export", f"--path={run}", f"--root={tmp_path / 'root'}"]):
        assert cli.main(verb) == 2
        err = capsys.readouterr().err
        assert "accerl train" in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("config.yaml", b"a: [1,", "not good YAML"),
        ("config.yaml", b"job: else\n", "no run in it: there is no config.yaml of accerl train"),
        ("summary.json", b'{"success_before": null', "summary.json: not good JSON"),
        ("metrics.jsonl", b'{"kind": "train"}\n{"kin\n', "metrics.jsonl: line 2 is no record"),
        ("metrics.jsonl", b"7\n", "metrics.jsonl: line 1 is no record"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, name: str, content: bytes, said: str) -> None:
    folder = write_run(tmp_path / "run")
    (folder / name).write_bytes(content)
    with pytest.raises(InputError, match=said) as caught:
        read_run(folder)
    assert name in str(caught.value) and "\n" not in str(caught.value)
