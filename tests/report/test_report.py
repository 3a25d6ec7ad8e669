# SPDX-License-Identifier: Apache-2.0
"""``accerl report`` as it is typed, and numbers as people read them."""

from __future__ import annotations

import contextlib
import json
import math
import random
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from accerl_lerobot import cli
from accerl_lerobot.console import count, duration, number, percent, rate
from accerl_lerobot.report.charts import Chart
from accerl_lerobot.timeline import TRAINING
from tests.report.folders import imagined, imagining, write_run
from tests.report.html import Seen
from tests.timeline.folders import write_worker


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "runs='': name the folder of a run: accerl report RUN"),
        (["a", "--runs=b"], "runs='b': leave out --runs or a: name them in one way"),
        (["a", "--outptu=1"], "no such field; did you mean output"),
        (["nowhere"], "runs='nowhere': no such folder"),
    ],
)
def test_mistakes_are_one_line(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["report", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == "" and said in err and err.count("\n") == 1


def test_a_page_is_made_without_torch(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    code = (
        "import sys; from accerl_lerobot import cli\n"
        "assert cli.main(['report', sys.argv[1]]) == 0\n"
        "heavy = {'torch', 'lerobot', 'ray', 'transformers'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    command = [sys.executable, "-c", code, str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{folder / 'report.html'}\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (number(None), "–"), (number(math.nan), "–"), (number(136266.0), "136,266"),
        (number(0.0512345), "0.05123"), (number(0.0), "0"), (number(-2.5), "-2.5"),
        (rate(0.46, [0.3656, 0.5574]), "46\xa0% [37, 56]"), (rate(0.61333, (0.5, 0.7)), "61.3\xa0% [50, 70]"),
        (rate(None, None), "–"), (percent(1.0), "100\xa0%"), (duration(3.21), "3.21 s"),
        (duration(59.96), "60 s"), (duration(593.0), "9 min 53 s"), (duration(7500.0), "2 h 05 min"),
        (duration(None), "–"), (count(1, "run"), "1 run"), (count(1234, "run"), "1,234 runs"),
    ],
)  # fmt: skip
def test_numbers_as_text(text: str, expected: str) -> None:
    assert text == expected


def offline_run(folder: Path) -> Path:
    """A run of ``accerl offline``."""
    folder.mkdir()
    config = {
        "seed": 3, "job_name": "offline", "policy": {"path": "p"}, "dataset": {"repo_id": "a/b"},
        "algorithm": {"type": "awr"}, "trainer": {"updates": 50},
    }  # fmt: skip
    (folder / "config.yaml").write_text(json.dumps(config))
    lines = [
        {"kind": "train", "wall_s": 1.0 * n, "update": n, "imitation_loss": 1 / n, "lr": 1e-4}
        for n in (25, 50)
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    losses = {"before": {"successes": 0.5, "failures": 0.4}, "after": {"successes": 0.1, "failures": 0.3}}
    summary = {"episodes": 60, "successes": 30, "decisions": 900, "updates": 50, "wall_s": 12.0}
    (folder / "summary.json").write_text(json.dumps(summary | {"imitation_loss": losses}))
    return folder


def test_a_run_of_offline_has_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = offline_run(tmp_path / "run")
    assert cli.main(["report", str(run)]) == 0
    text = Seen((run / "report.html").read_text()).text
    for part in ("accerl offline", "50 updates on recorded episodes: imitation loss 0.04 → 0.02", "finished"):
        assert part in text
    assert "episodes 60 30 successes" in text and "updates 50 of 50" in text and "seed 3" in text
    assert "env steps" not in text and "does not know" not in text
    both = [str(run), str(write_run(tmp_path / "other"))]
    assert cli.main(["report", *both, f"--output={tmp_path / 'x.html'}"]) == 0
    capsys.readouterr()
    for verb in (["timeline", str(run)], ["export", f"--path={run}", f"--root={tmp_path / 'root'}"]):
        assert cli.main(verb) == 2
        err = capsys.readouterr().err
        assert "accerl train" in err and err.count("\n") == 1


VALUES = [None, "x", [], {}, -1, 10**400, 1e308, True, [1], {"a": 1}]


def changed(content: Any, rng: random.Random) -> Any:
    """The content with one of its values removed or replaced."""
    if isinstance(content, (dict, list)) and content and rng.random() < 0.9:
        keys = list(content) if isinstance(content, dict) else range(len(content))
        key = rng.choice(keys)
        if isinstance(content, dict) and rng.random() < 0.2:
            return {name: value for name, value in content.items() if name != key}
        content[key] = changed(content[key], rng)
        return content
    return rng.choice(VALUES)


def damage(file: Path, rng: random.Random) -> None:
    """Cuts a file off, or changes a value in it."""
    data = file.read_bytes()
    if rng.random() < 0.3:
        file.write_bytes(data[: rng.randrange(len(data))])
    elif file.suffix == ".bin":
        head, _, rest = data.partition(b"\n")
        file.write_bytes(json.dumps(changed(json.loads(head), rng)).encode() + b"\n" + rest[3:])
    elif file.suffix == ".jsonl":
        lines = data.splitlines()
        number = rng.choice([0, len(lines) - 1, rng.randrange(len(lines))])
        lines[number] = json.dumps(changed(json.loads(lines[number]), rng)).encode()
        file.write_bytes(b"\n".join(lines) + b"\n")
    else:
        file.write_text(json.dumps(changed(yaml.safe_load(data), rng)))


def test_a_damaged_run_is_read_or_one_line_names_its_file(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(Chart, "svg", lambda chart: "")
    monkeypatch.setattr(cli, "guarded", contextlib.nullcontext)
    whole = write_run(tmp_path / "whole", config=imagining(), rollout=imagined())
    write_worker(whole, "driver", [(0, TRAINING), (5, TRAINING)])
    (whole / "checkpoints/last/pretrained_model/config.json").write_text(json.dumps({"type": "act"}))
    files = [file.relative_to(whole) for file in whole.rglob("*") if file.is_file()]
    rng, refused = random.Random(0), 0
    for case in range(150):
        run = Path(shutil.copytree(whole, tmp_path / f"run{case}"))
        file = rng.choice(files)
        damage(run / file, rng)
        verbs: list[list[str]] = [["report", str(run)]]
        verbs += [["timeline", str(run)]] if file.suffix == ".bin" else []
        for verb in verbs:
            code = cli.main(verb)
            err = capsys.readouterr().err
            assert code in (0, 2), (file, err)
            if code:
                assert err.count("\n") == 1 and file.name in err or "timeline" in err, (file, err)
                refused += 1
        shutil.rmtree(run)
    assert refused > 20
