# SPDX-License-Identifier: Apache-2.0
"""The sizes of world models: how large they are, and that each of them learns and dreams."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from accerl_lerobot.cli.configs import WorldModelRun
from accerl_lerobot.config.help import help_text
from accerl_lerobot.engine.config import RunConfig, encode, parse
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.config import WorldModelConfig
from accerl_lerobot.world_model.contract import WorldModelSpec
from accerl_lerobot.world_model.episodes import Episode, cut, places
from accerl_lerobot.world_model.learn import Learner
from accerl_lerobot.world_model.pixels import PixelWorldModel
from accerl_lerobot.world_model.replayed import context_of
from accerl_lerobot.world_model.sizes import SeriousConfig, SmallConfig, TinyConfig
from accerl_lerobot.world_model.success import new_success_model, probabilities
from benchmarks.dream import BenchDreamConfig

SIZES = {TinyConfig: (64, 1.8), SmallConfig: (128, 19.2), SeriousConfig: (224, 84.7)}
"""Pixels, and millions of weights of a world of one camera, four numbers of state and four of action."""


def spec_of(config: WorldModelConfig) -> WorldModelSpec:
    return WorldModelSpec(
        cameras=("observation.images.corner2",), image_size=(config.image_size,) * 2, state_dim=4,
        action_dim=4, chunk=10, context=2, fps=80, provides=frozenset({"pixels", "state", "uncertainty"}),
    )  # fmt: skip


def told(*arguments: str) -> WorldModelConfig:
    config: WorldModelConfig = parse(WorldModelRun, list(arguments), recipe_class=RunConfig).world_model
    return config


@pytest.mark.parametrize("size", SIZES)
def test_each_is_as_large_as_it_says(size: type[WorldModelConfig]):
    config, (pixels, millions) = size(), SIZES[size]
    with torch.device("meta"):
        weights = sum(p.numel() for p in PixelWorldModel(spec_of(config), config.model).parameters())
    assert config.image_size == pixels and weights / 1e6 == pytest.approx(millions, rel=0.03)
    assert f"{pixels} pixels, {round(millions, 1 if millions < 2 else None)} million" in str(size.__doc__)


@pytest.mark.parametrize("size", SIZES)
def test_each_learns_and_dreams(size: type[WorldModelConfig]):
    config, rng = size(), np.random.default_rng(0)
    spec = spec_of(config)
    episode = Episode(
        frames=rng.integers(256, size=(3, 1, *spec.image_size, 3)).astype(np.uint8), times=np.arange(3) * 10,
        state=rng.standard_normal((3, 4)).astype(np.float32), task="go", source="demo", success_at=-1,
        actions=rng.standard_normal((20, 4)).astype(np.float32),
    )  # fmt: skip
    every = cut([episode], places([episode]), chunk=10, context=2, chunks=1)
    windows = every.rows([0])
    torch.manual_seed(0)
    learner = Learner(PixelWorldModel(spec, config.model), config.learn, seed=0)
    learner.model.fit_statistics(every)
    metrics = learner.step(windows)
    assert metrics["image"] > 0 and metrics["state"] > 0 and metrics["grad_norm"] > 0
    model = learner.serving.eval()
    dream = model.step(
        model.begin(context_of(windows), windows.task), torch.from_numpy(windows.actions[:, 0]), [0]
    )
    assert dream.frames.shape == (1, 1, *spec.image_size, 3) and dream.robot.shape == (1, 4)
    frames = dream.frames.numpy()
    assert 0 < probabilities(new_success_model(10).eval(), frames, frames)[0] < 1


def test_a_size_is_a_config_of_which_any_field_can_be_given():
    assert type(told()) is TinyConfig and told() == TinyConfig()
    small = told("--world_model.type=small", "--world_model.model.steps=3", "--world_model.learn.batch=8")
    assert type(small) is SmallConfig and small.image_size == 128
    assert small.model.steps == 3 and small.model.network == SmallConfig().model.network
    assert small.learn.batch == 8 and small.learn.lr == SmallConfig().learn.lr
    wide = told("--world_model.type=serious", "--world_model.model.network.planes=4").model.network
    assert wide.planes == 4 and wide.channels == (128, 256, 512, 512)
    assert parse(BenchDreamConfig, ["--world_model.type=small"]).world_model == SmallConfig()
    with pytest.raises(InputError, match="world_model.type='large': use one of serious, small, tiny"):
        told("--world_model.type=large")


def test_what_is_written_down_is_what_is_read_again():
    run = parse(WorldModelRun, ["--world_model.type=serious", "--world_model.model.steps=2"])
    written = json.loads(json.dumps(encode(run)))
    again = parse(WorldModelRun, [f"--world_model={json.dumps(written['world_model'])}"])
    assert again.world_model == run.world_model and written["world_model"]["type"] == "serious"


def test_help_shows_each_with_its_own_numbers():
    text = help_text("world-model", WorldModelRun, "learn", "all")
    tiny, small, serious = (text.index(f"world_model.type={name}") for name in ("tiny", "small", "serious"))
    for start, end, channels in ((tiny, small, "[64, 96]"), (small, serious, "[96, 192, 288]")):
        assert f"--world_model.model.network.channels={channels}" in text[start:end]
    assert "--world_model.image_size=224" in text[serious:]


@pytest.mark.parametrize(
    ("arguments", "multiple"),
    [((), 8), (("--world_model.type=small",), 16), (("--world_model.type=serious",), 32)],
)
def test_an_image_size_that_does_not_fit_is_refused(arguments: tuple[str, ...], multiple: int):
    with pytest.raises(InputError, match=f"world_model.image_size=100: use a multiple of {multiple}"):
        told(*arguments, "--world_model.image_size=100")
    size = 3 * multiple
    assert told(*arguments, f"--world_model.image_size={size}").image_size == size
