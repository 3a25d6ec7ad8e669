# SPDX-License-Identifier: Apache-2.0
"""The doctor: right about this machine, and right about machines that lack something."""

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from accerl_lerobot import cli
from accerl_lerobot.cli import doctor
from accerl_lerobot.cli.doctor import FAIL, OK, WARN, Check
from accerl_lerobot.engines.config import RunConfig, decode

QUICKSTART = Path(__file__).parents[1] / "recipes" / "quickstart.yaml"


@pytest.fixture
def healthy(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine on which all is well, whatever this one is like."""
    fine = [Check("python", OK, "3.12")]
    monkeypatch.setattr(doctor, "machine", lambda joins: fine)
    monkeypatch.setattr(doctor, "rendering", lambda needed: Check("rendering", OK, "drawn"))


def checks(config: RunConfig) -> dict[str, Check]:
    return {c.name: c for c in (doctor.resources(config), *doctor.pace(config))}


def test_this_machine(capsys: pytest.CaptureFixture[str]) -> None:
    """The tests need a machine on which everything works, so the doctor must find none of it missing."""
    assert cli.main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert "FAIL" not in out and "MuJoCo draws 64 × 64 pixels" in out
    for name in ("python", "lerobot", "ray", "torch", "rendering", "cpu", "memory", "disk"):
        assert f" {name} " in out
    assert "recipe" not in out and out.endswith("all good\n")


@pytest.mark.usefixtures("healthy")
class TestRecipe:
    """`accerl doctor recipe.yaml`."""

    def test_says_what_a_run_would_do(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert cli.main(["doctor", str(QUICKSTART), "--trainer.lr=1e-5"]) == 0
        found = capsys.readouterr().out
        assert found.count("\n") <= 60 and "warn" not in found
        assert "ok    recipe     resolves" in found
        assert "lag        at most" in found and "work " in found and "decisions" in found

    @pytest.mark.parametrize(
        ("arguments", "line"),
        [
            (["quickstart", "--env.type=x"], "env.type='x': use one of gym, lerobot, libero, metaworld"),
            (["quickstart", "--output_dir=/"], "the folder exists"),
            (["imagination", "--imagination.path=nowhere"], "imagination.path='nowhere': config.json: is"),
        ],
    )
    def test_a_mistake_fails_with_its_line(self, arguments: list[str], line: str, capsys) -> None:
        assert cli.main(["doctor", f"--config_path={arguments[0]}", arguments[1]]) == 1
        out = capsys.readouterr().out
        assert "FAIL  recipe " in out and line in out and "ok    python" in out


@pytest.mark.parametrize(
    ("script", "text"),
    [
        ("import os; os.abort()", "ended with code -6"),
        ("from accerl_lerobot.errors import *; raise InputError('GL', '', 'x')", "GL='': x"),
        ("raise SystemExit('MuJoCo draws an empty picture')", "empty picture"),
    ],
)
def test_every_way_of_not_drawing_is_an_answer(script: str, text: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(doctor, "DRAW", script)
    check = doctor.rendering(needed=True)
    assert check.status == FAIL and text in check.text
    assert doctor.rendering(needed=False).status == WARN


class TestResources:
    """Cores, GPU memory and pace against a recipe."""

    def recipe(self, **sections: dict[str, Any]) -> RunConfig:
        config: RunConfig = decode(RunConfig, sections)
        return config

    @pytest.fixture(autouse=True)
    def four_cores(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(4)), raising=False)

    @pytest.mark.parametrize(
        ("sections", "name", "words"),
        [
            ({"rollout": {"workers": 4}}, "cores", ""),
            ({"rollout": {"workers": 5}}, "cores", "lower rollout.workers"),
            ({"trainer": {"num_threads": 8}}, "cores", "trainer.num_threads"),
        ],
    )
    def test_against_four_cores(self, sections, name, words):
        check = checks(self.recipe(**sections))[name]
        assert check.status == (WARN if words else OK) and words in check.text

    def test_a_policy_is_compared_with_its_gpu(self, monkeypatch: pytest.MonkeyPatch, tiny_checkpoint: Path):
        properties = SimpleNamespace(total_memory=2**20)
        monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
        monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
        monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: properties)
        config = self.recipe(policy={"path": str(tiny_checkpoint), "device": "cuda"})
        (check,) = doctor.gpu_memory(config)
        assert check.status == WARN and "policy.tuning.mode=lora" in check.text

    def test_a_pace_that_would_waste_is_warned_about(self) -> None:
        lag = checks(self.recipe(replay={"max_lag": 3}))["lag"]
        assert lag.status == WARN and lag.text.startswith("at most 3 updates") and "thrown away" in lag.text
