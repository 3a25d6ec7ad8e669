# SPDX-License-Identifier: Apache-2.0
"""LeRobot reward models in place of the success model, saved as LeRobot saves them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.rewards.classifier.configuration_classifier import RewardClassifierConfig
from lerobot.rewards.classifier.modeling_classifier import Classifier
from lerobot.rewards.factory import make_reward_pre_post_processors
from safetensors.torch import save_file
from transformers import ResNetConfig, ResNetModel

from accerl_lerobot import cli
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.config import (
    ExternalRewardModelConfig,
    ImaginationConfig,
    OnlineLearnConfig,
    ValidationConfig,
)
from accerl_lerobot.world_model.imagination.registry import make_models
from accerl_lerobot.world_model.learning.learners import new_success_model
from accerl_lerobot.world_model.model.external_reward_model import load_external_reward_model, probabilities
from accerl_lerobot.world_model.model.pixels import PixelWorldModel
from accerl_lerobot.world_model.model.store import save_world_model
from accerl_lerobot.world_model.validation.validate import validate
from tests.rounding import assert_close
from tests.world_model.test_evaluate import CONFIG as WORLD_MODEL
from tests.world_model.test_evaluate import ENV, folders, told, world_spec
from tests.world_model.test_pixels import SIZE, SPEC, K
from tests.world_model.test_validate import Deterministic, dots, with_successes
from tests.world_model.tiny_reward import TinyBrightnessConfig
from tests.world_model.tiny_reward.modeling_tiny_brightness import TinyBrightnessRewardModel

__all__ = ["folders"]
CAMERA = SPEC.cameras[0]
FRAMES = np.random.default_rng(0).integers(256, size=(2, 5, 1, SIZE, SIZE, 3)).astype(np.uint8)


def image(side: int = SIZE) -> PolicyFeature:
    return PolicyFeature(type=FeatureType.VISUAL, shape=(3, side, side))


def saved(
    folder: Path, inputs: dict[str, PolicyFeature] | None = None, **config: Any
) -> ExternalRewardModelConfig:
    made = TinyBrightnessConfig(
        input_features={CAMERA: image()} if inputs is None else inputs, device="cpu", **config
    )
    model = TinyBrightnessRewardModel(made)
    with torch.no_grad():
        model.weight.fill_(0.5)
    model.save_pretrained(folder)
    return ExternalRewardModelConfig(path=str(folder))


def test_one_that_sees_a_frame_and_one_that_sees_two(tmp_path: Path):
    last = FRAMES[1].mean((1, 2, 3, 4)) / 255
    alone = load_external_reward_model(saved(tmp_path / "one"), SPEC, "success")
    assert_close(probabilities(alone, *FRAMES), 0.5 * last)
    both = load_external_reward_model(saved(tmp_path / "two", frames=2, chunk=K), SPEC, "success")
    change = last - FRAMES[0].mean((1, 2, 3, 4)) / 255
    assert_close(probabilities(both, *FRAMES), 0.5 * (0.5 + change))
    assert not any(p.requires_grad for p in both.parameters()) and not both.training


def test_frames_get_the_size_that_it_wants(tmp_path: Path):
    made = load_external_reward_model(saved(tmp_path / "one", {CAMERA: image(32)}), SPEC, "success")
    seen: list[torch.Size] = []
    inner = made.preprocess
    made.preprocess = lambda batch: seen.append(batch[CAMERA].shape) or inner(batch)
    white = np.full_like(FRAMES, 255)
    assert probabilities(made, *white) == pytest.approx(0.5, rel=1e-4) and seen == [(5, 3, 32, 32)]


def test_our_own_success_model_can_be_loaded_as_one(tmp_path: Path):
    torch.manual_seed(0)
    own = new_success_model(K).eval()
    own.save_pretrained(tmp_path / "own")
    made = load_external_reward_model(ExternalRewardModelConfig(path=str(tmp_path / "own")), SPEC, "success")
    assert_close(probabilities(made, *FRAMES), probabilities(own, *FRAMES))
    with pytest.raises(InputError, match="a chunk has two, 3 steps apart"):
        load_external_reward_model(
            ExternalRewardModelConfig(path=str(tmp_path / "own")), replace(SPEC, chunk=3), "success"
        )


def test_lerobot_s_classifier(tmp_path: Path):
    """With the statistics that its own preprocessor was saved with, and a probability, not its verdict."""
    torch.manual_seed(0)
    backbone = ResNetConfig(embedding_size=8, hidden_sizes=[8, 8, 8], depths=[1, 1, 1], layer_type="basic")
    ResNetModel(backbone).save_pretrained(tmp_path / "backbone")
    config = RewardClassifierConfig(
        input_features={CAMERA: image(64)}, num_cameras=1, model_name=str(tmp_path / "backbone"),
        hidden_dim=8, latent_dim=8, device="cpu",
    )  # fmt: skip
    model = Classifier(config).eval()
    stats = {CAMERA: {"mean": torch.full((3, 1, 1), 0.4), "std": torch.full((3, 1, 1), 0.2)}}
    model.save_pretrained(tmp_path / "classifier")
    here = ExternalRewardModelConfig(path=str(tmp_path / "classifier"))
    with pytest.raises(InputError, match=r"0 there, and lerobot-train saves one"):
        load_external_reward_model(here, SPEC, "success")
    preprocessor, _ = make_reward_pre_post_processors(config, dataset_stats=stats)
    preprocessor.save_pretrained(tmp_path / "classifier")
    made = load_external_reward_model(here, SPEC, "success")
    grey = np.full_like(FRAMES, 102)
    shown = torch.zeros(5, 3, 64, 64)  # (102 / 255 − 0.4) / 0.2
    with torch.no_grad():
        expected = model.predict([shown]).probabilities.numpy()
    assert_close(probabilities(made, *grey), expected)
    assert 0 < expected[0] < 1 and expected[0] != 0.5


@pytest.mark.parametrize(
    ("inputs", "config", "why"),
    [
        (
            {"observation.images.wrist": image()},
            {},
            "this camera, and the world model has observation.images.top",
        ),
        (
            {CAMERA: image(), "observation.state": PolicyFeature(type=FeatureType.STATE, shape=(2,))},
            {},
            "input_features.observation.state: it reads this, and only the frames",
        ),
        (None, {"frames": 8}, r"it reads frames \[0, 2, 4, 6, 8, 10, 12, 14\]"),
        (None, {"frames": 2, "chunk": 5}, "a chunk has two, 2 steps apart"),
        (None, {"scale": 9.0}, r"its answer to 2 frames is \[2.25, 2.25\]"),
        ({CAMERA: image(), "observation.image": image()}, {}, "this camera, and the world model has"),
    ],
)
def test_a_reward_model_that_reads_more_is_refused(
    inputs: dict[str, PolicyFeature] | None, config: dict[str, Any], why: str, tmp_path: Path
):
    given = saved(tmp_path / "model", inputs, **config)
    with pytest.raises(InputError, match=f"^success.path=.*{why}"):
        load_external_reward_model(given, SPEC, "success")


@pytest.mark.parametrize("kind", ["sarm", "robometer", "topreward"])
def test_models_of_language_are_refused_by_what_they_read(kind: str, tmp_path: Path):
    (tmp_path / "config.json").write_text(json.dumps({"type": kind, "device": "cpu"}))
    with pytest.raises(InputError, match="config.json: (task_key|input_features|not one of this)"):
        load_external_reward_model(ExternalRewardModelConfig(path=str(tmp_path)), SPEC, "success")


@pytest.mark.parametrize(
    ("harm", "why"),
    [
        ("type", "'unheard_of'; use one of .*tiny_brightness.*or name its package"),
        ("weights", "model.safetensors: is missing"),
        ("elsewhere", "config.json: model_name: 'a b' is neither a Hub id nor an absolute path"),
        ("fewer", "they are not those of its config: weight is in one of them only"),
        ("pickle", "a pickle"),
        ("package", "success.discover_packages_path='no.such.package': cannot be imported"),
        ("gone", "config.json: is missing"),
    ],
)
def test_what_cannot_be_loaded(harm: str, why: str, tmp_path: Path):
    folder = tmp_path / "model"
    given = saved(folder)
    if harm == "type":
        (folder / "config.json").write_text(json.dumps({"type": "unheard_of"}))
    if harm == "elsewhere":
        (folder / "config.json").write_text(json.dumps({"type": "reward_classifier", "model_name": "a b"}))
    if harm in ("weights", "pickle"):
        (folder / "model.safetensors").unlink()
    if harm == "pickle":
        (folder / "pytorch_model.bin").write_bytes(b"")
    if harm == "fewer":
        save_file({"other": torch.ones(1)}, folder / "model.safetensors")
    if harm == "package":
        given = replace(given, discover_packages_path="no.such.package")
    if harm == "gone":
        given = ExternalRewardModelConfig(path=str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match=why):
        load_external_reward_model(given, SPEC, "success")


def test_its_threshold_is_set_as_that_of_our_own(tmp_path: Path):
    """Bright where the dot is large is of no use here; what counts is that the threshold fits its scores."""
    made = load_external_reward_model(saved(tmp_path / "model"), SPEC, "success")
    episodes = with_successes(dots(40, seed=1))
    trial = ValidationConfig(depth=2, stride=2)
    found = validate(Deterministic("exact"), episodes, trial, made, fresh=True)
    assert found["threshold"] == made.config.threshold >= 0.5
    made.config.threshold = 0.0
    assert validate(Deterministic("exact"), episodes, trial, made)["outcomes"]["false_success"] == 1


def test_it_is_named_on_the_command_line(
    folders: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    camera = world_spec(WORLD_MODEL, ENV).cameras[0]
    given = saved(tmp_path / "model", {camera: image()})
    package = "--success.discover_packages_path=tests.world_model.tiny_reward"
    cli.main(told(folders, tmp_path / "out", f"--success.path={given.path}", package))
    found = json.loads(capsys.readouterr().out)
    assert found["threshold"] >= 0.5 and "auroc" in found["outcomes"]
    more = [f"--success.path={given.path}", "--success.threshold=0.125"]
    cli.main(told(folders, tmp_path / "given", *more))
    assert json.loads(capsys.readouterr().out)["threshold"] == 0.125
    assert cli.main(told(folders, tmp_path / "third", "--success.threshold=0.5")) == 2
    assert "success.threshold=0.5: it belongs to the model in success.path" in capsys.readouterr().err


def test_a_run_uses_it(tmp_path: Path):
    spec = world_spec(WORLD_MODEL, ENV)
    save_world_model(tmp_path / "world", PixelWorldModel(spec, WORLD_MODEL.model))
    given = replace(saved(tmp_path / "model", {spec.cameras[0]: image()}), threshold=0.3)
    frozen = OnlineLearnConfig(steps_per_episode=0)
    config = ImaginationConfig(share=0.5, path=str(tmp_path / "world"), success=given, learn=frozen)
    models = make_models(config, ENV, None, 5, "cpu")  # type: ignore[arg-type]  # only an oracle asks
    assert models.success is not None and models.success.config.threshold == 0.3
    with pytest.raises(InputError, match=r"^imagination.success.threshold=None: say what counts"):
        replace(config, success=replace(given, threshold=None))
    with pytest.raises(InputError, match="steps_per_episode=5.0: use 0 with imagination.success.path"):
        replace(config, learn=OnlineLearnConfig())
    with pytest.raises(InputError, match="the oracle knows"):
        replace(config, model="oracle")
    with pytest.raises(InputError, match=r"^imagination.threshold=0.9: with an external reward model"):
        replace(config, threshold=0.9)


def test_a_run_may_name_the_threshold_of_the_success_model(tmp_path: Path):
    spec = world_spec(WORLD_MODEL, ENV)
    success = new_success_model(5)
    save_world_model(tmp_path / "world", PixelWorldModel(spec, WORLD_MODEL.model), success)
    config = ImaginationConfig(share=0.5, path=str(tmp_path / "world"))
    for threshold, expected in ((None, success.config.threshold), (0.97, 0.97)):
        chosen = replace(config, threshold=threshold)
        models = make_models(chosen, ENV, None, 5, "cpu")  # type: ignore[arg-type]
        assert models.success is not None and models.success.config.threshold == expected
    with pytest.raises(InputError, match=r"^imagination.threshold=1.5: use a number from 0 to 1"):
        replace(config, threshold=1.5)
