# SPDX-License-Identifier: Apache-2.0
"""``accerl offline``: recorded episodes in, a LeRobot checkpoint out."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from accerl_lerobot.algorithms import chunk_critic
from accerl_lerobot.cli import main
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.loading import load_adapter
from accerl_lerobot.world_model.latent import LatentModel
from tests.runs import records, replacing
from tests.tiny_datasets import FRONT, IMAGE, labels, record_dataset, write_dataset

ENV = SimulatedConfig(max_steps=16)
CRITIC = "--algorithm.type=chunk_critic"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six successes and two failures."""
    root = tmp_path_factory.mktemp("recorded") / "dataset"
    record_dataset(root, ENV, episodes=8, failure_share=0.25)
    return root


def arguments(checkpoint: Path, root: Path, out: Path) -> list[str]:
    return [
        "offline", f"--policy.path={checkpoint}", "--policy.device=cpu", "--dataset.repo_id=me/robot",
        f"--dataset.root={root}", f"--output_dir={out}", "--trainer.updates=30", "--trainer.lr=1e-3",
        "--trainer.warmup_updates=0", "--trainer.value_warmup_updates=0",
    ]  # fmt: skip


@pytest.mark.parametrize("algorithm", ["awr", "self_imitation"])
def test_the_checkpoint_does_more_of_what_succeeded(algorithm, tiny_checkpoint, recorded, tmp_path, capsys):
    out = tmp_path / "out"
    assert main([*arguments(tiny_checkpoint, recorded, out), f"--algorithm.type={algorithm}"]) == 0
    told, said = capsys.readouterr()
    summary = json.loads((out / "summary.json").read_text())
    assert summary == json.loads(told)
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
        ([CRITIC, "--world_model.type=simulator"], "no observation.environment_state; use latent"),
        (["--policy.path=null"], "policy.path=None: give a LeRobot checkpoint"),
    ],
)
def test_a_mistake_leaves_no_folder(wrong, message, tiny_checkpoint, recorded, tmp_path, capsys):
    assert main(replacing(arguments(tiny_checkpoint, recorded, tmp_path / "out"), *wrong)) == 2
    assert not (tmp_path / "out").exists()
    assert re.search(message, capsys.readouterr().err)


def test_graded_rewards_without_a_success_are_enough_for_awr(tiny_checkpoint, tmp_path, capsys):
    def cost(name: str, episode: int, step: int) -> list[int] | None:
        return [-episode] if name == "next.reward" else None

    for root, more in ((tmp_path / "bare", {}), (tmp_path / "graded", {"next.reward": labels("float32")})):
        write_dataset(root, more={FRONT: IMAGE, **more}, values=cost)
    graded = arguments(tiny_checkpoint, tmp_path / "graded", tmp_path / "out")
    assert main([*graded, "--algorithm.type=self_imitation"]) == 2
    assert "none of its episodes is a success" in capsys.readouterr().err
    assert main([*graded, "--algorithm.type=awr"]) == 0
    assert json.loads(capsys.readouterr().out)["successes"] == 0
    assert main(arguments(tiny_checkpoint, tmp_path / "bare", tmp_path / "other")) == 2
    assert "labelled neither by next.success nor next.reward" in capsys.readouterr().err


@pytest.mark.parametrize("model", ["simulator", "latent"])
def test_the_chunk_critic_learns(model, tiny_checkpoint, recorded, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(LatentModel, "first_steps", 10)
    monkeypatch.setattr(chunk_critic, "FIRST_STEPS", 50)
    if model == "simulator":
        recorded = tmp_path / "recorded"
        record_dataset(recorded, replace(ENV, environment_state=True), episodes=8, failure_share=0.25)
    out = tmp_path / "out"
    run = replacing(arguments(tiny_checkpoint, recorded, out), "--trainer.updates=15", CRITIC)
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
