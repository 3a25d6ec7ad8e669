# SPDX-License-Identifier: Apache-2.0
"""A run that was stopped, or killed, and gone on with by its command line."""

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import yaml

from accerl_lerobot.algorithms import SelfImitationConfig
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.cli import main
from accerl_lerobot.demos import sft
from accerl_lerobot.demos.record import DemosConfig
from accerl_lerobot.engines.config import LaunchConfig, RunConfig, decode, encode
from accerl_lerobot.engines.local import LocalEngine
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError, check_absent
from accerl_lerobot.evaluation import EvaluationConfig
from accerl_lerobot.policies.config import GaussianSamplerConfig, PolicyConfig
from accerl_lerobot.replay.buffer import ReplayConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.run import preflight, resuming
from accerl_lerobot.run.resuming import resume_command
from accerl_lerobot.run.train import Run
from tests.policies.checkpoints import write_policy
from tests.runs import records as logged
from tests.runs import tiny_run
from tests.tiny_datasets import one_process

UPDATES = 14
TIMES = ("wall_s", "wait_s", "update_s", "publish_s", "rl_s", "warm_start_s")


def recipe(folder: Path, checkpoint: Path, **sections: Any) -> Path:
    defaults: dict[str, Any] = {
        "env": SimulatedConfig(max_steps=12, tolerance=0.4),
        "evaluation": EvaluationConfig(episodes=6, every_updates=4, episodes_during=5, videos=1),
        "trainer": TrainerConfig(
            updates=UPDATES, batch_decisions=16, lr=1e-3, warmup_updates=2, value_warmup_updates=2
        ),
        "launch": LaunchConfig(engine="local"),
        "save_every_updates": 5,
    }
    config = tiny_run(checkpoint, **{**defaults, **sections})
    folder.mkdir(exist_ok=True)
    (folder / "recipe.yaml").write_text(yaml.safe_dump(encode(config)))
    return folder / "recipe.yaml"


def records(run: Path) -> list[dict[str, Any]]:
    """All that was logged, but how long it took."""
    return [{k: v for k, v in record.items() if k not in TIMES} for record in logged(run)]


def summary(run: Path) -> dict[str, Any]:
    found = json.loads((run / "summary.json").read_text())
    return {k: v for k, v in found.items() if k not in TIMES}


def files(run: Path) -> list[bytes]:
    """Weights and journal."""
    last = run / "checkpoints" / "last" / "pretrained_model"
    paths = [last / "model.safetensors", last / "value_head.safetensors", run / "episodes.jsonl"]
    return [path.read_bytes() for path in paths]


