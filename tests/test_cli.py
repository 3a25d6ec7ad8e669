# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""The command line as a user meets it: help at once, verbs, exit codes, nothing left behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from accerl_lerobot import cli, verbs
from accerl_lerobot.config import RunConfig
from accerl_lerobot.errors import InputError

ROOT = Path(__file__).parents[1]
QUICKSTART = ROOT / "recipes" / "quickstart.yaml"


def test_help_answers_without_torch_or_lerobot() -> None:
    code = (
        "import sys, time; started = time.perf_counter(); from accerl_lerobot import cli\n"
        "assert cli.main(['--help']) == 0; spent = time.perf_counter() - started\n"
        "heavy = {'torch', 'lerobot', 'ray', 'draccus', 'numpy'} & set(sys.modules)\n"
        "sys.stderr.write(f'{heavy or None} {spent}')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    heavy, spent = done.stderr.split()
    assert heavy == "None"
    assert float(spent) < 0.3
    for verb in cli.VERBS:
        assert f"\n  {verb} " in done.stdout


@pytest.mark.parametrize("arguments", [[], ["-h"], ["help"]])
def test_usage(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(arguments) == 0
    assert capsys.readouterr().out == cli.usage() + "\n"


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.count(".") == 2


def test_every_verb_has_a_function_and_a_config() -> None:
    assert {name.split()[0] for name in verbs.CONFIGS} == cli.VERBS.keys()


@pytest.mark.parametrize("verb", list(cli.VERBS))
def test_verb_help_lists_fields_with_their_docstrings(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([verb, "--help"]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"usage: accerl {verb}")
    assert max(map(len, out.splitlines())) <= 140
    if verb in ("train", "doctor"):
        assert "  --trainer.lr=0.0001" in out and "Peak learning rate of the policy" in out
        assert "algorithm.type=gipo (default)" in out and "--algorithm.clip_low" in out
        assert "env.type=metaworld (default)" in out and "--env.step_ms" in out
        assert "--algorithm.gamma=0.99                    Discount per decision" in out  # of the base class
    if verb == "bench":
        assert "--chunk=10" in out and "--precision=fp32" in out


def test_help_of_one_measurement(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "policy", "--help"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("usage: accerl bench policy") and "--precision=fp32" in out and "--chunk" not in out


def test_unknown_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["trian"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("accerl: no verb 'trian'; did you mean train? Otherwise use one of train, demos, ")


def test_errors_are_one_line_on_stderr(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(arguments: list[str]) -> int:
        raise InputError("env.task", "push-v2", "use one of:\npush-v3")

    monkeypatch.setattr(verbs, "train", refuse)
    assert cli.main(["train"]) == 2
    out, err = capsys.readouterr()
    assert (out, err) == ("", "accerl: env.task='push-v2': use one of: push-v3\n")


def test_an_error_inside_ray_is_one_line_too(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class RayTaskError(InputError):
        """As Ray builds them: of the cause's class, with a traceback as text and the cause inside."""

        cause = InputError("policy.path", "here", "give another")

        def __str__(self) -> str:
            return "Traceback\n  File"

    def refuse(arguments: list[str]) -> int:
        raise RayTaskError("", "", "")

    monkeypatch.setattr(verbs, "evaluate", refuse)
    assert cli.main(["eval"]) == 2
    assert capsys.readouterr().err == "accerl: policy.path='here': give another\n"


def test_interrupt(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(arguments: list[str]) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(verbs, "train", interrupted)
    assert cli.main(["train"]) == 130
    assert capsys.readouterr().err == "accerl: interrupted\n"


def test_other_errors_keep_their_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(arguments: list[str]) -> int:
        raise RuntimeError("rollout worker 0 failed for good")

    monkeypatch.setattr(verbs, "train", broken)
    with pytest.raises(RuntimeError, match="failed for good"):
        cli.main(["train"])


class TestTrain:
    """What `accerl train` does around `run.train`."""

    @pytest.fixture
    def arguments(self, tmp_path: Path, tiny_checkpoint: Path) -> list[str]:
        return [
            "train",
            "--env.type=simulated",
            f"--policy.path={tiny_checkpoint}",
            f"--output_dir={tmp_path / 'run'}",
        ]

    def test_prints_the_summary(
        self,
        arguments: list[str],
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        seen: dict[str, Any] = {}

        def train(config: RunConfig, directory: Path, console: Any, *_: Any) -> dict[str, Any]:
            seen.update(config=config, directory=directory)
            return {"success_before": 0.25, "success_after": 0.75, "wall_s": 3.0}

        monkeypatch.setattr("accerl_lerobot.run.train", train)
        assert cli.main([*arguments, "--trainer.lr=1e-5"]) == 0
        out, err = capsys.readouterr()
        assert json.loads(out)["success_after"] == 0.75
        assert "success 25.0% → 75.0% in 3 s" in err
        assert seen["directory"] == tmp_path / "run" and seen["directory"].is_dir()
        assert seen["config"].trainer.lr == 1e-5

    def test_a_refused_run_leaves_no_folder(
        self, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def train(config: RunConfig, directory: Path, console: Any, *_: Any) -> dict[str, Any]:
            (directory / "config.yaml").write_text("seed: 0\n")
            raise InputError("MUJOCO_GL", "", "install it")

        monkeypatch.setattr("accerl_lerobot.run.train", train)
        assert cli.main(arguments) == 2
        assert not (tmp_path / "run").exists()

    def test_but_work_that_was_done_is_kept(
        self, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def train(config: RunConfig, directory: Path, console: Any, *_: Any) -> dict[str, Any]:
            (directory / "demos").mkdir()
            raise InputError("sft.lr", 1.0, "lower it")

        monkeypatch.setattr("accerl_lerobot.run.train", train)
        assert cli.main(arguments) == 2
        assert (tmp_path / "run" / "demos").is_dir()

    def test_refuses_an_existing_folder(
        self, arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (tmp_path / "run").mkdir()
        assert cli.main(arguments) == 2
        assert "the folder exists; choose another or remove it" in capsys.readouterr().err

    def test_refuses_to_start_from_nothing(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert cli.main(["train"]) == 2
        assert capsys.readouterr().err.startswith("accerl: policy.path=None: give a LeRobot checkpoint")

    def test_refuses_a_checkpoint_that_is_none(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (tmp_path / "run").mkdir()
        assert cli.main(["train", f"--policy.path={tmp_path / 'run'}"]) == 2
        assert "no config.json there" in capsys.readouterr().err

    def test_refuses_a_dataset_that_is_none(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        where = ["--dataset.repo_id=a/b", f"--dataset.root={tmp_path}"]
        assert cli.main(["train", str(QUICKSTART), *where]) == 2
        assert "no meta/info.json there" in capsys.readouterr().err


class TestSFT:
    """`accerl sft` refuses before it imports a trainer."""

    def test_needs_a_dataset(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert cli.main(["sft", "--sft.steps=5"]) == 2
        assert capsys.readouterr().err.startswith("accerl: dataset.repo_id=None: name a LeRobotDataset")

    def test_needs_steps(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert cli.main(["sft", "--dataset.repo_id=a/b"]) == 2
        assert capsys.readouterr().err == "accerl: sft.steps=0: use at least 1\n"

    def test_checks_the_dataset_against_the_world(self, capsys: pytest.CaptureFixture[str]) -> None:
        arguments = [
            "sft",
            str(QUICKSTART),  # camera corner2, as the dataset
            "--env.camera=topview",
            "--dataset.repo_id=accerl/metaworld_tiny",
            f"--dataset.root={ROOT / 'datasets' / 'metaworld_tiny'}",
        ]
        assert cli.main(arguments) == 2
        assert "no observation.images.topview" in capsys.readouterr().err

    def test_takes_its_rooms_from_a_recipe(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def run_sft(config: Any, *rest: Any, **more: Any) -> Path:
            assert config.steps == 7 and config.policy["chunk_size"] == 10
            return tmp_path / "pretrained_model"

        monkeypatch.setattr("accerl_lerobot.demos.sft.run_sft", run_sft)
        arguments = [
            "sft",
            str(QUICKSTART),
            "--dataset.repo_id=accerl/metaworld_tiny",
            f"--dataset.root={ROOT / 'datasets' / 'metaworld_tiny'}",
            "--sft.steps=7",
            f"--output_dir={tmp_path / 'sft'}",
        ]
        assert cli.main(arguments) == 0
        assert capsys.readouterr().out == f"{tmp_path / 'pretrained_model'}\n"


def test_eval_in_one_process(
    tmp_path: Path, tiny_checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "evaluation"
    arguments = [
        "eval",
        "--env.type=simulated",
        "--env.max_steps=8",
        f"--policy.path={tiny_checkpoint}",
        "--evaluation.episodes=4",
        "--launch.engine=local",
        f"--output_dir={out}",
    ]
    assert cli.main(arguments) == 0
    stdout, stderr = capsys.readouterr()
    summary = json.loads(stdout)
    assert summary == json.loads((out / "evaluation.json").read_text())
    assert summary["n"] == 4 and 0 <= summary["ci95"][0] <= summary["success"] <= summary["ci95"][1] <= 1
    assert len(list(out.glob("match_*.mp4"))) == 4
    assert "n=4" in stderr
    assert cli.main(arguments) == 2
    assert "the folder exists" in capsys.readouterr().err


def test_demos_refuses_an_existing_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demos", str(QUICKSTART), f"--demos.root={tmp_path}"]) == 2
    assert "exists already: remove it or name another folder" in capsys.readouterr().err


def test_bench_without_a_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench"]) == 2
    assert (
        capsys.readouterr().err
        == "accerl: bench='': name what is measured: world, policy, throughput, scaling, async-vs-sync, "
        "transport, weights, batching, replay, timeline, latency, lag, dream, efficiency, faults, soak, "
        "ranking\n"
    )


def test_a_bench_that_is_asked_to_stop_ends_what_it_has_started(monkeypatch: pytest.MonkeyPatch) -> None:
    from accerl_lerobot.bench import world

    ended: list[bool] = []

    def asked(config: object) -> None:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(60)
        finally:
            ended.append(True)

    monkeypatch.setattr(world, "bench_world", asked)
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as raised:
        cli.main(["bench", "world"])
    assert raised.value.code == 128 + signal.SIGTERM and ended
    assert signal.getsignal(signal.SIGTERM) is before
