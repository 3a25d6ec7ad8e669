# SPDX-License-Identifier: Apache-2.0
"""accerl world-model-eval on several datasets: thresholds and checks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from accerl_lerobot import cli
from accerl_lerobot.engine.config import DatasetConfig
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.world_model import validation
from accerl_lerobot.world_model.config import PixelModelConfig, ValidationConfig, WorldModelConfig
from accerl_lerobot.world_model.contract import new_model
from accerl_lerobot.world_model.data import DATASET, ONLINE, load_datasets
from accerl_lerobot.world_model.learners import new_success_model
from accerl_lerobot.world_model.pretrain import world_spec
from accerl_lerobot.world_model.store import LEARNT, THRESHOLD, save_world_model
from accerl_lerobot.world_model.validation import validate_datasets
from tests.world_model.test_pretrain import recorded

ENV = SimulatedConfig(max_steps=60, hold=25, image_size=16)
CONFIG = WorldModelConfig(image_size=16, chunk=5, model=PixelModelConfig(channels=(8, 8)))


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Demonstrations, a world model that has learnt from some of them (nothing yet), and other episodes."""
    root = tmp_path_factory.mktemp("evaluated")
    demos, others = recorded(root / "demos", 8, 0), recorded(root / "others", 8, 1)
    torch.manual_seed(0)
    spec = world_spec(CONFIG, ENV)
    episodes = load_datasets({DATASET: DatasetConfig(repo_id="a/b", root=str(demos))}, spec)[DATASET]
    roles = {episode.key: LEARNT if i < 4 else THRESHOLD for i, episode in enumerate(episodes)}
    save_world_model(root / "model", new_model(spec, CONFIG.model), new_success_model(5), roles)
    return demos, root / "model", others


def told(folders: tuple[Path, Path, Path], out: Path, *more: str) -> list[str]:
    demos, model, _ = folders
    return [
        "world-model-eval", f"--path={model}", "--dataset.repo_id=a/b", f"--dataset.root={demos}",
        f"--output_dir={out}", "--validation.depth=2", *more,
    ]  # fmt: skip


def test_the_same_measures_on_every_dataset(
    folders: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    more = ["--online.repo_id=a/c", f"--online.root={folders[2]}"]
    code = cli.main(told(folders, out, *more))
    stdout, stderr = capsys.readouterr()
    found = json.loads(stdout)
    assert code == 1 and found == json.loads((out / "validation.json").read_text())
    assert {name: one["episodes"] for name, one in found["datasets"].items()} == {DATASET: 4, ONLINE: 8}
    own, other = (one["checks"] for one in found["datasets"].values())
    assert set(own) == set(other) and found["checks"] == own | {f"online.{k}": v for k, v in other.items()}
    assert {p.name for p in out.iterdir()} == {
        "config.yaml", "validation.json", "preview.mp4", "preview_online.mp4",
    }  # fmt: skip
    assert "sensitivity_low" in stderr and "FAILS" in stderr
    assert "dataset: trained on 4 episodes of it, evaluated on the other 4" in stderr


def test_one_that_does_not_know_the_dataset_is_tried_on_all_of_it(
    folders: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    arguments = [a.replace(str(folders[0]), str(folders[2])) for a in told(folders, tmp_path / "out")]
    cli.main(arguments)
    found = json.loads(capsys.readouterr().out)
    assert {name: one["episodes"] for name, one in found["datasets"].items()} == {DATASET: 8}


def test_a_threshold_is_chosen_anew_only_where_it_comes_from(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    calls: list[tuple[str, float | None]] = []

    def validate(model: Any, episodes: Any, config: Any, success: Any, seed: int, threshold: Any) -> Any:
        calls.append((episodes, threshold))
        check = {"value": 1.0, "wanted": "above 0", "holds": episodes == "demos"}
        return {"checks": {"skill": check}, "threshold": 0.6 if threshold is None else threshold}

    monkeypatch.setattr(validation, "validate", validate)
    monkeypatch.setattr(validation, "preview_video", lambda path, *_: None)
    datasets: Any = {DATASET: "demos", ONLINE: "a policy's"}
    for fresh, saved, wanted in (
        (ONLINE, None, [("a policy's", None), ("demos", 0.6)]),
        (DATASET, 0.8, [("demos", None), ("a policy's", 0.8)]),
        (None, 0.8, [("demos", 0.8), ("a policy's", 0.8)]),
    ):
        calls.clear()
        of: dict[str, Any] = {"model": None, "success": None, "fresh": fresh, "threshold": saved}
        found = validate_datasets(datasets=datasets, config=ValidationConfig(), directory=tmp_path, **of)
        assert calls == wanted and list(found["datasets"]) == [DATASET, ONLINE] and not found["passed"]
        assert {k: c["holds"] for k, c in found["checks"].items()} == {"skill": True, "online.skill": False}
