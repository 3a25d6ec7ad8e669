# SPDX-License-Identifier: Apache-2.0
"""The doctor: right about this machine, and right about machines that lack something."""

import os
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from accerl_lerobot import cli
from accerl_lerobot.cli import doctor
from accerl_lerobot.cli.doctor import FAIL, OK, WARN, Check
from accerl_lerobot.engines.config import RunConfig, decode


def test_this_machine(capsys: pytest.CaptureFixture[str]) -> None:
    """The tests need a machine on which everything works, so the doctor must find none of it missing."""
    assert cli.main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert "FAIL" not in out and "MuJoCo draws 64 × 64 pixels" in out
    names = ("python", "lerobot", "ray", "torch", "rendering", "cpu", "memory", "disk")
    assert all(f" {name} " in out for name in names)
    assert "recipe" not in out and out.endswith("all good\n")


@pytest.mark.parametrize(
    ("arguments", "lines"),
    [
        (["quickstart", "--trainer.lr=1e-5"], ["ok    recipe     resolves", "lag        at most", "work "]),
        (["quickstart", "--env.type=x"], ["FAIL  recipe ", "env.type='x': use one of gym, lerobot, libero"]),
        (["quickstart", "--output_dir=/"], ["FAIL  recipe ", "the folder exists"]),
        (["imagination", "--imagination.path=nowhere"], ["imagination.path='nowhere': config.json: is"]),
    ],
)
def test_what_a_run_would_do(arguments: list[str], lines: list[str], monkeypatch, capsys) -> None:
    monkeypatch.setattr(doctor, "machine", lambda joins: [Check("python", OK, "3.12")])
    monkeypatch.setattr(doctor, "rendering", lambda needed: Check("rendering", OK, "drawn"))
    fails = "lr" not in arguments[1]
    assert cli.main(["doctor", f"--config_path={arguments[0]}", arguments[1]]) == fails
    out = capsys.readouterr().out
    assert all(line in out for line in ["ok    python", *lines]) and ("FAIL" in out) is fails
    assert out.count("\n") <= 60 and "warn" not in out


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
    @pytest.mark.parametrize(
        ("sections", "words"),
        [
            ({"rollout": {"workers": 4}}, ""),
            ({"rollout": {"workers": 5}}, "lower rollout.workers"),
            ({"trainer": {"num_threads": 8}}, "trainer.num_threads"),
        ],
    )
    def test_against_four_cores(self, sections, words, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(4)), raising=False)
        check = doctor.resources(decode(RunConfig, sections))
        assert check.status == (WARN if words else OK) and words in check.text

    def test_a_policy_is_compared_with_its_gpu(self, monkeypatch: pytest.MonkeyPatch, tiny_checkpoint: Path):
        properties = SimpleNamespace(total_memory=2**20)
        monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
        monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
        monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: properties)
        config = decode(RunConfig, {"policy": {"path": str(tiny_checkpoint), "device": "cuda"}})
        (check,) = doctor.gpu_memory(config)
        assert check.status == WARN and "policy.tuning.mode=lora" in check.text

    def test_a_pace_that_would_waste_is_warned_about(self) -> None:
        (lag,) = (
            check
            for check in doctor.pace(decode(RunConfig, {"replay": {"max_lag": 3}}))
            if check.name == "lag"
        )
        assert lag.status == WARN and lag.text.startswith("at most 3 updates") and "thrown away" in lag.text
