# SPDX-License-Identifier: Apache-2.0
"""accerl world-model-eval on several datasets: thresholds and checks."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from accerl_lerobot import cli
from accerl_lerobot.demos.dataset_files import open_metadata
from accerl_lerobot.engine.config import DatasetConfig
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model import validation as evaluate
from accerl_lerobot.world_model.config import (
    NetworkConfig,
    PixelModelConfig,
    ValidationConfig,
    WorldModelConfig,
)
from accerl_lerobot.world_model.data import fingerprint
from accerl_lerobot.world_model.learners import new_success_model
from accerl_lerobot.world_model.pixels import PixelWorldModel
from accerl_lerobot.world_model.pretrain import world_spec
from accerl_lerobot.world_model.store import Source, save_world_model
from accerl_lerobot.world_model.validation import (
    HELD_OUT,
    ONLINE,
    open_datasets,
    validate_datasets,
)
from tests.runs import replacing
from tests.world_model.test_pretrain import recorded

ENV = SimulatedConfig(max_steps=60, hold=25, image_size=16)
CONFIG = WorldModelConfig(
    image_size=16,
    chunk=5,
    model=PixelModelConfig(network=NetworkConfig(channels=(8, 8), condition=8, planes=2)),
)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Demonstrations, a world model that has learnt from some of them (nothing yet), and other episodes."""
    root = tmp_path_factory.mktemp("evaluated")
    demos, others = recorded(root / "demos", 8, 0), recorded(root / "others", 8, 1)
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
        f"--output_dir={out}", "--validation.depth=2", *more,
    ]  # fmt: skip


