# SPDX-License-Identifier: Apache-2.0
"""accerl world-model from a dataset to its validation, saved and loaded again; accerl world-model-eval."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from accerl_lerobot import cli
from accerl_lerobot.cli.configs import WorldModelEvalRun, WorldModelRun
from accerl_lerobot.demos.record import DemosConfig, record_demos
from accerl_lerobot.engines.config import DatasetConfig
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model import learners, pixels, pretrain, validation
from accerl_lerobot.world_model.config import PixelModelConfig, WorldModelConfig
from accerl_lerobot.world_model.contract import new_model
from accerl_lerobot.world_model.data import DATASET, ONLINE, load_datasets
from accerl_lerobot.world_model.learners import new_success_model
from accerl_lerobot.world_model.store import (
    HELD_OUT,
    LEARNT,
    check_predicts,
    load_failed,
    load_roles,
    load_world_model,
    save_world_model,
)
from tests.runs import replacing
from tests.world_model.test_pixels import dots, model

ENV = SimulatedConfig(max_steps=60, hold=25, image_size=16)
CONFIG = WorldModelConfig(image_size=16, chunk=5, model=PixelModelConfig(channels=(8, 8)))


def recorded(root: Path, episodes: int, seed: int) -> Path:
    of = DemosConfig(episodes=episodes, failure_share=0.5)
    return record_demos(ENV, of, str(root), seed)


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("demos") / "dataset", 8, 0)


@pytest.fixture(scope="module")
def rollouts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("rollouts") / "dataset", 6, 1)


def arguments(demos: Path, output_dir: Path) -> list[str]:
    return [
        "world-model", "--env.type=simulated", "--env.image_size=16", "--dataset.repo_id=a/b",
        f"--dataset.root={demos}", f"--output_dir={output_dir}", "--device=cpu",
        "--world_model.image_size=16", "--world_model.chunk=5", "--world_model.learn.steps=25",
        "--world_model.success.steps=10", "--world_model.validation.depth=2",
        "--world_model.model.channels=16,24",
    ]  # fmt: skip


def test_from_a_dataset_to_a_validation(demos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "out"
    code = cli.main(arguments(demos, out))
    stdout, stderr = capsys.readouterr()
    found = json.loads(stdout)
    assert code == (0 if found["passed"] else 1) and found == json.loads(
        (out / "validation.json").read_text()
    )
    assert {p.name for p in out.iterdir()} == {
        "config.yaml", "world_model", "validation.json", "preview.mp4", "metrics.jsonl",
    }  # fmt: skip
    assert found["learnt"]["episodes"] + found["held_out"]["episodes"] == 8
    [(name, one)] = found["datasets"].items()
    assert name == "dataset" and found["checks"] == one["checks"]
    assert [row["depth"] for row in one["depths"]] == [1, 2] and found["seconds"] > 0
    assert one["threshold"] >= 0.5
    kinds = [json.loads(line)["kind"] for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert kinds == ["world_model"]
    assert all(check in stderr for check in found["checks"]) and "preview.mp4" in stderr
    environment, success = load_world_model(out / "world_model")
    assert success.config.chunk == environment.spec.chunk == 5
    assert success.config.threshold == pytest.approx(one["threshold"])
    failed = [name for name, check in found["checks"].items() if not check["holds"]]
    assert load_failed(out / "world_model") == failed != []
    assert (
        environment.spec.cameras == ("observation.images.front",)
        and float(environment.uncertainty_scale) != 1
    )
    assert (out / "preview.mp4").stat().st_size > 1000


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (
            "--world_model.validation.depth=20",
            "world_model.validation.depth=20: held-out episodes have at most",
        ),
        ("--env.task=mirror", "env.task='mirror': an episode's task is"),
    ],
)
def test_what_is_refused_before_anything_is_learnt(
    option: str, message: str, demos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert cli.main(replacing(arguments(demos, tmp_path / "out"), option)) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_one_success_is_not_enough_to_learn_from_and_be_classified_on():
    config = WorldModelConfig()
    failures = dots(4, steps=80)
    success = [replace(failures[0], success_at=79)]
    with pytest.raises(InputError, match="at least two successes and two failures"):
        pretrain._check_split(DatasetConfig(), success + failures[:2], failures[2:], config)
    pretrain._check_split(DatasetConfig(), success + failures[:2], success + failures[2:], config)


@pytest.mark.slow
def test_a_policys_episodes_are_learned_from_beside_demonstrations(
    demos: Path,
    rollouts: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    seen: dict[str, set[str]] = {}

    def spy(module: Any, name: str) -> None:
        real = getattr(module, name)

        def called(*args: Any) -> Any:
            seen.setdefault(name, set()).update(episode.key for episode in args[1])
            return real(*args)

        monkeypatch.setattr(module, name, called)

    spy(learners, "train_from_scratch")
    spy(validation, "validate")
    theirs = ["--online.repo_id=a/rollouts", f"--online.root={rollouts}"]
    out = tmp_path / "out"
    code = cli.main([*arguments(demos, out), *theirs])
    stdout, stderr = capsys.readouterr()
    found = json.loads(stdout)
    roles = load_roles(out / "world_model")
    assert seen["train_from_scratch"] == {key for key, role in roles.items() if role == "learnt"}
    assert seen["validate"] == roles.keys() - seen["train_from_scratch"]
    counts = Counter(roles.values())
    assert counts["learnt"] == found["learnt"]["episodes"] and counts.total() == 8 + 6
    assert counts["held out"] == found["held_out"]["episodes"]
    online = found["datasets"]["online"]
    assert found["passed"] is all(check["holds"] for check in found["checks"].values()) is (code == 0)
    assert (out / "preview_online.mp4").stat().st_size > 1000
    environment, success = load_world_model(out / "world_model")
    assert success.config.threshold == online["threshold"]
    assert environment.spec.tasks == ("match",) and "online" in stderr


@pytest.mark.parametrize(
    ("harm", "why"),
    [
        ("nowhere", "config.json: is missing"),
        ("config", "config.json: model.type: 'None'; use one of"),
        ("success", "config.json: is missing"),
        ("weights", "model.safetensors: not safetensors"),
        ("size", "not a world model of accerl world-model"),
        ("chunk", r"config.json: spec.chunk=0: use a whole number in \[1, "),
        ("nan", "model.safetensors: uncertainty_scale holds NaN or infinity; train it again"),
    ],
)
def test_what_cannot_be_loaded(tmp_path: Path, harm: str, why: str):
    folder = tmp_path / "w"
    save_world_model(folder, model(), new_success_model(2))
    if harm == "nowhere":
        folder = tmp_path / "nowhere"
    if harm == "config":
        (folder / "config.json").write_text("{}")
    if harm == "success":
        shutil.rmtree(folder / "success_model")
    if harm == "weights":
        (folder / "model.safetensors").write_bytes(b"\x00" * 64)
    if harm == "nan":
        tensors = load_file(folder / "model.safetensors")
        save_file(
            tensors | {"uncertainty_scale": tensors["uncertainty_scale"] * float("nan")},
            folder / "model.safetensors",
        )
    if harm in ("size", "chunk"):
        content = json.loads((folder / "config.json").read_text())
        content["spec"] |= {"action_dim": 7} if harm == "size" else {"chunk": 0}
        (folder / "config.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=f"^path=.*{why}"):
        load_world_model(folder)


def test_one_that_predicts_nothing_is_refused_before_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path / "w"
    save_world_model(folder, model(), new_success_model(2).eval())
    loaded = load_world_model(folder)
    check_predicts(folder, *loaded)
    monkeypatch.setattr(pixels.PixelWorldModel, "step", lambda *_: 1 / 0)
    with pytest.raises(InputError, match=r"^path=.*config.json: it predicts nothing \(division by zero\)"):
        check_predicts(folder, *loaded)


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


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Demonstrations, a world model that has learnt from some of them (nothing yet), and other episodes."""
    root = tmp_path_factory.mktemp("evaluated")
    demos, others = recorded(root / "demos", 8, 0), recorded(root / "others", 8, 1)
    torch.manual_seed(0)
    spec = pretrain.world_spec(CONFIG, ENV)
    episodes = load_datasets({DATASET: DatasetConfig(repo_id="a/b", root=str(demos))}, spec)[DATASET]
    roles = {episode.key: LEARNT if i < 4 else HELD_OUT for i, episode in enumerate(episodes)}
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
    assert "sensitivity" in stderr and "FAILS" in stderr
    assert "dataset: trained on 4 episodes of it, evaluated on the other 4" in stderr


def test_one_that_does_not_know_the_dataset_is_tried_on_all_of_it(
    folders: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    arguments = [a.replace(str(folders[0]), str(folders[2])) for a in told(folders, tmp_path / "out")]
    cli.main(arguments)
    found = json.loads(capsys.readouterr().out)
    assert {name: one["episodes"] for name, one in found["datasets"].items()} == {DATASET: 8}
