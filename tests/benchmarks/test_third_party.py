# SPDX-License-Identifier: Apache-2.0
"""Packages of other people: how a command is put together, and what counts as right."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from benchmarks import third_party
from benchmarks.third_party import BenchThirdPartyConfig, bench_third_party, came_out, words

TABLE = yaml.safe_load(Path(third_party.__file__).with_suffix(".yaml").read_text())


def test_every_situation_is_a_command_of_ours(tmp_path: Path):
    for situation in TABLE["situations"]:
        arguments = words(situation["command"], TABLE["texts"], tmp_path)
        names = [argument.partition("=")[0] for argument in arguments]
        assert arguments[0] in ("eval", "train", "demos") and len(set(names)) == len(names), arguments
        assert situation.get("policy") in (None, *TABLE["policies"])
        for pattern in ("prints", "not_prints"):
            re.compile(situation.get(pattern, ""))
    assert words("demos --root={folder}/x '--env.task=a b'", {}, Path("/r")) == [
        "demos", "--root=/r/x", "--env.task=a b",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("code", "printed", "right"),
    [
        (0, "Summary: 7 PASS | 4 WARN\n", True),
        (0, "Summary: 7 PASS | 1 FAIL\n", False),
        (0, "", False),
        (1, "accerl: no folder", False),
        (None, "", False),
    ],
)
def test_right_is_the_exit_code_and_what_is_printed(
    code: int | None, printed: str, right: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(third_party, "run", lambda command, timeout_s: (code, printed))
    monkeypatch.setattr(third_party, "distributions", list)
    config = BenchThirdPartyConfig(packages=("lerobot-doctor",), output_dir=str(tmp_path / "a"))
    assert bench_third_party(config)["skipped"] == ["lerobot-doctor"]

    class Doctor:
        name, version = "lerobot_Doctor", "0.2.0"

    monkeypatch.setattr(third_party, "distributions", lambda: [Doctor])
    config = BenchThirdPartyConfig(packages=("lerobot-doctor",), output_dir=str(tmp_path / "b"))
    (row,) = bench_third_party(config)["rows"]
    assert (row["version"], row["right"], row["came_out"]) == ("0.2.0", right, came_out(code, printed))


def test_the_line_of_the_error_or_the_warnings():
    assert came_out(2, "x\naccerl: env.id='a': b\n") == "exit code 2: accerl: env.id='a': b"
    assert came_out(0, "WARNING accerl_lerobot.envs: a\nWARNING accerl_lerobot.envs: a\nn=3") == (
        "done; WARNING accerl_lerobot.envs: a"
    )
    assert came_out(None, "x") == "no end within the time allowed"
