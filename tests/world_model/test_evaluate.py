# SPDX-License-Identifier: Apache-2.0
"""``accerl world-model-eval`` on several sources."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from accerl_lerobot import cli
from accerl_lerobot.demos.dataset_files import open_metadata
from accerl_lerobot.demos.record import DemosConfig, record_demos
from accerl_lerobot.engine.config import DatasetConfig
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model import evaluate
from accerl_lerobot.world_model.by_source import source_rows
from accerl_lerobot.world_model.config import (
    NetworkConfig,
    PixelModelConfig,
    WorldModelConfig,
)
from accerl_lerobot.world_model.dataset import fingerprint
from accerl_lerobot.world_model.offline import world_spec
from accerl_lerobot.world_model.pixels import PixelWorldModel
from accerl_lerobot.world_model.store import Source, save_world_model
from accerl_lerobot.world_model.success import new_success_model
from tests.runs import replacing
from tests.world_model.test_learn_device import moved

ENV = SimulatedConfig(max_steps=60, hold=25, image_size=16)
CONFIG = WorldModelConfig(
    image_size=16,
    chunk=5,
    model=PixelModelConfig(network=NetworkConfig(channels=(8, 8), condition=8, planes=2)),
)


def recorded(folder: Path, seed: int) -> Path:
    episodes = DemosConfig(
        episodes=8, failure_share=0.5, processes=1, root=str(folder), repo_id="a/b", seed=seed
    )
    return record_demos(ENV, episodes)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Demonstrations, a world model that has learnt from some of them (nothing yet), and other episodes."""
    root = tmp_path_factory.mktemp("evaluated")
    demos, others = recorded(root / "demos", 0), recorded(root / "others", 1)
    torch.manual_seed(0)
    print_ = fingerprint(open_metadata(DatasetConfig(repo_id="a/b", root=str(demos))))
    source = Source(repo_id="a/b", fingerprint=print_, learnt=(0, 1, 2, 3), held_out=(4, 5, 6, 7))
    spec = world_spec(CONFIG, ENV)
    save_world_model(root / "model", PixelWorldModel(spec, CONFIG.model), new_success_model(5), [source])
    return demos, root / "model", others


def told(folders: tuple[Path, Path, Path], out: Path, *more: str) -> list[str]:
    demos, model, _ = folders
    return [
        "world-model-eval", f"--path={model}", "--dataset.repo_id=a/b", f"--dataset.root={demos}",
        f"--output_dir={out}", "--trial.depth=2", *more,
    ]  # fmt: skip


def test_the_same_measures_on_every_source(
    folders: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    more = ["--online.repo_id=a/b", f"--online.root={folders[2]}"]
    code = cli.main(told(folders, out, *more))
    stdout, stderr = capsys.readouterr()
    found = json.loads(stdout)
    assert code == 1 and found == json.loads((out / "trial.json").read_text())
    every = {found["name"]: found} | found["sources"]
    assert {name: one["tried"]["episodes"] for name, one in every.items()} == {
        "held out": 4, "online": 8,
    }  # fmt: skip
    for one in every.values():
        assert set(one["gates"]) == set(found["gates"])
        assert {"skill_changed", "sensitivity_shuffled"} < {*one["depths"][0]}
    assert {p.name for p in out.iterdir()} == {
        "config.yaml", "trial.json", "preview.mp4", "preview_online.mp4",
    }  # fmt: skip
    assert "By source" in stderr and "gates that hold" in stderr
    assert cli.main(["report", str(out)]) == 0
    page = (out / "report.html").read_text()
    assert "By source" in page and "that a policy lived through" in page


def test_what_dreams_and_what_judges_go_to_the_device(
    folders: tuple[Path, Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    asked, went = moved(monkeypatch)
    tried: list[list[str]] = []
    real = evaluate.try_sources

    def try_sources(*args: Any, **options: Any) -> Any:
        tried.append([kind for kind, device in went if device == torch.device("cpu", 0)])
        return real(*args, **options)

    monkeypatch.setattr(evaluate, "try_sources", try_sources)
    cli.main(told(folders, tmp_path / "out", "--device=cuda:3"))
    assert asked == ["cuda:3"] and tried == [["PixelWorldModel", "SuccessPairsRewardModel"]]
    stands_in: list[Any] = []

    def load_stand_in(*args: Any) -> Any:
        stands_in.append(args[3])
        raise InputError("success.path", "x", "enough")

    monkeypatch.setattr(evaluate, "rehearse_stand_in", lambda *args: None)
    monkeypatch.setattr(evaluate, "load_stand_in", load_stand_in)
    cli.main(told(folders, tmp_path / "again", "--success.path=x"))
    assert asked == ["cuda:3", "auto"] and stands_in == [torch.device("cpu", 0)]


def test_one_that_does_not_know_the_dataset_is_tried_on_all_of_it(
    folders: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    arguments = [a.replace(str(folders[0]), str(folders[2])) for a in told(folders, tmp_path / "out")]
    cli.main(arguments)
    found = json.loads(capsys.readouterr().out)
    assert found["name"] == "dataset" and found["tried"]["episodes"] == 8 and found["sources"] == {}


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--online={repo_id: a/b, root: nowhere}", "online.root='nowhere': no meta/info.json there"),
        ("--policies=[a]", "policies"),
    ],
)
def test_what_is_refused(
    folders: tuple[Path, Path, Path],
    option: str,
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    assert cli.main(replacing(told(folders, tmp_path / "out"), option)) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_rows_of_sources_leave_out_what_none_of_them_has():
    skill = {"value": 0.5, "low": 0.25, "high": 0.75}
    one = {"gates": {"a": {"holds": True}, "b": {"holds": False}}, "depths": [{"skill_changed": skill}]}
    empty = {"gates": {}, "depths": [], "tried": {"episodes": 3}}
    assert source_rows([one, empty]) == [
        ("episodes", ["", "3"]),
        ("gates that hold", ["1 of 2", "0 of 0"]),
        ("skill, changed pixels, first chunk", ["0.50 [0.25, 0.75]", ""]),
        ("last chunk", ["0.50 [0.25, 0.75]", ""]),
    ]
