# SPDX-License-Identifier: Apache-2.0
"""accerl world-model from a dataset to its check, saved and loaded again; of our model and of another's."""

import json
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


def check_again(demos: Path, trained: Path, again: Path, *more: str) -> int:
    told = ["world-model-eval", f"--path={trained / 'world_model'}", "--dataset.repo_id=a/b", "--device=cpu"]
    return cli.main([*told, f"--dataset.root={demos}", f"--output_dir={again}", *more])


def test_from_a_dataset_to_a_check_and_another_check(demos: Path, tmp_path: Path, capsys: Any):
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
    check_again(demos, out, tmp_path / "again")
    again = json.loads(capsys.readouterr().out)
    assert all(again[name] == found[name] for name in CHECKS), "of its own dataset, those held out"


def test_what_cannot_be_held_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    record_dataset(tmp_path / "demos", ENV, episodes=3, failure_share=0.5)
    assert cli.main(arguments(tmp_path / "demos", tmp_path / "out")) == 2
    assert "it needs at least two successes and two failures" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.fixture
def forget() -> Iterator[Callable[[], None]]:
    """Whoever does not import the package of the linear model fails."""

    def forgotten() -> None:
        LearnableModelConfig.get_known_choices().pop("linear", None)
        sys.modules.pop(PACKAGE, None)

    forgotten()
    yield forgotten
    forgotten()


def test_a_model_of_another_package_is_named(forget: Any, demos: Path, tmp_path: Path, capsys: Any):
    out, again = tmp_path / "out", tmp_path / "again"
    cli.main(arguments(demos, out, *NAMED, "--world_model.steps=300", "--world_model.lr=0.03"))
    found = json.loads(capsys.readouterr().out)
    assert 0 < records(out)[-1]["motion"] < 0.5, "in usual motions; of one that knows nothing it is 1 or more"
    assert "skill" in found["failed"], "its pictures never change"
    forget()
    assert check_again(demos, out, again) == 2
    assert "name that: discover_packages_path" in capsys.readouterr().err
    check_again(demos, out, again, f"--discover_packages_path={PACKAGE}")
    checks = json.loads(capsys.readouterr().out)
    assert all(checks[name] == found[name] for name in CHECKS)


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


@pytest.mark.parametrize(
    ("config", "tensors", "why"),
    [
        (None, {}, "config.json: is missing"),
        ({"spec": 1}, {}, "not a world model of accerl world-model"),
        ({"learnt": 7}, {}, "not a world model of accerl world-model"),
        ({}, None, "not safetensors"),
        ({}, {"model.change": torch.tensor(torch.nan)}, "model.change holds NaN or infinity; train it again"),
    ],
)
def test_what_cannot_be_loaded(tmp_path: Path, config: dict | None, tensors: dict | None, why: str):
    folder = tmp_path / "w"
    save_world(folder, World(model()))
    content, weights = folder / "config.json", folder / "model.safetensors"
    content.write_text(json.dumps(json.loads(content.read_text()) | (config or {})))
    save_file(load_file(weights) | (tensors or {}), weights)
    if config is None:
        content.unlink()
    if tensors is None:
        weights.write_bytes(bytes(64))
    with pytest.raises(InputError, match=f"^path=.*{why}"):
        load_world(folder)
