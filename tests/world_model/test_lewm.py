# SPDX-License-Identifier: Apache-2.0
"""LeWM of stable-worldmodel as a world model that critic and teacher stand on, by a package of its own."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from accerl_lerobot.algorithms import chunk_critic
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.config.parsing import parse
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.config import StateModelConfig
from accerl_lerobot.world_model.states import StateSpec, new_state_model
from tests.runs import off_policy_run, trained, updates

SOURCE = Path(__file__).parents[1] / "packages" / "accerl_world_model_lewm"
PACKAGE = SOURCE.name
FLAGS = [
    "--config_path=few_shot", "--env.environment_state=false",
    f"--world_model.discover_packages_path={PACKAGE}", "--world_model.type=lewm",
    "--world_model.image_size=16", "--world_model.layers=1",
]  # fmt: skip
CAMERA = "observation.images.front"
SPEC = StateSpec({CAMERA: 3}, state=0, environment_state=0, chunk=(4, 2))

installed = find_spec("stable_worldmodel") is not None
needs_lewm = pytest.mark.skipif(not installed, reason="pip install --no-deps stable-worldmodel")


@pytest.fixture
def config(monkeypatch: pytest.MonkeyPatch) -> Iterator[RunConfig]:
    """A run's config with it, made where nobody has heard of it."""

    def forget() -> None:
        StateModelConfig.get_known_choices().pop("lewm", None)
        for name in [name for name in sys.modules if name.partition(".")[0] == PACKAGE]:
            del sys.modules[name]

    forget()
    monkeypatch.syspath_prepend(str(SOURCE))
    yield parse(RunConfig, FLAGS)
    forget()


@needs_lewm
def test_it_learns_in_a_run(config: RunConfig, tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch):
    model: Any = importlib.import_module(f"{PACKAGE}.model").LeWMState
    monkeypatch.setattr(model, "first_steps", 3)
    monkeypatch.setattr(model, "steps_per_decision", 0.2)
    monkeypatch.setattr(chunk_critic, "LEAST_TRANSITIONS", 8)
    trainer = TrainerConfig(updates=2, batch_decisions=16, warmup_updates=0, value_warmup_updates=1)
    run = off_policy_run(
        tiny_checkpoint, algorithm=config.algorithm, world_model=config.world_model, trainer=trainer
    )
    history, engine = trained(run)
    found, update = updates(history), cast(Any, engine._update)
    assert len(found) == 2 and "stable_worldmodel" not in sys.modules
    assert all(each["world_model_prediction"] > 0 < each["world_model_sigreg"] for each in found)
    learner, acting = update.state_learner, update.teacher.model.state_dict()
    assert learner.count >= 6
    assert acting["lewm.projector.net.1.running_mean"].abs().max() > 0, "buffers are handed over, too"
    for name, tensor in learner.model.state_dict().items():
        torch.testing.assert_close(tensor, acting[name], rtol=0, atol=0)


@needs_lewm
def test_it_starts_from_trained_weights(config: RunConfig, tmp_path: Path):
    trained: Any = new_state_model(SPEC, config.state_model)
    path = tmp_path / "lewm.safetensors"
    save_file(trained.lewm.state_dict(), path)
    given: Any = replace(config.state_model, path=str(path))
    images = np.random.default_rng(0).integers(0, 256, (2, 32, 32, 3), np.uint8)
    asked: Any = ({CAMERA: images}, ["a", "b"], np.zeros(2, np.float32))
    for chunk in ((4, 2), (5, 7)):
        loaded = new_state_model(SPEC._replace(chunk=chunk), given)
        torch.testing.assert_close(loaded.encode(*asked), trained.encode(*asked), rtol=0, atol=0)
    with pytest.raises(InputError, match=r"^world_model\.path=.*no LeWM of these sizes: .*size mismatch"):
        new_state_model(SPEC, replace(given, width=128))


@pytest.mark.skipif(installed, reason="stable-worldmodel is installed")
def test_without_its_library_it_is_one_line(config: RunConfig):
    with pytest.raises(InputError, match=r"^world_model\.type='lewm': .*pip install --no-deps stable-world"):
        new_state_model(SPEC, config.state_model)