@pytest.fixture(scope="module")
def whole(tiny_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was never stopped."""
    folder = tmp_path_factory.mktemp("whole")
    assert main(["train", str(recipe(folder, tiny_checkpoint)), f"--output_dir={folder / 'run'}"]) == 0
    return folder / "run"


def stop_at(monkeypatch: pytest.MonkeyPatch, version: int, number: int = signal.SIGTERM) -> None:
    """This process gets a signal once so many updates have been made."""
    poll = LocalEngine.poll

    def watched(self: LocalEngine) -> Any:
        progress = poll(self)
        if progress.version == version and progress.updates:
            os.kill(os.getpid(), number)
        return progress

    monkeypatch.setattr(LocalEngine, "poll", watched)


def go_on(run: Path, *arguments: str, config: str = "config.yaml") -> int:
    return main(["train", "--resume=true", f"--config_path={run / config}", *arguments])


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGTERM, 143), pytest.param(signal.SIGINT, 130, marks=pytest.mark.slow)]
)
def test_a_run_that_was_asked_to_stop_goes_on_as_if_it_had_not(
    number: int, code: int, whole: Path, tiny_checkpoint: Path, tmp_path: Path, monkeypatch, capsys
):
    run = tmp_path / "run"
    with monkeypatch.context() as context:
        stop_at(context, 7, number)
        assert main(["train", str(recipe(tmp_path, tiny_checkpoint)), f"--output_dir={run}"]) == code
    said = " ".join(capsys.readouterr().err.split())
    assert f"stopped by {signal.Signals(number).name}; to resume: accerl train --resume=true" in said
    assert not (run / "summary.json").exists()
    assert sorted(p.name for p in (run / "checkpoints").iterdir()) == ["000000", "000005", "000007", "last"]
    assert go_on(run, config="checkpoints/last/config.yaml") == 0
    assert records(run) == records(whole)
    assert summary(run) == summary(whole)
    assert files(run) == files(whole)
    assert (run / "before_after.mp4").is_file() and not list(run.glob(".before*"))


def test_a_run_that_another_process_has_resumed_is_left_alone(whole: Path, capsys):
    with resuming.locked(whole):
        assert go_on(whole, "--trainer.updates=99") == 2
    assert "another process resumes it" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_that_fell_over_in_its_sft_keeps_its_demonstrations(tmp_path: Path, monkeypatch, capsys):
    """And they begin the memory of an off-policy algorithm."""
    run = tmp_path / "run"
    small = {"type": "act", "chunk_size": 4, "n_action_steps": 4, "dim_model": 8, "n_heads": 1}
    small |= {"n_encoder_layers": 1, "n_vae_encoder_layers": 1, "dim_feedforward": 8, "latent_dim": 2}
    small |= {"pretrained_backbone_weights": None}
    sections: dict[str, Any] = {
        "env": SimulatedConfig(max_steps=16, tolerance=0.4, environment_state=True),
        "demos": DemosConfig(episodes=3),
        "sft": sft.SFTConfig(steps=2, batch_size=2, policy=small),
        "policy": PolicyConfig(device="cpu", sampler=GaussianSamplerConfig(std=0.3)),
        "algorithm": SelfImitationConfig(),
        "replay": ReplayConfig(
            capacity=64, min_decisions=16, max_unlearned_decisions=32, samples_per_insert=1
        ),
        "rollout": RolloutConfig(environments=4, segment_length=4),
        "trainer": TrainerConfig(updates=3, batch_decisions=16, warmup_updates=0, value_warmup_updates=0),
        "evaluation": EvaluationConfig(episodes=2, videos=0),
    }

    def trained(config: sft.SFTConfig, dataset: Any, output_dir: Path, *rest: Any, **fields: Any) -> Path:
        check_absent(output_dir)
        options = dict(small)
        return write_policy(output_dir / "pretrained_model", options.pop("type"), image=32, **options)

    def falls(*arguments: Any, **fields: Any) -> Path:
        trained(*arguments, **fields)
        raise ArithmeticError("it fell over")

    monkeypatch.setattr(sft, "run_sft", trained)
    with monkeypatch.context() as context, one_process():
        context.setattr(sft, "run_sft", falls)
        assert main(["train", str(recipe(tmp_path, Path("x"), **sections)), f"--output_dir={run}"]) == 1
    assert "to resume: accerl train --resume=true" in " ".join(capsys.readouterr().err.split())
    made = (run / "demos" / "meta" / "info.json").stat().st_mtime_ns
    assert go_on(run) == 0
    assert "there is no checkpoint yet" in capsys.readouterr().err
    assert (run / "demos" / "meta" / "info.json").stat().st_mtime_ns == made, "they were not recorded again"
    begun = run / json.loads((run / "warm_start.json").read_text())["policy"]
    assert (begun / "model.safetensors").is_file()
    first, *_, last = [r for r in records(run) if r["kind"] == "train"]
    assert first["memory_decisions"] >= first["decisions"] + 3 * 4  # each is read from four steps on
    assert last["memory_decisions"] > first["memory_decisions"]
    assert summary(run)["updates"] == 3


def test_a_run_that_fell_over_goes_on_from_its_last_whole_checkpoint(
    whole: Path, tiny_checkpoint: Path, tmp_path: Path, monkeypatch, capsys
):
    run = tmp_path / "run"
    poll = LocalEngine.poll

    def falls(self: LocalEngine) -> Any:
        progress = poll(self)
        if progress.version == 12:
            raise ArithmeticError("it fell over")
        return progress

    with monkeypatch.context() as context:
        context.setattr(LocalEngine, "poll", falls)
        assert main(["train", str(recipe(tmp_path, tiny_checkpoint)), f"--output_dir={run}"]) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "failed; to resume: accerl train --resume=true" in said
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
    assert records(run) == records(whole) and summary(run) == summary(whole) and files(run) == files(whole)


def test_more_updates_may_be_asked_for_and_nothing_else(whole: Path, capsys: pytest.CaptureFixture[str]):
    assert go_on(whole) == 2
    assert "trainer.updates=14: the run" in capsys.readouterr().err
    assert go_on(whole, "--trainer.lr=0.1", "--trainer.updates=20") == 2
    assert "trainer.lr=0.1: the run was begun with 0.001; leave it so" in capsys.readouterr().err
    before = {path: path.read_bytes() for path in whole.rglob("*") if path.is_file()}
    for change in ("--env.type=metaworld", "--launch.engine=ray"):
        assert go_on(whole, change) == 2
    assert "launch.engine='ray': the run was begun with 'local'" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in whole.rglob("*") if path.is_file()} == before


def failing(*_: object) -> None:
    raise InputError("env.type", "simulated", "it is gone")


def test_a_finished_run_goes_back_to_an_earlier_checkpoint(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    run = tmp_path / "run"
    shutil.copytree(whole, run, symlinks=True)
    (run / "wandb").mkdir()
    (run / "wandb" / "debug-core.log").symlink_to(tmp_path / "elsewhere")  # as its client does
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    monkeypatch.setattr(preflight, "check_environment", failing)
    assert go_on(run, config="checkpoints/000010/config.yaml") == 2
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before
    monkeypatch.undo()
    monkeypatch.setattr(Run, "_practise_with_engine", failing)
    assert go_on(run, config="checkpoints/000010/config.yaml") == 2
    assert not (run / "summary.json").exists(), "it tells of the end that was given up"
    monkeypatch.undo()
    assert go_on(run) == 0
    assert records(run) == records(whole) and summary(run) == summary(whole)


def test_what_is_no_run_is_refused(
    tiny_checkpoint: Path, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["train", "--resume=true"]) == 2
    assert "resume=True: add --config_path: name RUN/config.yaml" in capsys.readouterr().err
    path = recipe(tmp_path, tiny_checkpoint)
    assert main(["train", "--resume=true", f"--config_path={path}"]) == 2
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
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, text: str | None, why: str
):
    run, outside = tmp_path / "run", tmp_path / "outside"
    shutil.copytree(whole, run, symlinks=True)
    if text is None:
        shutil.move(run / name, outside)
        (run / name).symlink_to(outside)
    else:
        (run / name).write_text(text)
    before = sorted((path, path.stat().st_mtime_ns) for path in tmp_path.rglob("*"))
    assert go_on(run, "--trainer.updates=20") == 2
    error = capsys.readouterr().err
    assert f"{name}: " in error and why in error and error.count("\n") == 1
    assert sorted((path, path.stat().st_mtime_ns) for path in tmp_path.rglob("*")) == before


@pytest.mark.slow
def test_an_asynchronous_run_that_was_killed_and_stopped_goes_on(tiny_checkpoint: Path, tmp_path: Path):
    """All of it real, in processes of their own, of which the first gets SIGKILL and the second SIGTERM."""
    run = tmp_path / "run"
    path = recipe(
        tmp_path,
        tiny_checkpoint,
        launch=LaunchConfig(stall_s=120),
        env=SimulatedConfig(max_steps=12, tolerance=0.4),
        rollout=RolloutConfig(workers=2, environments=2, segment_length=3),
        trainer=TrainerConfig(updates=120, batch_decisions=16, lr=1e-3),
        save_every_updates=3,
    )
    command = [sys.executable, "-m", "accerl_lerobot.cli", "train"]
    log = tmp_path / "log"
    again = [*command, "--resume=true", f"--config_path={run / 'config.yaml'}"]

    def until(least: int, arguments: list[str], number: int) -> int:
        """Starts it, waits for a checkpoint of so many updates, and sends a signal; its exit code."""
        with log.open("wb") as out:
            process = subprocess.Popen(arguments, stdout=out, stderr=out)
            deadline = time.monotonic() + 240
            while not any(int(p.name) >= least for p in (run / "checkpoints").glob("0*")):
                assert process.poll() is None and time.monotonic() < deadline, log.read_text()
                time.sleep(0.02)
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
    assert max(r["lag_max"] for r in train) == found["lag_max"] < 40
    steps = [r["env_steps"] for r in records(run) if r["kind"] == "rollout"]
    assert steps == sorted(steps)


def test_a_run_says_what_the_command_line_has_to_allow_again(tmp_path: Path):
    config = decode(RunConfig, {"algorithm": {"type": "ppo", "discover_packages_path": "mine.too"}})
    words = shlex.split(resume_command(tmp_path / "a run", config))
    assert words[4:] == ["--algorithm.discover_packages_path=mine.too"]
