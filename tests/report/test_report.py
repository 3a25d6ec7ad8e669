# SPDX-License-Identifier: Apache-2.0
"""``accerl report`` as it is typed, and numbers as people read them."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import pytest

from accerl_lerobot import cli
from accerl_lerobot.console import count, duration, number, percent, rate
from tests.report.folders import write_run


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
