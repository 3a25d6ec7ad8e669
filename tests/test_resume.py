# SPDX-License-Identifier: Apache-2.0
"""A run that was stopped, or killed, and gone on with by its command line."""

import contextlib
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock, patch

import psutil
import pytest
import yaml

from accerl_lerobot.algorithms import SelfImitationConfig
from accerl_lerobot.cli import main
from accerl_lerobot.demos import sft
from accerl_lerobot.engines.config import RunConfig, decode, encode
from accerl_lerobot.engines.local import LocalEngine
from accerl_lerobot.errors import InputError, check_absent
from accerl_lerobot.run import preflight, resuming
from accerl_lerobot.run.resuming import resume_command
from accerl_lerobot.run.train import Run
from tests.policies.checkpoints import write_smolvla
from tests.runs import changed, eventually, tiny_run
from tests.runs import records as logged
from tests.test_run import local_run
from tests.tiny_datasets import one_process

TIMES = ("wall_s", "wait_s", "update_s", "publish_s", "rl_s", "warm_start_s")


def train(folder: Path, checkpoint: Path, **sections: Any) -> int:
    """Begins a run in `folder`, from a recipe; the exit code."""
    evaluation = {"episodes": 6, "episodes_during": 5}
    config = local_run(checkpoint, folder, evaluation=evaluation, trainer={"updates": 14, "lr": 1e-3})
    recipe = folder.with_suffix(".yaml")
    recipe.write_text(yaml.safe_dump(encode(changed(config, **sections))))
    return main(["train", str(recipe)])


def records(run: Path) -> list[dict[str, Any]]:
    """All that was logged, but how long it took."""
    return [{k: v for k, v in record.items() if k not in TIMES} for record in logged(run)]


def summary(run: Path) -> dict[str, Any]:
    found = json.loads((run / "summary.json").read_text())
    return {k: v for k, v in found.items() if k not in TIMES}


def files(run: Path) -> list[bytes]:
    last = run / "checkpoints" / "last" / "pretrained_model"
    paths = [last / "model.safetensors", last / "value_head.safetensors", run / "episodes.jsonl"]
    return [path.read_bytes() for path in paths]


