# SPDX-License-Identifier: Apache-2.0
"""A class of world models that is not ours: learnt, saved, tried, imagined with and learnt on in a run.

Each test begins where nobody has heard of it: who forgets to import its package fails.
"""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from accerl_lerobot import cli, console
from accerl_lerobot.checkpoint.layout import WORLD_MODEL
from accerl_lerobot.cli.configs import WorldModelEvalRun, WorldModelRun
from accerl_lerobot.engines.config import parse
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.config import LearnableModelConfig, WorldModelConfig
from accerl_lerobot.world_model.contract import LearnableWorldModel, new_model
from accerl_lerobot.world_model.learners import Learner, new_success_model
from accerl_lerobot.world_model.online import save_online
from accerl_lerobot.world_model.pretrain import world_spec
from accerl_lerobot.world_model.store import LEARNT, load_roles, load_world_model, save_world_model
from tests.runs import drive, replacing
from tests.test_imagination import imagining, run_locally
from tests.world_model.test_pixels import SPEC, dots, windows
from tests.world_model.test_pretrain import arguments, recorded

PACKAGE = "tests.world_model.linear_world"
NAMED = [f"--world_model.discover_packages_path={PACKAGE}", "--world_model.model.type=linear"]
ENV = SimulatedConfig(max_steps=16, hold=8)


def forgotten() -> None:
    LearnableModelConfig.get_known_choices().pop("linear", None)
    sys.modules.pop(PACKAGE, None)


@pytest.fixture(autouse=True)
def unheard_of() -> Iterator[None]:
    forgotten()
    yield
    forgotten()


def linear(**fields: Any) -> LearnableModelConfig:
    config: LearnableModelConfig = importlib.import_module(PACKAGE).LinearModelConfig(**fields)
    return config


def saved(folder: Path, **fields: Any) -> Path:
    torch.manual_seed(0)
    config = linear(**fields)
    spec = world_spec(WorldModelConfig(chunk=4, image_size=32, model=config), ENV)
    save_world_model(folder, new_model(spec, config), new_success_model(4))
    forgotten()
    return folder


def name_of(model: object) -> str:
    return type(model).__name__


def test_it_is_learned_and_tried_by_naming_its_package(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(console, "PLAIN_EVERY_S", -1.0)
    demos, out = recorded(tmp_path / "dataset", 24, 0), tmp_path / "out"
    ours = "--world_model.model.channels=16,24"
    told = [a for a in arguments(demos, out) if a != ours]
    told = replacing(told, *NAMED, "--world_model.learn.steps=300")
    cli.main([*told, "--world_model.learn.lr=0.03"])
    stdout, stderr = capsys.readouterr()
    found = json.loads(stdout)
    assert "world model 300/300 (100%) · motion 0." in stderr
    losses = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    told_of = [row["motion"] for row in losses if row["kind"] == "world_model"]
    assert 0 < told_of[-1] < 0.5, "in usual motions; of one that knows nothing it is 1 or more"
    forgotten()
    model, success = load_world_model(out / "world_model", PACKAGE)
    assert name_of(model) == "LinearWorldModel" and model.config.context == 1
    assert float(model.uncertainty_scale) == 1.0 and not model.training
    capsys.readouterr()  # LeRobot prints
    path, trial = f"--path={out / 'world_model'}", "--validation.depth=2"
    dataset = ["--dataset.repo_id=a/b", f"--dataset.root={demos}", f"--output_dir={tmp_path / 'again'}"]
    forgotten()
    assert cli.main(["world-model-eval", path, *dataset, trial]) == 2
    assert "or name its package: discover_packages_path" in capsys.readouterr().err
    cli.main(["world-model-eval", path, *dataset, trial, f"--discover_packages_path={PACKAGE}"])
    again = json.loads(capsys.readouterr().out)
    (first, _), (same, _) = (result["datasets"]["dataset"]["depths"] for result in (found, again))
    assert first["state_error"] == pytest.approx(same["state_error"])
    assert not found["passed"], "its pictures never change"


def test_its_fields_are_fields_of_the_command_line():
    run = parse(WorldModelRun, [*NAMED, "--world_model.model.gain=2", "--world_model.image_size=18"])
    assert run.world_model.model == linear(gain=2.0)
    with pytest.raises(InputError, match=r"^world_model.model.gain=0\.?0?: use a positive number"):
        parse(WorldModelRun, [*NAMED, "--world_model.model.gain=0"])
    with pytest.raises(InputError, match="^world_model.model.context=0: use a whole number in .1,"):
        linear(context=0)
    with pytest.raises(
        InputError, match="^world_model.model.channels=3: no such field; world_model.model has"
    ):
        parse(WorldModelRun, [*NAMED, "--world_model.model.channels=3"])


def test_packages_that_cannot_be_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "a_model_of_mine.py").write_text("raise SystemExit(0)")
    why = "cannot be imported .SystemExit: 0"
    with pytest.raises(InputError, match=f"^world_model.discover_packages_path='a_model_of_mine': {why}"):
        parse(WorldModelRun, ["--world_model.discover_packages_path=a_model_of_mine"])
    with pytest.raises(InputError, match=f"^imagination.discover_packages_path='a_model_of_mine': {why}"):
        load_world_model(tmp_path / "w", "a_model_of_mine", section="imagination")


