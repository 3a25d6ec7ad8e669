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
from accerl_lerobot.cli import doctor
from accerl_lerobot.cli.verbs import CONFIGS
from accerl_lerobot.config.parsing import dotted_fields

CASES = 120


VALUES = [
    "-1", "0", "1e400", "99999999999999999999", ".nan", "-.inf", "0x_", "1:99:99", "2024-13-45", "null",
    "true", "[]", "{}", "[[1]]", "{a: 1}", "{[1]: 2}", "[" * 9000, "x" * 5000, "", " ", "*x",
    "!!python/object/apply:os.system [ls]", "!!timestamp x", "'", '"\\x', "- a\n- b: [", "a: b: c",
    "a: 1\na: 2", "\x00", "\x1b[2J", "\udcff", "💥", "𝟙", "\u202e1", "½", "foo", "cuda:99", "/dev/null/x",
    "../" * 2000, "~nobody/x", "hf_aaaaaaaaaaaaaaaaaaaa", "1,,2", "1e-4.5",
]  # fmt: skip
RECIPES = [
    "[", "a: [1, 2", "- 1\n- 2\n", "3", "text", "trainer: {lr: 1, lr: 2}\n", "trainer: 3\n",
    "trainer: [lr]\n", "trainer:\n\tlr: 1\n", "---\na: 1\n---\nb: 2\n",
    "!!python/object/apply:os.system [ls]\n", "save_every_s: *t\n", "env: {type: [a]}\n",
    "env: {type: {a: b}}\n", "algorithm: {type: null}\n", "null: 3\n", "3: {a: 1}\n", "{[1]: 2}: 3\n",
    "seed: 0x_\n", "job_name: 2024-13-45\n", "trainer: {betas: {a: 1}}\n", "sft: {policy: 3}\n",
    "policy: {rename_map: [a, b]}\n", "[" * 20_000, "\ufeff\ufeffseed: 1", "seed: \ud83d\n",
]  # fmt: skip


class StartedWork(BaseException):
    """A folder, file or process was about to be made."""


def cases(seed: int, count: int) -> Iterator[tuple[str, list[str], str | None]]:
    """Verb, arguments and recipe; about one in ten happens to be right."""
    rng = random.Random(seed)
    fields = {verb: sorted(set(dotted_fields(config))) for verb, config in CONFIGS.items()}
    quickstart = (Path(__file__).parents[1] / "recipes" / "quickstart.yaml").read_text()
    for _ in range(count):
        verb = rng.choice(["train", rng.choice(sorted(fields))])
        field, value, kind = rng.choice(fields[verb]), rng.choice(VALUES), rng.randrange(10)
        recipe = None
        if kind < 4:
            arguments = [f"--{field}={value}"]
        elif kind == 4:  # a name with a letter more, less or elsewhere
            at = rng.randrange(len(field))
            arguments = [
                f"--{field[:at]}{rng.choice(['', field[at] * 2, '.', 'ß'])}{field[at + 1 :]}={value}"
            ]
        elif kind == 5:
            arguments = [f"--{field}=1", f"--{field}={value}"]
        elif kind == 6:
            section = field.partition(".")[0]
            arguments = rng.choice(
                [["--"], ["---x=1"], ["-x"], [f"--{field}"], [value, value], ["--=1"],
                 [f"--{section}={value}"], [f"--{field}.x={value}"], ["--config_path"],
                 [f"--config_path={value}"], ["=", "="]]
            )  # fmt: skip
        elif kind == 7:
            recipe, arguments = rng.choice(RECIPES), []
        elif kind == 8:  # a good recipe with some letters changed
            letters = list(quickstart)
            for _ in range(rng.randrange(1, 4)):
                letters[rng.randrange(len(letters))] = rng.choice(
                    ["", "\t", ":", "[", "{", "'", "💥", "\n", "-", "9" * 20]
                )
            recipe, arguments = "".join(letters), []
        else:
            recipe, arguments = quickstart, [f"--{field}={value}", "--trainer.lrr=1"]
        yield verb, arguments, recipe


def told(verb: str, arguments: list[str], recipe: str | None, folder: Path) -> int:
    """The exit code; a recipe is written into `folder` first."""
    if recipe is not None:
        path = folder / "recipe.yaml"
        path.write_bytes(recipe.encode(errors="surrogatepass"))
        arguments = [f"--config_path={path}", *arguments]
    return cli.main([*verb.split(), *arguments])


@pytest.fixture
def nothing_is_begun(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Makes every start of a process and every new folder an error, and works in an empty folder."""

    def refuse(*args: Any, **_: Any) -> None:
        raise StartedWork(args)

    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    monkeypatch.setattr(guardian, "start", lambda: None)  # cleans up after what is begun
    monkeypatch.setattr(subprocess, "Popen", refuse)
    monkeypatch.setattr(multiprocessing.process.BaseProcess, "start", refuse)
    monkeypatch.setattr(os, "mkdir", refuse)
    monkeypatch.setattr(doctor, "machine", lambda **_: ())  # it draws a frame in a process
    monkeypatch.setattr(logging, "basicConfig", lambda **_: None)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    return work


def test_wrong_input_is_one_line_and_begins_nothing(nothing_is_begun, tmp_path, monkeypatch, capsys):
    from accerl_lerobot.cli import verbs
    from accerl_lerobot.run import preflight

    def right(*_: Any, **__: Any) -> None:
        raise StartedWork

    monkeypatch.setattr(preflight, "check_start", right)  # imports LeRobot
    monkeypatch.setattr(verbs, "parse", _stopping(verbs.parse))
    refused = 0
    for number, (verb, arguments, recipe) in enumerate(cases(0, CASES)):
        try:
            code = told(verb, arguments, recipe, tmp_path)
        except StartedWork:
            continue  # the input happened to be right
        out, err = capsys.readouterr()
        line = out.splitlines()[0] if verb == "doctor" else err.rstrip("\n")
        assert code in (1, 2) and "\n" not in line, (number, verb, arguments, err)
        assert "Traceback" not in out + err and "ACCERL_LOG" not in err, (number, verb, arguments, err)
        assert len(line) < 1500
        refused += 1
    assert refused > 0.8 * CASES
    assert not list(nothing_is_begun.iterdir())


def _stopping(parse: Any) -> Any:
    def parsed(*args: Any, **options: Any) -> Any:
        parse(*args, **options)
        raise StartedWork

    return parsed
