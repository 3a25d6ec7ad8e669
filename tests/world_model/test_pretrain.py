# SPDX-License-Identifier: Apache-2.0
"""accerl world-model from a dataset to its check, saved and loaded again; of our model and of another's."""

import json
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from accerl_lerobot import cli
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.config import LearnableModelConfig
from accerl_lerobot.world_model.imagined import World, load_world, save_world
from tests.runs import records, replacing
from tests.tiny_datasets import record_dataset
from tests.world_model.test_pixels import model

ENV = SimulatedConfig(max_steps=60, hold=25, image_size=16)
CHECKS = ("skill", "sensitivity", "auroc")
PACKAGE = "tests.world_model.linear_world"
NAMED = [f"--world_model.discover_packages_path={PACKAGE}", "--world_model.model.type=linear"]


def forget() -> None:
    LearnableModelConfig.get_known_choices().pop("linear", None)
    sys.modules.pop(PACKAGE, None)


@pytest.fixture(autouse=True)
def forgotten() -> Iterator[None]:
    """Whoever does not import the package of the linear model fails."""
    forget()
    yield
    forget()


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("demos") / "dataset"
    record_dataset(root, ENV, episodes=12, failure_share=0.5)
    return root


def arguments(demos: Path, output_dir: Path, *more: str) -> list[str]:
    told = [
        "world-model", "--env.type=simulated", "--env.image_size=16", "--dataset.repo_id=a/b",
        f"--dataset.root={demos}", f"--output_dir={output_dir}", "--device=cpu",
        "--world_model.image_size=16", "--world_model.chunk=5", "--world_model.steps=25",
    ]  # fmt: skip
    return replacing(told, *more)


def test_from_a_dataset_to_a_check_and_another_check(
    demos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    code = cli.main(arguments(demos, out, "--world_model.model.channels=16,24"))
    stdout, stderr = capsys.readouterr()
    found = json.loads(stdout)
    assert code == 1 and found["failed"], "it has hardly learnt"
    assert found == json.loads((out / "validation.json").read_text())
    assert {path.name for path in out.iterdir()} == {
        "config.yaml", "world_model", "validation.json", "preview.mp4", "metrics.jsonl",
    }  # fmt: skip
    losses = records(out)
    assert [line["step"] for line in losses] == [20] and {"image", "state", "success"} <= losses[0].keys()
    assert all(name in stderr for name in CHECKS) and "FAILED on 2 episodes; see" in stderr
    world = load_world(out / "world_model")
    assert float(world.success.threshold) == pytest.approx(found["threshold"])
    assert world.failed_checks == found["failed"] and world.tasks == ["Match the target"]
    assert len(world.learnt) + found["episodes"] == 12
    told = ["world-model-eval", f"--path={out / 'world_model'}", "--dataset.repo_id=a/b"]
    cli.main([*told, f"--dataset.root={demos}", f"--output_dir={tmp_path / 'again'}", "--device=cpu"])
    again = json.loads(capsys.readouterr().out)
    assert all(again[name] == found[name] for name in CHECKS), "of its own dataset, those held out"


def test_what_cannot_be_held_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    record_dataset(tmp_path / "demos", ENV, episodes=3, failure_share=0.5)
    assert cli.main(arguments(tmp_path / "demos", tmp_path / "out")) == 2
    assert "it needs at least two successes and two failures" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_model_of_another_package_is_learned_and_checked_by_naming_it(
    demos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    cli.main(arguments(demos, out, *NAMED, "--world_model.steps=300", "--world_model.lr=0.03"))
    found = json.loads(capsys.readouterr().out)
    losses = records(out)
    assert 0 < losses[-1]["motion"] < 0.5, "in usual motions; of one that knows nothing it is 1 or more"
    assert "skill" in found["failed"], "its pictures never change"
    told = ["world-model-eval", f"--path={out / 'world_model'}", "--dataset.repo_id=a/b", "--device=cpu"]
    told += [f"--dataset.root={demos}", f"--output_dir={tmp_path / 'again'}"]
    forget()
    assert cli.main(told) == 2
    assert "name that: discover_packages_path" in capsys.readouterr().err
    cli.main([*told, f"--discover_packages_path={PACKAGE}"])
    again = json.loads(capsys.readouterr().out)
    assert all(again[name] == found[name] for name in CHECKS)


def reconfigured(folder: Path, **changes: Any) -> None:
    """Puts other values into a world model's ``config.json``."""
    content = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(content | changes))


def not_finite(folder: Path) -> None:
    tensors = load_file(folder / "model.safetensors")
    save_file(tensors | {"model.change": tensors["model.change"] * torch.nan}, folder / "model.safetensors")


@pytest.mark.parametrize(
    ("harm", "why"),
    [
        (shutil.rmtree, "config.json: is missing"),
        (lambda folder: reconfigured(folder, spec=1), "not a world model of accerl world-model"),
        (lambda folder: reconfigured(folder, learnt=7), "not a world model of accerl world-model"),
        (lambda folder: (folder / "model.safetensors").write_bytes(bytes(64)), "not safetensors"),
        (not_finite, "model.safetensors: model.change holds NaN or infinity; train it again"),
    ],
)
def test_what_cannot_be_loaded(tmp_path: Path, harm: Callable[[Path], object], why: str):
    save_world(tmp_path / "w", World(model()))
    harm(tmp_path / "w")
    with pytest.raises(InputError, match=f"^path=.*{why}"):
        load_world(tmp_path / "w")


def test_it_is_saved_as_it_is_used(tmp_path: Path):
    """Layers and parts of memory that a model has twice are saved too; nothing is in training."""
    world = World(model()).train()
    save_world(tmp_path / "plain", world)
    loaded = load_world(tmp_path / "plain")
    assert not any(module.training for module in loaded.modules())
    assert not any(parameter.requires_grad for parameter in loaded.parameters())
    world.model.again = world.model.motion
    world.model.part = nn.Parameter(torch.zeros(64)[:4])
    save_world(tmp_path / "twice", world)
    saved = load_file(tmp_path / "twice" / "model.safetensors")
    for name, value in world.state_dict().items():
        assert torch.equal(value, saved[name]), name