def test_the_same_measures_on_every_dataset(
    folders: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    more = ["--online.repo_id=a/b", f"--online.root={folders[2]}"]
    code = cli.main(told(folders, out, *more))
    stdout, stderr = capsys.readouterr()
    found = json.loads(stdout)
    assert code == 1 and found == json.loads((out / "validation.json").read_text())
    every = {found["name"]: found} | found["datasets"]
    assert {name: one["tried"]["episodes"] for name, one in every.items()} == {
        "held out": 4, "online": 8,
    }  # fmt: skip
    for one in every.values():
        assert set(one["checks"]) == set(found["checks"])
        assert {"skill_changed", "sensitivity_shuffled"} < {*one["depths"][0]}
    assert {p.name for p in out.iterdir()} == {
        "config.yaml", "validation.json", "preview.mp4", "preview_online.mp4",
    }  # fmt: skip
    assert "By dataset" in stderr and "checks that hold" in stderr
    assert "trained on a/b (dataset): evaluated on its 4 held-out episodes" in stderr


def test_one_that_does_not_know_the_dataset_is_tried_on_all_of_it(
    folders: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    arguments = [a.replace(str(folders[0]), str(folders[2])) for a in told(folders, tmp_path / "out")]
    cli.main(arguments)
    found = json.loads(capsys.readouterr().out)
    assert found["name"] == "dataset" and found["tried"]["episodes"] == 8 and found["datasets"] == {}


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--online={repo_id: a/b, root: nowhere}", "online.root='nowhere': no meta/info.json there"),
        ("--policies=[a]", "policies"),
        ("--path=nowhere", "path='nowhere': config.json: is missing"),
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


SAVED, SET = 0.8, 0.6


class Tried:
    """In place of a trial: what each source was judged by, in order."""

    def __init__(self) -> None:
        self.judged: list[tuple[str, float, bool]] = []

    def __call__(
        self, model: Any, episodes: Any, config: Any, success: Any, seed: int, fresh: bool
    ) -> dict[str, Any]:
        self.judged.append((episodes, success.config.threshold, fresh))
        if fresh:
            success.config.threshold = SET
        gate = {"value": 1.0, "wanted": "above 0", "holds": episodes != "fails"}
        return {"checks": {"skill": gate}, "passed": gate["holds"], "threshold": success.config.threshold}


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> Tried:
    tried = Tried()
    monkeypatch.setattr(evaluate, "validate", tried)
    monkeypatch.setattr(evaluate, "preview_video", lambda path, *_: path.write_bytes(b"video"))
    monkeypatch.setattr(evaluate, "count_episodes", lambda episodes: {"episodes": 1})
    return tried


def validated(tmp_path: Path, of: dict[str, Any], **options: Any) -> tuple[dict[str, Any], float]:
    success: Any = SimpleNamespace(config=SimpleNamespace(threshold=SAVED))
    found = validate_datasets(None, of, ValidationConfig(), success, tmp_path, **options)  # type: ignore[arg-type]
    return found, success.config.threshold


def test_what_is_set_on_a_policys_episodes_is_kept_and_classifies_the_others(tried: Tried, tmp_path: Path):
    """They come first then, but in what is validated the first stays the first."""
    of = {HELD_OUT: "demos", ONLINE: "policy's"}
    found, threshold = validated(tmp_path, of, trained_on=of, fresh=ONLINE, keep_threshold=True)
    assert threshold == SET
    assert tried.judged == [("policy's", SAVED, True), ("demos", SET, False)]
    assert found["name"] == HELD_OUT and list(found["datasets"]) == [ONLINE]
    assert {path.name for path in tmp_path.iterdir()} == {"preview.mp4", "preview_online.mp4"}


def test_a_threshold_that_was_saved_is_only_set_anew_where_it_comes_from(tried: Tried, tmp_path: Path):
    of = {HELD_OUT: "demos", ONLINE: "another policy's", "perturbed": "again"}
    found, threshold = validated(tmp_path, of, trained_on=[HELD_OUT], fresh=HELD_OUT)
    assert threshold == SAVED and found["threshold"] == SET
    assert tried.judged == [
        ("demos", SAVED, True),
        ("another policy's", SAVED, False),
        ("again", SAVED, False),
    ]


def test_checks_of_what_it_has_learned_from_count(tried: Tried, tmp_path: Path):
    of = {HELD_OUT: "demos", ONLINE: "fails"}
    found, _ = validated(tmp_path, of, trained_on=of)
    assert not found["passed"] and {k: g["holds"] for k, g in found["checks"].items()} == {
        "skill": True, "online.skill": False,
    }  # fmt: skip
    found, _ = validated(tmp_path, of, trained_on=[HELD_OUT])
    assert found["passed"] and list(found["checks"]) == ["skill"]


def test_a_dataset_is_known_by_the_order_of_its_episodes_too(tmp_path: Path):
    config = WorldModelConfig(image_size=16, model=PixelModelConfig(network=NetworkConfig(channels=(16, 24))))
    spec = world_spec(config, ENV)
    one, other = (
        DatasetConfig(repo_id="a/b", root=str(recorded(tmp_path / str(seed), 3, seed))) for seed in (0, 1)
    )
    opened = open_datasets({"dataset": one, "online": other}, spec)
    assert [meta.total_episodes for meta in opened.values()] == [3, 3]
    meta = opened["dataset"]
    ends = {key: list(meta.episodes[key]) for key in ("dataset_from_index", "dataset_to_index")}
    turned = SimpleNamespace(stats=meta.stats, fps=meta.fps, episodes=ends)
    assert evaluate.fingerprint(turned) == evaluate.fingerprint(meta)
    ends["dataset_to_index"][0] += 1
    ends["dataset_from_index"][1] += 1
    assert evaluate.fingerprint(turned) != evaluate.fingerprint(opened["dataset"])
    with pytest.raises(InputError, match="^online.repo_id='a/b': it is the one in dataset; name another"):
        open_datasets({"dataset": one, "online": one}, spec)
    with pytest.raises(InputError, match="^online.root='nowhere': no meta/info.json there"):
        open_datasets({"dataset": one, "online": DatasetConfig(repo_id="a/b", root="nowhere")}, spec)