@pytest.fixture(scope="module")
def whole(tiny_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    assert train(folder / "run", tiny_checkpoint) == 0
    return folder / "run"


def at(version: int, happens: Callable[[], Any]) -> Any:
    """Something happens once so many updates have been made."""
    poll = LocalEngine.poll

    def watched(self: LocalEngine) -> Any:
        progress = poll(self)
        if progress.version == version and progress.updates:
            happens()
        return progress

    return patch.object(LocalEngine, "poll", watched)


def go_on(run: Path, *arguments: str, config: str = "config.yaml") -> int:
    return main(["train", "--resume=true", f"--config_path={run / config}", *arguments])


def equal(run: Path, other: Path) -> bool:
    return all(of(run) == of(other) for of in (records, summary, files))


def tree(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_run_that_was_asked_to_stop_goes_on_as_if_it_had_not(whole, tiny_checkpoint, tmp_path, capsys):
    run = tmp_path / "run"
    with at(7, lambda: os.kill(os.getpid(), signal.SIGTERM)):
        assert train(run, tiny_checkpoint) == 143
    said = " ".join(capsys.readouterr().err.split())
    assert "stopped by SIGTERM; to resume: accerl train --resume=true" in said
    assert not (run / "summary.json").exists()
    assert sorted(p.name for p in (run / "checkpoints").iterdir()) == ["000005", "000007", "last"]
    assert go_on(run, config="checkpoints/last/config.yaml") == 0
    assert equal(run, whole)
    assert (run / "before_after.mp4").is_file() and not list(run.glob(".before*"))


def test_a_run_that_another_process_has_resumed_is_left_alone(whole: Path, capsys):
    with resuming.locked(whole):
        assert go_on(whole, "--trainer.updates=99") == 2
    assert "another process resumes it" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_that_fell_over_in_its_sft_keeps_its_demonstrations(tmp_path: Path, monkeypatch, capsys):
    run = tmp_path / "run"
    sections: dict[str, Any] = {
        "demos": {"episodes": 3},
        "sft": {"steps": 2, "policy": {"type": "smolvla", "chunk_size": 4, "n_action_steps": 4}},
        "policy": {"path": None},
        "algorithm": SelfImitationConfig(),
        "replay": {"samples_per_insert": 1},
        "rollout": {"segment_length": 4},
        "trainer": {"updates": 3},
        "evaluation": {"episodes": 2, "every_updates": 0, "videos": 0},
    }

    def trained(config: sft.SFTConfig, dataset: Any, output_dir: Path, *rest: Any, **fields: Any) -> Path:
        check_absent(output_dir)
        return write_smolvla(output_dir / "pretrained_model")

    def falls(*arguments: Any, **fields: Any) -> Path:
        trained(*arguments, **fields)
        raise ArithmeticError("it fell over")

    monkeypatch.setattr(sft, "run_sft", trained)
    with patch.object(sft, "run_sft", falls), one_process():
        assert train(run, Path("x"), **sections) == 1
    assert "to resume: accerl train --resume=true" in " ".join(capsys.readouterr().err.split())
    made = tree(run / "demos")
    assert go_on(run) == 0
    assert "there is no checkpoint yet" in capsys.readouterr().err
    assert tree(run / "demos") == made, "they were not recorded again"
    first, *_, last = [r for r in records(run) if r["kind"] == "train"]
    assert first["memory_decisions"] >= first["decisions"] + 3 * 4  # each is read from four steps on
    assert last["memory_decisions"] > first["memory_decisions"]
    assert summary(run)["updates"] == 3


def test_a_run_that_fell_over_goes_on_from_its_last_whole_one(whole, tiny_checkpoint, tmp_path, capsys):
    run = tmp_path / "run"
    with at(12, Mock(side_effect=ArithmeticError("it fell over"))):
        assert train(run, tiny_checkpoint) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert f"failed; to resume: accerl train --resume=true --config_path={run}/config.yaml" in said
    assert f"accerl: ArithmeticError: it fell over; the traceback is in {run / 'error.log'}" in said
    assert "ArithmeticError: it fell over" in (run / "error.log").read_text()
    newest = run / "checkpoints" / "000010" / "training_state" / "replay.safetensors"
    newest.write_bytes(newest.read_bytes()[:-10])  # torn, as by a full disk
    with (run / "metrics.jsonl").open("a") as file:
        file.write('{"kind": "train", "upd')  # the last line, too
    assert go_on(run) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "passed over checkpoint 000010: training_state/replay.safetensors is not what was written" in said
    assert "going on from" in said and "000005" in said
    assert equal(run, whole)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ([], "trainer.updates=14: the run"),
        (["--trainer.lr=0.1", "--trainer.updates=20"], "trainer.lr=0.1: the run was begun with 0.001; leave"),
        (["--env.max_steps=9"], "env.max_steps=9: the run was begun with 12"),
        (["--launch.engine=ray"], "launch.engine='ray': the run was begun with 'local'"),
    ],
)
def test_more_updates_may_be_asked_for_and_nothing_else(changes, message, whole: Path, capsys):
    before = tree(whole)
    assert go_on(whole, *changes) == 2
    assert message in capsys.readouterr().err and tree(whole) == before


def test_a_finished_run_goes_back_to_an_earlier_checkpoint(whole: Path, tmp_path: Path):
    run = tmp_path / "run"
    shutil.copytree(whole, run, symlinks=True)
    (run / "wandb").mkdir()
    (run / "wandb" / "debug-core.log").symlink_to(tmp_path / "elsewhere")  # as its client does
    before = tree(run)
    gone = Mock(side_effect=InputError("env.type", "simulated", "it is gone"))
    with patch.object(preflight, "check_environment", gone):
        assert go_on(run, config="checkpoints/000010/config.yaml") == 2
    assert tree(run) == before
    with patch.object(Run, "_practise_with_engine", gone):
        assert go_on(run, config="checkpoints/000010/config.yaml") == 2
    assert not (run / "summary.json").exists(), "it tells of the end that was given up"
    assert go_on(run) == 0
    assert records(run) == records(whole) and summary(run) == summary(whole)


