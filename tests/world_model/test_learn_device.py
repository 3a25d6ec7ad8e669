# SPDX-License-Identifier: Apache-2.0
"""Which device a world model is to learn and to be tried on. Here there is only the CPU."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from accerl_lerobot import cli
from accerl_lerobot.cli.configs import WorldModelEvalRun, WorldModelRun
from accerl_lerobot.world_model import evaluate, offline


def moved(monkeypatch: pytest.MonkeyPatch) -> tuple[list[str], list[tuple[str, Any]]]:
    """Devices that are asked for, and which networks go where; the CPU stands in for all of them."""
    asked: list[str] = []
    went: list[tuple[str, Any]] = []
    real = torch.nn.Module.to

    def resolve(name: str, field: str) -> torch.device:
        asked.append(name)
        return torch.device("cpu", 0)

    def to(self: torch.nn.Module, *args: Any, **options: Any) -> torch.nn.Module:
        went.append((type(self).__name__, args[0]))
        return real(self, *args, **options)

    for module in (offline, evaluate):
        monkeypatch.setattr(module, "resolve_device", resolve)
    monkeypatch.setattr(torch.nn.Module, "to", to)
    return asked, went


def test_a_device_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert WorldModelRun().device == WorldModelEvalRun(path="x").device == "auto"
    for name, why in (("tpu", "use auto, cpu, cuda"), ("cuda", "no CUDA device here; use cpu or auto")):
        if name == "cuda" and torch.cuda.is_available():
            continue
        # The dataset is not there either, and is not looked for.
        nowhere = ["--dataset.repo_id=a/b", "--dataset.root=nowhere"]
        told = [*nowhere, f"--output_dir={tmp_path / 'out'}", f"--device={name}"]
        assert cli.main(["world-model", "--env.type=simulated", *told]) == 2
        assert f"accerl: device='{name}': {why}" in capsys.readouterr().err
        assert cli.main(["world-model-eval", "--path=nowhere", *told]) == 2
        assert f"accerl: device='{name}': {why}" in capsys.readouterr().err
        assert not (tmp_path / "out").exists()
