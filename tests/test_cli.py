# SPDX-License-Identifier: Apache-2.0
"""The command line as a user meets it: help at once, verbs, exit codes, nothing left behind."""

import json
import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from rich.table import Table

from accerl_lerobot import cli
from accerl_lerobot.cli import verbs
from accerl_lerobot.console import Console
from accerl_lerobot.errors import InputError
from accerl_lerobot.run.train import Run


def test_help_answers_without_torch_or_lerobot() -> None:
    code = (
        "import sys; from accerl_lerobot import cli; assert cli.main(['--help']) == 0\n"
        "assert not {'torch', 'lerobot', 'ray', 'draccus', 'numpy'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert all(f"\n  {verb} " in done.stdout for verb in cli.VERBS)


@pytest.mark.parametrize("verb", list(cli.VERBS))
def test_verb_help_lists_fields_with_their_docstrings(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([verb, "--help"]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"usage: accerl {verb}")
    assert out.count("\n") <= 60 and max(map(len, out.splitlines())) <= 115


def test_help_names_choices_and_recipes_and_of_a_section_all_fields(capsys) -> None:
    assert cli.main(["trian"]) == 2
    assert capsys.readouterr().err.startswith("accerl: VERB='trian': use one of train, demos, ")
    cli.main(["train", "--help"])
    out = capsys.readouterr().out
    assert "--algorithm.type=gipo" in out and "| ppo" in out and "recipes: act_pusht, deploy" in out
    cli.main(["train", "--help=trainer"])
    out = capsys.readouterr().out
    assert "0 freezes it. A number in [0," in out and "--policy" not in out


class RayTaskError(InputError):
    """As Ray builds them: of the cause's class, with a traceback as text and the cause inside."""

    cause = InputError("policy.path", "here", "give another")

    def __str__(self) -> str:
        return "Traceback\n  File"


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (InputError("a", 1, "use one of:\nb"), 2, "a=1: use one of: b"),
        (RayTaskError("", "", ""), 2, "policy.path='here': give another"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (RuntimeError("a worker\n\n  failed"), 1, "RuntimeError: a worker … failed; ACCERL_LOG=DEBUG shows"),
        (BrokenPipeError(32, "Broken pipe"), 1, "BrokenPipeError: [Errno 32] Broken pipe; ACCERL_LOG"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_every_error_is_one_line(error, code, line, monkeypatch, capsys, caplog):
    monkeypatch.setattr(verbs, "train", Mock(side_effect=error))
    with caplog.at_level("DEBUG", "accerl_lerobot.cli"):
        assert cli.main(["train"]) == code
    out, err = capsys.readouterr()
    assert out == "" and err.startswith(f"accerl: {line}") and err.count("\n") == 1
    assert ("Traceback (most recent" in caplog.text) is (code in (1, 2))


HOSTILE = "\x1b[2J\x9b2J\u202egpj.\u2028x\x07"


def test_control_characters_are_escaped_where_a_message_becomes_a_line(monkeypatch, capsys):
    def broken(arguments: list[str]) -> int:
        logging.getLogger("accerl_lerobot").warning("the file says %s", HOSTILE)
        table = Table(HOSTILE)
        table.add_row(HOSTILE)
        Console().rich.print(table)
        Console().say(HOSTILE)
        raise InputError(f"a{HOSTILE}", 1, HOSTILE)

    monkeypatch.setattr(verbs, "train", broken)
    monkeypatch.setattr(logging.root, "handlers", [])
    cli.main(["train"])
    err = capsys.readouterr().err
    assert all(character.isprintable() or character == "\n" for character in err)
    assert err.count("\\x1b[2J") == 6 and "\\u202e" in err


def test_a_reader_that_has_gone_ends_the_command_quietly() -> None:
    command = f"{sys.executable} -m accerl_lerobot.cli train --help=all | head -1"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("usage: accerl train") and done.stderr == ""


class TestTrain:
    @pytest.fixture
    def arguments(self, tmp_path: Path, tiny_checkpoint: Path) -> list[str]:
        places = [f"--policy.path={tiny_checkpoint}", f"--output_dir={tmp_path / 'run'}"]
        return ["train", "--env.type=simulated", "--launch.engine=local", *places]

    def test_prints_the_summary(self, arguments, tmp_path, capsys, monkeypatch):
        before = {"success_before": 0.25, "ci95_before": [0.2, 0.3], "tasks_before": {"a": 1}}
        after = {"success_after": 0.75, "ci95_after": [0.7, 0.8], "n_after": 100, "seeds": [1, 2]}
        counts = {"episodes": 412, "env_steps": 43210, "updates": 9, "wall_s": 279.0}
        monkeypatch.setattr(Run, "execute", lambda run: before | after | counts)
        assert cli.main(arguments) == 0
        out, err = capsys.readouterr()
        policy = tmp_path / "run/checkpoints/last/pretrained_model"
        told = json.loads(out)
        assert (told["success_after"], told["ci95_after"], told["env_steps"]) == (0.75, [0.7, 0.8], 43210)
        assert told["policy"] == str(policy) and told["summary"] == str(tmp_path / "run/summary.json")
        assert "seeds" not in told and "tasks_before" not in told
        said = "412 episodes, 43,210 env steps; 4 min 39 s"
        assert f"success 25\xa0% [20, 30] → 75\xa0% [70, 80] of 100; {said}\n" in err
        monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
        arguments[-1] += "2"
        assert cli.main(arguments) == 0
        assert capsys.readouterr().out == "", "on a terminal there is no JSON"

    @pytest.mark.parametrize("work", [False, True])
    def test_a_refused_run_leaves_no_folder_unless_work_was_done(
        self, work, arguments, tmp_path, monkeypatch
    ):
        def execute(run: Run) -> dict[str, Any]:
            (run.directory / ("demos" if work else "config.yaml")).touch()
            raise InputError("MUJOCO_GL", "", "install it")

        monkeypatch.setattr(Run, "execute", execute)
        assert cli.main(arguments) == 2
        assert (tmp_path / "run").exists() is work


def test_eval_in_one_process(tmp_path, tiny_checkpoint, capsys):
    out = tmp_path / "evaluation"
    arguments = ["eval", "--env.type=simulated", "--env.max_steps=8", f"--policy.path={tiny_checkpoint}"]
    arguments += ["--evaluation.episodes=4", "--launch.engine=local", f"--output_dir={out}"]
    assert cli.main(arguments) == 0
    summary = json.loads(capsys.readouterr().out)
    kept = json.loads((out / "evaluation.json").read_text())
    assert summary == kept and kept["tasks"]["match"]["n"] == 4
    assert summary["n"] == 4 and 0 <= summary["ci95"][0] <= summary["success"] <= summary["ci95"][1] <= 1
    assert len(list(out.glob("match_*.mp4"))) == 4
    assert cli.main(arguments) == 2
    assert "the folder exists" in capsys.readouterr().err


def test_a_verb_that_is_asked_to_stop_ends_what_it_has_started(monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[bool] = []

    def asked(arguments: list[str]) -> None:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(60)
        finally:
            ended.append(True)

    monkeypatch.setattr(verbs, "demos", asked)
    before = signal.getsignal(signal.SIGTERM)
    assert cli.main(["demos"]) == 128 + signal.SIGTERM and ended
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize(
    "arguments",
    [
        ["eval", "--env.type=simulated", "--policy.path=a/b", "--output_dir="],
        ["demos", "--root="],
        ["pull", "--repo_id=a/b", "--output_dir="],
        ["report", "@run", "--output="],
        ["timeline", "@run", "--output="],
    ],
    ids=lambda arguments: " ".join(arguments[:2]),
)
def test_a_place_that_cannot_be_is_refused_before_any_work(arguments, tmp_path, capsys):
    (tmp_path / "file").touch()
    flag = arguments[-1].strip("-=")
    for name in ("file/below", "x" * 300):
        place = str(tmp_path / name)
        given = [argument.replace("@run", str(tmp_path)) for argument in arguments]
        assert cli.main([*given[:-1], f"{given[-1]}{place}"]) == 2
        err = capsys.readouterr().err
        assert err.startswith(f"accerl: {flag}={place!r}"[:150]) and err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
