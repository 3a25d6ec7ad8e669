# SPDX-License-Identifier: Apache-2.0
"""LeRobot's reward models telling success in place of the environment."""

import json
import shutil
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.rewards import RewardClassifierConfig, make_reward_pre_post_processors
from lerobot.rewards.classifier.modeling_classifier import Classifier
from transformers import ResNetConfig, ResNetModel

from accerl_lerobot.envs import RewardModelConfig, SimulatedConfig, load_judge, make_environment
from accerl_lerobot.errors import InputError
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.run.preflight import check_environment, check_start
from tests.policies.checkpoints import edit_config, write_smolvla
from tests.runs import collect, local_engine, tiny_run

CAMERA = "observation.images.front"
ENV = SimulatedConfig(image_size=128, max_steps=16)
MEAN, STD = 0.25, 0.5


@pytest.fixture(scope="module")
def encoder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network with the shape that LeRobot's classifier expects of its ResNet."""
    folder = tmp_path_factory.mktemp("encoder")
    sizes = {"embedding_size": 4, "hidden_sizes": [4, 4, 4, 8], "depths": [1] * 4, "layer_type": "basic"}
    torch.manual_seed(0)
    ResNetModel(ResNetConfig(**sizes)).save_pretrained(folder)
    return folder


def write_classifier(folder: Path, encoder: Path, bias: float = 0.0) -> Classifier:
    """A random classifier, as ``lerobot-train`` saves one; `bias` of its logit."""
    torch.manual_seed(0)
    image = {CAMERA: PolicyFeature(FeatureType.VISUAL, (3, 128, 128))}
    config = RewardClassifierConfig(input_features=image, model_name=str(encoder), num_cameras=1)
    model = Classifier(config).eval()
    with torch.no_grad():
        model.classifier_head[-1].bias.add_(bias)
    model.save_pretrained(folder)
    stats = {CAMERA: {"mean": torch.full((3, 1, 1), MEAN), "std": torch.full((3, 1, 1), STD)}}
    for processor in make_reward_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(folder)
    return model


def test_it_is_asked_for_the_probability_that_lerobot_computes(encoder: Path, tmp_path: Path):
    model = write_classifier(tmp_path, encoder)
    environment = make_environment(ENV)
    for seed in range(3):
        observation = environment.reset(seed, "match")
        image = torch.from_numpy(np.asarray(observation[CAMERA]))[None].permute(0, 3, 1, 2) / 255
        p = model.predict([(image - MEAN) / STD]).probabilities.item()
        for threshold, expected in ((p - 1e-4, True), (p + 1e-4, False)):
            judge = load_judge(RewardModelConfig(path=str(tmp_path), threshold=threshold))
            assert judge(observation) is expected


def solved(environment: Any) -> list[Any]:
    """Chunks that solve the task, until the episode ends."""
    target = environment.reset(0, "match")["observation.state"].flat[:2]
    results = []
    while not results or not results[-1].done:
        results.append(environment.step_chunk(np.tile(target, (2, 1))))
    return results


def test_episodes_succeed_and_end_as_it_says(encoder: Path, tmp_path: Path):
    write_classifier(tmp_path / "always", encoder, bias=9.0)
    write_classifier(tmp_path / "never", encoder, bias=-9.0)
    always, never = (RewardModelConfig(path=str(tmp_path / name)) for name in ("always", "never"))
    (only,) = solved(make_environment(ENV, 2, always))  # asked once, about the newest
    assert only.success and only.terminated and not only.truncated and only.rewards.tolist() == [0.0, 1.0]
    *_, last = solved(make_environment(ENV, reward_model=never))
    assert last.terminated and not last.success and last.rewards.sum() == 0  # the environment itself ends it
    results = solved(make_environment(replace(ENV, reward="dense"), reward_model=never))
    assert sum(r.steps for r in results) == ENV.max_steps and results[-1].truncated


def test_a_run_learns_from_what_it_says(encoder: Path, tmp_path: Path):
    write_classifier(tmp_path / "always", encoder, 9.0)
    checkpoint = write_smolvla(tmp_path / "policy", image=128)
    model = RewardModelConfig(path=str(tmp_path / "always"))
    rollout = RolloutConfig(environments=2, segment_length=3, reward_model=model)
    config = tiny_run(checkpoint, env=ENV, rollout=rollout)
    check_start(config)
    with closing(local_engine(config)) as engine:
        engine.train()
        results = collect(engine, "train", 4)
    assert all(result.success and result.decisions == 1 for result in results)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: shutil.rmtree(path), r"^rollout\.reward_model\.path=.*no config\.json there"),
        (lambda path: None, r"front is \(3, 128, 128\), the environment's \(3, 32, 32\)"),
        (lambda path: (path / "classifier_preprocessor.json").unlink(), "it cannot be loaded as one of"),
        (lambda path: edit_config(path, type="sarm"), "it cannot be loaded|looks at several observations"),
    ],
)
def test_what_cannot_judge_is_refused_in_one_line(encoder: Path, tmp_path: Path, damage: Any, message: str):
    write_classifier(tmp_path / "model", encoder)
    damage(tmp_path / "model")
    with pytest.raises(InputError, match=message):
        check_environment(SimulatedConfig(), RewardModelConfig(path=str(tmp_path / "model")))


def test_no_code_of_an_encoder_runs_unasked(encoder: Path, tmp_path: Path):
    write_classifier(tmp_path / "classifier", encoder)
    hostile = tmp_path / "hostile"
    hostile.mkdir()
    marker = tmp_path / "ran"
    (hostile / "code.py").write_text(f"open({str(marker)!r}, 'w')\n")
    mapping = {"AutoConfig": "code.Config", "AutoModel": "code.Model"}
    (hostile / "config.json").write_text(json.dumps({"model_type": "odd", "auto_map": mapping}))
    edit_config(tmp_path / "classifier", model_name=str(hostile))
    with pytest.raises(InputError, match=r"^rollout\.reward_model\.trust_remote_code=.*code that came with"):
        load_judge(RewardModelConfig(path=str(tmp_path / "classifier")))
    assert not marker.exists()