def test_whoever_does_not_name_its_package_is_told_to(tmp_path: Path):
    path = str(saved(tmp_path / "w"))
    wanted = "config.json: model.type: 'linear'; use one of pixels, or name its package: "
    with pytest.raises(InputError, match=f"^imagination.path=.*{wanted}imagination.discover_packages_path$"):
        load_world_model(tmp_path / "w", section="imagination")
    with pytest.raises(InputError, match=f"^path=.*{wanted}discover_packages_path$"):
        load_world_model(tmp_path / "w")
    options = [f"--path={path}", f"--discover_packages_path={PACKAGE}"]
    assert parse(WorldModelEvalRun, options).discover_packages_path == PACKAGE and PACKAGE not in sys.modules


def test_what_its_file_says_is_its_configs_to_refuse(tmp_path: Path):
    file = saved(tmp_path / "w") / "config.json"
    good = json.loads(file.read_text())
    assert good["model"] == {"type": "linear", "context": 1, "gain": 1.0}
    for model, why in (
        ({"gain": -1.0}, "use a positive number"),
        ({"gain": "much"}, "not a world model of accerl world-model"),
        ({"type": ["linear"]}, "use one of"),
    ):
        file.write_text(json.dumps(good | {"model": good["model"] | model}))
        with pytest.raises(InputError, match=f"^path=.*{why}"):
            load_world_model(tmp_path / "w", PACKAGE)


@dataclass(frozen=True, kw_only=True)
class BareConfig(LearnableModelConfig):
    """Says nothing of its class."""


def test_it_imagines_and_goes_on_learning_in_a_run(tiny_checkpoint: Path, tmp_path: Path):
    config = imagining(tiny_checkpoint, saved(tmp_path / "w", gain=3.0), episodes=24)
    named = replace(config.imagination, discover_packages_path=PACKAGE)
    history, _, engine = run_locally(replace(config, imagination=named))
    assert history[-1].replay["trained_imagined"] > 0
    save_online(tmp_path, engine._world_learner)
    roles = load_roles(tmp_path / WORLD_MODEL)
    assert len(roles) == history[-1].world_model["learn_episodes"] and set(roles.values()) == {LEARNT}
    before, after = (load_world_model(tmp_path / name)[0] for name in ("w", WORLD_MODEL))
    assert name_of(after) == "LinearWorldModel" and after.config == linear(gain=3.0)
    moved = after.get_parameter("motion.weight") - before.get_parameter("motion.weight")
    assert float(moved.abs().max()) > 0


@pytest.mark.slow
def test_in_processes_of_their_own_they_find_it_too(tiny_checkpoint: Path, tmp_path: Path):
    from accerl_lerobot.engines.ray_engine import RayEngine

    config = imagining(tiny_checkpoint, saved(tmp_path / "w"), episodes=24)
    named = replace(config.imagination, discover_packages_path=PACKAGE)
    config = replace(config, imagination=named, output_dir=str(tmp_path / "run"))
    engine = RayEngine(config, ("match",))
    try:
        engine.train()
        last = drive(engine)[-1]
    finally:
        engine.close()
    assert last.version == 12 and last.world_model["learn_steps"] > 0 < last.replay["trained_imagined"]


class Moody(LearnableWorldModel):
    """Behaves otherwise in training, counts in a buffer, has a layer twice, and a view."""

    def __init__(self, spec: Any, config: Any) -> None:
        super().__init__(spec, config)
        self.norm, self.first = nn.BatchNorm1d(spec.action_dim), nn.Linear(spec.action_dim, spec.action_dim)
        self.again = self.first
        self.part = nn.Parameter(torch.randn(64)[:4])

    def fit_statistics(self, windows: Any) -> None:
        """It has none."""

    def begin(self, context: Any, tasks: Any) -> Any:
        """See the base class."""

    def step(self, state: Any, actions: Any, seeds: Any) -> Any:
        """See the base class."""

    def loss(self, windows: Any, generator: torch.Generator) -> Any:
        """How far what it makes of the first actions is from nothing."""
        made = self.norm(self.again(torch.from_numpy(windows.actions[:, 0, 0])))
        return (made + 1).square().mean() + self.part.square().mean(), {}


def test_it_is_tried_and_saved_as_it_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Not in training; with what it has counted; and with layers that it has twice, and views."""
    monkeypatch.setitem(LearnableModelConfig.get_known_choices(), "bare", BareConfig)
    monkeypatch.setattr(BareConfig, "make", f"{__name__}:Moody", raising=False)
    learner = Learner(new_model(SPEC, BareConfig()).eval(), WorldModelConfig(), seed=0)
    assert learner.model.training and not learner.serving.training
    for _ in range(3):
        learner.step(windows(dots(4)))
    counted, served = (m.get_submodule("norm").state_dict() for m in (learner.model, learner.serving))
    assert int(served["num_batches_tracked"]) == 3
    assert torch.equal(counted["running_var"], served["running_var"])
    save_world_model(tmp_path / "w", learner.serving, new_success_model(2))
    again, _ = load_world_model(tmp_path / "w")
    assert not any(module.training for module in again.modules())
    for name, value in learner.serving.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name
