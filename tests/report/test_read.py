# SPDX-License-Identifier: Apache-2.0
"""A run's folder as data: truncated, missing or damaged files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.errors import InputError
from accerl_lerobot.report.read import column, newest, read_run
from tests.report.folders import write_run


@pytest.mark.parametrize("tail", [b'{"kind": "tra', b"\xff\xfe", b"7"])
def test_a_last_line_that_is_no_record_is_left_out(tmp_path: Path, tail: bytes) -> None:
    folder = write_run(tmp_path / "run")
    with (folder / "metrics.jsonl").open("ab") as file:
        file.write(tail)
    run = read_run(folder)
    assert run.truncated and len(run.records["train"]) == 40 and len(run.records["evaluation"]) == 2


def test_a_line_in_the_middle_that_is_no_record_is_named(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    lines[6] = lines[6][:30]
    (folder / "metrics.jsonl").write_text("\n".join(lines) + "\n")
    with pytest.raises(
        InputError, match=r"metrics\.jsonl:7.*is not a whole record; mend or remove this line"
    ):
        read_run(folder)


def test_what_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        read_run(tmp_path / "nowhere")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="a file; name the folder of a run"):
        read_run(tmp_path / "file")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no run in it: there is no config.yaml"):
        read_run(tmp_path / "empty")
    (tmp_path / "empty" / "config.yaml").write_text("job: else\n")
    with pytest.raises(InputError, match="its config.yaml is not one of accerl train"):
        read_run(tmp_path / "empty")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("config.yaml", b"a: [1,", "not good YAML"),
        ("config.yaml", b"- a\n", "a recipe is a mapping"),
        ("config.yaml", b"\xff\xff", "not good YAML"),
        ("summary.json", b'{"success_before": null', "summary.json: not good JSON"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, name: str, content: bytes, said: str) -> None:
    folder = write_run(tmp_path / "run")
    (folder / name).write_bytes(content)
    with pytest.raises(InputError, match=said) as caught:
        read_run(folder)
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_columns_hold_numbers_only() -> None:
    records: list[dict[str, Any]] = [{"a": 1}, {}, {"a": None}, {"a": "x"}, {"a": 2.5}]
    assert np.array_equal(column(records, "a"), [1, np.nan, np.nan, np.nan, 2.5], equal_nan=True)
    assert newest(records, "a") == 2.5 and newest(records, "b") is None
