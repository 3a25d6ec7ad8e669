# SPDX-License-Identifier: Apache-2.0
"""Seeded fuzzing of command lines and recipes: each wrong one is one line, and nothing is begun."""

from __future__ import annotations

import logging
import multiprocessing.process
import os
import random
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from accerl_lerobot import cli, guardian
from accerl_lerobot.cli import doctor, verbs
from accerl_lerobot.cli.verbs import CONFIGS
from accerl_lerobot.config.parsing import dotted_fields
from accerl_lerobot.run import preflight

CASES = 80
VALUES = [
    "-1", "0", "1e400", "99999999999999999999", ".nan", "-.inf", "0x_", "1:99:99", "2024-13-45", "null",
    "true", "[]", "{}", "[[1]]", "{a: 1}", "{[1]: 2}", "[" * 9000, "x" * 5000, "", " ", "*x",
    "!!python/object/apply:os.system [ls]", "!!timestamp x", "'", '"\\x', "- a\n- b: [", "a: b: c",
    "a: 1\na: 2", "\x00", "\x1b[2J", "\udcff", "💥", "𝟙", "\u202e1", "½", "foo", "cuda:99", "/dev/null/x",
    "../" * 2000, "~nobody/x", "hf_aaaaaaaaaaaaaaaaaaaa", "1,,2", "1e-4.5",
]  # fmt: skip
RECIPES = [
    "[", "- 1\n- 2\n", "3", "trainer: {lr: 1, lr: 2}\n", "trainer: [lr]\n", "trainer:\n\tlr: 1\n",
    "---\na: 1\n---\nb: 2\n", "env: {type: [a]}\n", "env: {type: {a: b}}\n", "algorithm: {type: null}\n",
    "null: 3\n", "{[1]: 2}: 3\n", "seed: 0x_\n", "trainer: {betas: {a: 1}}\n", "sft: {policy: 3}\n",
    "policy: {rename_map: [a, b]}\n", "[" * 20_000, "\ufeff\ufeffseed: 1", "seed: \ud83d\n",
]  # fmt: skip


class StartedWork(BaseException):
    """A folder, file or process was about to be made."""


def cases(seed: int) -> Iterator[tuple[str, list[str]]]:
    """Verb and arguments, few of them right; RECIPE stands for the path of a bad recipe."""
    rng = random.Random(seed)
    fields = {verb: sorted(set(dotted_fields(config))) for verb, config in CONFIGS.items()}
    for _ in range(CASES):
        verb = rng.choice(["train", rng.choice(sorted(fields))])
        field = rng.choice(fields[verb])
        value = rng.choice(VALUES)
        at = rng.randrange(len(field))
        misspelt = f"{field[:at]}{rng.choice(['', field[at] * 2, '.', 'ß'])}{field[at + 1 :]}"
        forms = [
            [f"--{field}={value}"],
            [f"--{misspelt}={value}"],
            [f"--{field}=1", f"--{field}={value}"],
            [f"--{field}.x={value}"],
            [f"--{field.partition('.')[0]}={value}"],
            [f"--config_path={value}"],
            [rng.choice(["--", "---x=1", "-x", f"--{field}", "--=1", "--config_path"])],
            ["RECIPE"],
        ]
        yield verb, rng.choice([*forms, forms[0], forms[0]])


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Makes every start of a process and every new folder an error, and works in an empty folder."""

    def refuse(*args: Any, **_: Any) -> None:
        raise StartedWork(args)

    parse = verbs.parse

    def parsed(*args: Any, **options: Any) -> Any:
        parse(*args, **options)
        raise StartedWork

    folder = tmp_path / "work"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setattr(guardian, "start", lambda: None)  # cleans up after what is begun
    monkeypatch.setattr(subprocess, "Popen", refuse)
    monkeypatch.setattr(multiprocessing.process.BaseProcess, "start", refuse)
    monkeypatch.setattr(os, "mkdir", refuse)
    monkeypatch.setattr(doctor, "machine", lambda **_: ())  # it draws a frame in a process
    monkeypatch.setattr(preflight, "check_start", refuse)  # imports LeRobot
    monkeypatch.setattr(verbs, "parse", parsed)
    monkeypatch.setattr(logging, "basicConfig", lambda **_: None)
    return folder


def test_wrong_input_is_one_line_and_begins_nothing(work: Path, tmp_path: Path, capsys):
    rng = random.Random(1)
    recipe = tmp_path / "recipe.yaml"
    refused = 0
    for case in cases(0):
        verb, arguments = case
        recipe.write_bytes(rng.choice(RECIPES).encode(errors="surrogatepass"))
        arguments = [argument.replace("RECIPE", f"--config_path={recipe}") for argument in arguments]
        try:
            code = cli.main([verb, *arguments])
        except StartedWork:
            continue  # the input happened to be right
        out, err = capsys.readouterr()
        line = out.splitlines()[0] if verb == "doctor" else err.rstrip("\n")
        assert code in (1, 2) and "\n" not in line, (case, err)
        assert "Traceback" not in out + err and "ACCERL_LOG" not in err, (case, err)
        assert len(line) < 1500
        refused += 1
    assert refused > 0.7 * CASES
    assert not list(work.iterdir())