def test_what_is_no_run_is_refused(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["train", "--resume=true"]) == 2
    assert "resume=True: add --config_path: name RUN/config.yaml" in capsys.readouterr().err
    shutil.copy(whole / "config.yaml", tmp_path)
    assert go_on(tmp_path) == 2
    assert "no run has been begun there" in capsys.readouterr().err
    assert go_on(whole, config="checkpoints/000003/config.yaml") == 2
    assert "no such file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("summary.json", '{"updates": ', "not good JSON"),
        ("timeline", None, "a link that leads out of the folder"),
    ],
)
def test_a_damaged_or_hostile_run_is_refused_before_anything_is_written(
    name: str, text: str | None, why: str, whole: Path, tmp_path: Path, capsys
):
    run, outside = tmp_path / "run", tmp_path / "outside"
    shutil.copytree(whole, run, symlinks=True)
    if text is None:
        shutil.move(run / name, outside)
        (run / name).symlink_to(outside)
    else:
        (run / name).write_text(text)
    before = tree(tmp_path)
    assert go_on(run, "--trainer.updates=20") == 2
    error = capsys.readouterr().err
    assert f"{name}: " in error and why in error and error.count("\n") == 1
    assert tree(tmp_path) == before


@pytest.mark.slow
def test_an_asynchronous_run_that_was_killed_and_stopped_goes_on(tiny_checkpoint: Path, tmp_path: Path):
    run, path, log = tmp_path / "run", tmp_path / "recipe.yaml", tmp_path / "log"
    config = tiny_run(
        tiny_checkpoint,
        env={"max_steps": 12, "tolerance": 0.4},
        rollout={"workers": 2, "environments": 2},
        trainer={"updates": 120, "lr": 1e-3},
        save_every_updates=3,
    )
    path.write_text(yaml.safe_dump(encode(config)))
    command = [sys.executable, "-m", "accerl_lerobot.cli", "train"]
    again = [*command, "--resume=true", f"--config_path={run / 'config.yaml'}"]

    def until(least: int, arguments: list[str], number: int) -> int:
        """Starts it, waits for a checkpoint of so many updates, and sends a signal; its exit code."""
        with log.open("wb") as out:
            process = subprocess.Popen(arguments, stdout=out, stderr=out)
            saved = (run / "checkpoints").glob
            assert eventually(lambda: any(int(p.name) >= least for p in saved("0*")), 240), log.read_text()
            if number == signal.SIGTERM:  # as schedulers do, to all processes of the job
                for member in psutil.Process(process.pid).children(recursive=True):
                    with contextlib.suppress(psutil.NoSuchProcess):
                        member.send_signal(number)
                time.sleep(3)
            process.send_signal(number)
            return process.wait(60)

    assert until(6, [*command, str(path), f"--output_dir={run}"], signal.SIGKILL) == -signal.SIGKILL
    newest = max(int(p.name) for p in (run / "checkpoints").glob("0*"))
    assert until(newest + 5, again, signal.SIGTERM) == 143, log.read_text()
    assert "stopped by SIGTERM; to resume: accerl train --resume=true" in log.read_text()
    assert not (run / "summary.json").exists()
    ended = subprocess.run(again, capture_output=True, text=True, timeout=300)
    assert ended.returncode == 0, ended.stderr
    train = [r for r in records(run) if r["kind"] == "train"]
    assert [r["update"] for r in train] == list(range(1, 121)), "none lost, none twice"
    found = summary(run)
    assert found["updates"] == 120 and found["n_before"] == found["n_after"] == 6
    evaluations = [r["group"] for r in records(run) if r["kind"] == "evaluation"]
    assert len(set(evaluations)) == len(evaluations) and {"before", "after"} <= set(evaluations)
    assert found["lag_max"] < 40


def test_a_run_says_what_the_command_line_has_to_allow_again(tmp_path: Path):
    config = decode(RunConfig, {"algorithm": {"type": "ppo", "discover_packages_path": "mine.too"}})
    words = shlex.split(resume_command(tmp_path / "a run", config))
    assert words[4:] == ["--algorithm.discover_packages_path=mine.too"]
