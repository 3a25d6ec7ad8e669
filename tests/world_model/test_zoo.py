# SPDX-License-Identifier: Apache-2.0
"""Needs of a newcomer's world model: a class and a line of the table."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from accerl_lerobot.config.help import help_text
from accerl_lerobot.engine.config import RunConfig, parse
from accerl_lerobot.envs import make_world
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import IMAGINED
from accerl_lerobot.world_model.baselines import CopyModel, OracleModel, ShuffledModel
from accerl_lerobot.world_model.config import NetworkConfig, PixelModelConfig, StandInConfig
from accerl_lerobot.world_model.contract import (
    Context,
    Dream,
    History,
    Means,
    State,
    WorldModel,
)
from accerl_lerobot.world_model.imagination_config import ImaginationConfig
from accerl_lerobot.world_model.imagine import Imagination
from accerl_lerobot.world_model.kinds import KINDS, ModelKind
from accerl_lerobot.world_model.pixels import PixelWorldModel
from accerl_lerobot.world_model.pool import part
from accerl_lerobot.world_model.store import save_world_model
from accerl_lerobot.world_model.success import new_success_model
from accerl_lerobot.world_model.zoo import make_dreamer
from tests.test_imagining import dreaming, lived
from tests.world_model import lived as real


class Snow(WorldModel):
    """All that a newcomer writes: everything is white after the first chunk, and nothing ever succeeds."""

    def __init__(self, means: Means) -> None:
        self.spec = replace(means.spec, provides=means.spec.provides | {"success"})

    def begin(
        self, context: Context, tasks: Sequence[str], histories: Sequence[History | None] | None = None
    ) -> State:
        return {"robot": context.robot[:, -1]}

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Dream:
        count = len(actions)
        size = (count, len(self.spec.cameras), *self.spec.image_size, 3)
        return Dream(
            state=state,
            frames=torch.full(size, 255, dtype=torch.uint8),
            robot=state["robot"],
            uncertainty=torch.full((count,), torch.nan),
            success=torch.zeros(count),
        )


SNOW = ModelKind(make=f"{__name__}:Snow", what="a blizzard.", folder=False, judges=True)


@pytest.fixture
def snow(monkeypatch: pytest.MonkeyPatch) -> None:
    """The line of the table."""
    monkeypatch.setitem(KINDS, "snow", SNOW)


@pytest.mark.usefixtures("snow")
def test_a_policy_learns_from_a_new_kind_of_dreams(tiny_checkpoint: Path):
    _, batches, engine = lived(dreaming(tiny_checkpoint, model="snow"))
    assert engine._dreams is not None and isinstance(engine._dreams.dreamer.model, Snow)
    dreamt = [s for batch in batches for s in batch if s.source == IMAGINED]
    assert len(batches) == 12 and dreamt and not any(s.success for s in dreamt)
    following = 0
    for segment in dreamt:
        first, *later = segment.observations["observation.images.front"]
        assert first.min() < 255, "it begins at what is real"
        assert all((frame == 255).all() for frame in later)
        following += len(later)
    assert following


@pytest.mark.usefixtures("snow")
def test_what_is_asked_of_a_config_stands_in_the_table(monkeypatch: pytest.MonkeyPatch):
    def told(**line: Any) -> None:
        monkeypatch.setitem(KINDS, "snow", replace(SNOW, **line))

    with pytest.raises(InputError, match="use learned, shuffled, copy, oracle or snow$"):
        parse(RunConfig, ["--imagination.model=magic"])
    config = ImaginationConfig(share=0.5, model="snow")
    assert not config.learns
    judge = StandInConfig(path="somewhere", threshold=0.5)
    with pytest.raises(InputError, match=r"^imagination\.success\.path=.* the snow knows what has succeeded"):
        replace(config, success=judge)
    told(judges=False)
    replace(config, success=judge)
    told(folder=True)
    with pytest.raises(InputError, match=r"^imagination\.path=None"):
        replace(config)
    told(folder=True, learns=True)
    assert replace(config, path="x").learns and not replace(config, path="x", share=0.0).learns
    told(rows=3)
    with pytest.raises(
        InputError, match=r"^imagination\.dreams=5: use at least 6, or fewer .*: snow needs 3"
    ):
        replace(config, dreams=5, workers=2)


def test_the_table_is_read_without_torch():
    code = "import sys, accerl_lerobot.world_model.imagination_config; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.usefixtures("snow")
def test_help_names_them_all():
    shown = " ".join(help_text("train", RunConfig, "trains", "all").split())
    for name, kind in KINDS.items():
        assert f" {name}: {kind.what} " in shown


@pytest.mark.parametrize(
    ("name", "made"),
    [("learned", PixelWorldModel), ("shuffled", ShuffledModel), ("copy", CopyModel), ("oracle", OracleModel)],
)
def test_the_table_says_what_is_so(name: str, made: type, tmp_path: Path):
    world, kind, path = make_world(real.WORLD), KINDS[name], None
    if kind.folder:
        network = NetworkConfig(channels=(8, 8), condition=8, planes=2)
        saved = PixelWorldModel(real.SPEC, PixelModelConfig(network=network))
        save_world_model(tmp_path / "world", saved, new_success_model(real.K))
        path = str(tmp_path / "world")
    config = ImaginationConfig(share=0.5, model=name, path=path)
    model, success = make_dreamer(config, real.WORLD, world.spec, real.K, "cpu")
    assert type(model) is made and (success is None) is kind.judges
    assert ("success" in model.spec.provides) is kind.judges
    learnt = model.model if isinstance(model, ShuffledModel) else model
    assert isinstance(learnt, PixelWorldModel) is kind.learns is config.learns
    frames = torch.zeros(1, real.SPEC.context, 1, 16, 16, 3, dtype=torch.uint8)
    robot, actions = torch.zeros(1, real.SPEC.context, 4), torch.zeros(1, real.SPEC.context - 1, real.K, 2)
    context = Context(frames, robot, actions, told=torch.zeros(1, 2), first=robot[:, 0])
    with pytest.raises(ValueError, match="history") if kind.whole else nullcontext():
        model.begin(context, ["match"], [None])
    if kind.rows > 1:
        with pytest.raises(ValueError, match="alone"):
            model.step({}, torch.zeros(kind.rows - 1, real.K, 2), [0])
    world.close()


def test_nobody_who_dreams_with_other_actions_dreams_alone():
    for workers in range(1, 6):
        for dreams in range(workers, 16):
            fields: dict[str, Any] = {"share": 0.5, "path": "x", "dreams": dreams, "workers": workers}
            least = min(part(ImaginationConfig(**fields), i).dreams for i in range(workers))
            if least >= 2:
                config = ImaginationConfig(model="shuffled", **fields)
                assert all(part(config, i).dreams >= 2 for i in range(workers))
                continue
            with pytest.raises(InputError, match=rf"^imagination\.dreams={dreams}: .* {2 * workers}, or"):
                ImaginationConfig(model="shuffled", **fields)


@pytest.mark.parametrize("whole", [True, False])
@pytest.mark.usefixtures("snow")
def test_dreams_begin_only_where_their_kind_can(whole: bool, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(KINDS, "snow", replace(SNOW, whole=whole))
    config = ImaginationConfig(share=0.5, model="snow", dreams=2)
    world = make_world(real.WORLD)
    dreamer = make_dreamer(config, real.WORLD, world.spec, real.K, "cpu")
    world.close()
    dreams = Imagination(
        *dreamer, world.spec, config, decision_cost=0.0, fails=True, seed=0, name="dream", on_segment=print
    )
    _, later = real.lived(1, length=2)
    dreams.remember(later)  # what came before is not known
    assert len(dreams.requests()) == (0 if whole else 2)
