# SPDX-License-Identifier: Apache-2.0
"""``accerl report`` as it is typed, a run's folder as data, and numbers as people read them."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from accerl_lerobot import cli
from accerl_lerobot.algorithms import PPOConfig
from accerl_lerobot.console import count, duration, number, percent, rate
from accerl_lerobot.demos.backbone import BackboneConfig
from accerl_lerobot.demos.sft import SFTConfig
from accerl_lerobot.engines.config import RunConfig, encode
from accerl_lerobot.errors import InputError
from accerl_lerobot.report.read import changed_fields, differences, read_run
from tests.report.folders import run_config, write_run
from tests.report.test_page import Seen


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "runs='': name the folder of a run"),
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
    assert "episodes 60" in text and "updates 50" in text and "seed 3" in text and "does not know" not in text
    both = [str(run), str(write_run(tmp_path / "other"))]
    assert cli.main(["report", *both, f"--output={tmp_path / 'x.html'}"]) == 0
    capsys.readouterr()
    for verb in (["timeline", str(run)], ["export", f"--path={run}", f"--root={tmp_path / 'root'}"]):
        assert cli.main(verb) == 2
        err = capsys.readouterr().err
        assert "accerl train" in err and err.count("\n") == 1


@pytest.mark.parametrize("tail", [b'{"kind": "tra', b"\xff\xfe", b"7"])
def test_a_last_line_that_is_no_record_is_left_out(tmp_path: Path, tail: bytes) -> None:
    folder = write_run(tmp_path / "run")
    with (folder / "metrics.jsonl").open("ab") as file:
        file.write(tail)
    run = read_run(folder)
    assert run.truncated and len(run.train) == 40 and len(run.evaluations) == 2


def test_a_line_in_the_middle_that_is_no_record_is_named(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    lines[6] = lines[6][:30]
    (folder / "metrics.jsonl").write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match=r"metrics\.jsonl:7.*is not a whole record; mend or remove"):
        read_run(folder)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("config.yaml", b"a: [1,", "not good YAML"),
        ("config.yaml", b"job: else\n", "no run in it: there is no config.yaml of accerl train"),
        ("summary.json", b'{"success_before": null', "summary.json: not good JSON"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, name: str, content: bytes, said: str) -> None:
    folder = write_run(tmp_path / "run")
    (folder / name).write_bytes(content)
    with pytest.raises(InputError, match=said) as caught:
        read_run(folder)
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_fields_that_differ() -> None:
    assert changed_fields(encode(RunConfig())) == []
    sft = SFTConfig(steps=5, backbone=BackboneConfig(hidden=8))
    changed = dict(changed_fields(encode(RunConfig(algorithm=PPOConfig(clip_high=0.3), sft=sft))))
    assert changed["algorithm.type"][0] == "ppo" and changed["algorithm.clip_high"][0] == 0.3
    assert changed["sft.backbone.hidden"][0] == 8 and "algorithm.gamma" not in changed
    a, b = (encode(run_config(seed=seed)) for seed in (1, 2))
    b["algorithm"] = {"type": "ppo"}
    b["output_dir"] = "elsewhere"
    rows = dict(differences([a, b]))
    assert rows["seed"] == [1, 2] and rows["algorithm.type"] == ["gipo", "ppo"]
    assert rows["algorithm.sigma"] == [1.0, "–"] and "output_dir" not in rows
