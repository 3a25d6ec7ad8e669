# SPDX-License-Identifier: Apache-2.0
"""``accerl offline``: recorded episodes in, a LeRobot checkpoint out."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets.dataset_tools import add_features, remove_feature
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from accerl_lerobot.algorithms import chunk_critic
from accerl_lerobot.cli import main
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.loading import load_adapter
from accerl_lerobot.world_model.latent import LatentModel
from tests.runs import records, replacing
from tests.tiny_datasets import record_dataset


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six successes and two failures."""
    root = tmp_path_factory.mktemp("recorded") / "dataset"
    record_dataset(root, SimulatedConfig(max_steps=16), episodes=8, failure_share=0.25)
    return root


def arguments(checkpoint: Path, root: Path, out: Path) -> list[str]:
    fields = {
        "policy.path": checkpoint,
        "policy.device": "cpu",
        "dataset.repo_id": "me/robot",
        "dataset.root": root,
        "output_dir": out,
        "trainer.updates": 30,
        "trainer.lr": 1e-3,
        "trainer.warmup_updates": 0,
        "trainer.value_warmup_updates": 0,
    }
    return ["offline", *(f"--{name}={value}" for name, value in fields.items())]


@pytest.mark.parametrize("algorithm", ["awr", "self_imitation"])
def test_the_checkpoint_does_more_of_what_succeeded(algorithm, tiny_checkpoint, recorded, tmp_path, capsys):
    out = tmp_path / "out"
    assert main([*arguments(tiny_checkpoint, recorded, out), f"--algorithm.type={algorithm}"]) == 0
    told, said = capsys.readouterr()
    summary = json.loads(told)
    assert summary == json.loads((out / "summary.json").read_text())
    assert (summary["episodes"], summary["successes"], summary["updates"]) == (8, 6, 30)
    before, after = (summary["imitation_loss"][when] for when in ("before", "after"))
    assert after["successes"] < 0.8 * before["successes"]
    assert after["successes"] - before["successes"] < after["failures"] - before["failures"]
    assert [record["kind"] for record in records(out)] == ["train"] * 2
    last = out / "checkpoints" / "last" / "pretrained_model"
    assert summary["policy"] == str(last) and f"policy {last}\n" in said
    assert "; 8 episodes; " in said and "imitation loss of successes " in said, said
    assert main(["report", str(out)]) == 0 and "imitation loss" in (out / "report.html").read_text()
    load_adapter(PolicyConfig(path=str(last), device="cpu"))  # as LeRobot's own sampler acts


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (["--algorithm.type=gipo"], "algorithm.type='gipo': .*use awr, self_imitation or chunk_critic"),
        (
            ["--algorithm.type=chunk_critic", "--world_model.type=simulator"],
            "world_model.type='simulator': the dataset has no observation.environment_state; use latent",
        ),
        (["--policy.path=null"], "policy.path=None: give a LeRobot checkpoint"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_a_mistake_is_one_line_and_leaves_no_folder(
    wrong, message, tiny_checkpoint, recorded, tmp_path, capsys
):
    assert main(replacing(arguments(tiny_checkpoint, recorded, tmp_path / "out"), *wrong)) == 2
    assert not (tmp_path / "out").exists()
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert re.search(message, error), error


def test_episodes_without_labels_are_refused(tiny_checkpoint, recorded, tmp_path, capsys):
    data = LeRobotDataset("me/robot", root=recorded)
    remove_feature(data, ["next.success", "next.reward"], output_dir=tmp_path / "bare", repo_id="me/robot")
    assert main(arguments(tiny_checkpoint, tmp_path / "bare", tmp_path / "out")) == 2
    assert "labelled neither by next.success nor next.reward" in capsys.readouterr().err


@pytest.mark.parametrize(("algorithm", "code"), [("awr", 0), ("self_imitation", 2)])
def test_graded_rewards_without_a_success_are_enough_for_awr(
    algorithm, code, tiny_checkpoint, recorded, tmp_path, capsys
):
    data = LeRobotDataset("me/robot", root=recorded)
    bare = remove_feature(
        data, ["next.success", "next.reward"], output_dir=tmp_path / "bare", repo_id="me/robot"
    )
    costs = np.array([[-float(i)] for i in bare.hf_dataset.with_format("numpy")["episode_index"]], np.float32)
    feature = {"dtype": "float32", "shape": (1,), "names": None}
    add_features(bare, {"next.reward": (costs, feature)}, output_dir=tmp_path / "graded", repo_id="me/robot")
    run = arguments(tiny_checkpoint, tmp_path / "graded", tmp_path / "out")
    assert main([*run, f"--algorithm.type={algorithm}"]) == code
    out, err = capsys.readouterr()
    assert json.loads(out)["successes"] == 0 if code == 0 else "none of its episodes is a success" in err


@pytest.mark.parametrize("model", ["simulator", "latent"])
def test_the_chunk_critic_learns_from_recorded_episodes(
    model, tiny_checkpoint, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(LatentModel, "first_steps", 10)
    monkeypatch.setattr(chunk_critic, "FIRST_STEPS", 50)
    root = tmp_path / "recorded"
    environment = SimulatedConfig(max_steps=16, environment_state=model == "simulator")
    record_dataset(root, environment, episodes=8, failure_share=0.25)
    out = tmp_path / "out"
    given = arguments(tiny_checkpoint, root, out)
    run = replacing(given, "--trainer.updates=15", "--algorithm.type=chunk_critic")
    if model == "latent":
        assert main(run) == 2
        why = "are followed by another one in their episode, and the world model learns from 100 or more"
        assert why in capsys.readouterr().err and not out.exists()
    monkeypatch.setattr(chunk_critic, "LEAST_TRANSITIONS", 8)
    assert main(run) == 0  # the state is the simulator's where the dataset has it
    summary = json.loads(capsys.readouterr().out)
    before, after = (summary["imitation_loss"][when]["successes"] for when in ("before", "after"))
    assert after < 0.9 * before
    found = records(out)
    assert all("explained_variance" in record for record in found)
    assert ("world_model_contrast" in found[-1]) == (model == "latent")
    load_adapter(PolicyConfig(path=summary["policy"], device="cpu"))
