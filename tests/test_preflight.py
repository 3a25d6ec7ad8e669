# SPDX-License-Identifier: Apache-2.0
"""A run whose parts do not fit, or that lacks something here, is refused in one line before any work."""

import contextlib
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import wandb

from accerl_lerobot import cli
from accerl_lerobot.algorithms import AWRConfig
from accerl_lerobot.demos.sft import SFTConfig
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.envs import LiberoConfig, SimulatedConfig, make_environment
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation import EvaluationConfig
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.features import check_actions, check_features, env_features, fine_tuned_features
from accerl_lerobot.run.preflight import (
    check_device,
    check_evaluation,
    check_imitates,
    check_sft_policy,
    check_training_data,
)
from tests.policies.checkpoints import write_act
from tests.tiny_datasets import FRONT, IMAGE, STATE, write_dataset

ROOT = Path(__file__).parents[1]
TINY = ["--dataset.repo_id=accerl/metaworld_tiny", f"--dataset.root={ROOT / 'datasets' / 'metaworld_tiny'}"]
ACT = "--sft.policy={type: act, chunk_size: 4, n_action_steps: 4, pretrained_backbone_weights: null}"
SIMULATED = ["--env.type=simulated"]
SPEC = make_environment(SimulatedConfig()).spec
OFFERED = env_features(SPEC)
TOP = "observation.images.top"
IMAGES = {FRONT: (3, 32, 32), STATE: (4,), "action": (2,)}


@pytest.mark.parametrize(
    ("change", "rename_map"),
    [
        ({}, {}),
        ({"shapes": {FRONT: (3, 32, 32), "action": (2,)}}, {}),
        ({"shapes": IMAGES | {FRONT: (3, 64, 48)}, "any_size": True}, {}),
        ({"shapes": {TOP: (3, 32, 32), STATE: (4,), "action": (2,)}}, {FRONT: TOP}),
        ({"tasks": ("another", *OFFERED.tasks), "fps": float(OFFERED.fps or 0)}, {}),
        ({"fps": 5.0}, {}),  # a rate that its datasets are known to name
    ],
)
def test_what_fits_an_environment(change: dict[str, Any], rename_map: dict[str, str]):
    assert OFFERED.shapes == IMAGES
    offered = replace(OFFERED, labelled_fps=(5,))
    check_features(replace(OFFERED, **change), offered, rename_map, "policy.path", "x")


@pytest.mark.parametrize(
    ("change", "rename_map", "message"),
    [
        ({"fps": 6.0}, {}, "recorded at 6 Hz, but the environment runs at"),
        ({"tasks": ("Dance",)}, {}, "no episode of 'Match the target', the environment's .* it has 'Dance'"),
        ({"shapes": IMAGES | {TOP: (3, 32, 32)}}, {}, f"no {TOP} .* offers {FRONT}, {STATE}; choose"),
        ({"shapes": IMAGES | {FRONT: (3, 64, 64)}}, {}, rf"its {FRONT} is \(3, 64, 64\), but \(3, 32, 32\)"),
        ({"shapes": IMAGES | {STATE: (6,)}}, {}, rf"^policy.path='x': its {STATE} is \(6,\), but \(4,\) in"),
        ({}, {"a": FRONT}, f"^policy.rename_map='a': the environment has no such feature; it offers {FRONT}"),
        ({}, {FRONT: STATE}, "two features of the environment would be observation.state"),
    ],
)
def test_what_does_not_fit_an_environment(change: dict[str, Any], rename_map: dict[str, str], message: str):
    with pytest.raises(InputError, match=message):
        check_features(replace(OFFERED, **change), OFFERED, rename_map, "policy.path", "x")


def test_a_policy_that_pads_takes_the_states_and_cameras_that_it_is_fine_tuned_on():
    kinds = {FRONT: "VISUAL", TOP: "VISUAL", STATE: "STATE", "action": "ACTION"}
    shapes = {FRONT: (3, 8, 8), TOP: (3, 8, 8), STATE: (6,), "action": (6,)}
    features = {k: SimpleNamespace(type=SimpleNamespace(name=kinds[k]), shape=shapes[k]) for k in kinds}
    base = SimpleNamespace(input_features=features, output_features={}, max_state_dim=8, empty_cameras=0)
    assert fine_tuned_features(base, OFFERED).shapes == OFFERED.shapes
    two = replace(OFFERED, shapes=IMAGES | {"observation.images.wrist": (3, 32, 32)})
    assert fine_tuned_features(base, two).shapes == shapes  # neither has all of the other's cameras
    del base.empty_cameras
    assert fine_tuned_features(base, OFFERED).shapes == shapes


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line that a command writes before it ends with code 2."""
    assert cli.main(list(arguments)) == 2
    out, err = capsys.readouterr()
    *_, line = err.splitlines()
    assert not out and err.count("accerl: ") == 1 and "Traceback" not in err and line.startswith("accerl: ")
    return line


@pytest.mark.parametrize("verb", ["train", "eval"])
def test_checkpoints_of_another_image_size(verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path, out = write_act(tmp_path / "policy", image=48), tmp_path / "out"
    told = [*SIMULATED, f"--policy.path={path}", "--launch.engine=local", f"--output_dir={out}"]
    line = refused(capsys, verb, *told)
    assert f"its {FRONT} is (3, 48, 48), but (3, 32, 32) in" in line and not out.exists()


@pytest.mark.parametrize("verb", ["train", "sft"])
def test_a_dataset_of_another_environment(verb: str, tmp_path: Path, capsys):
    out = tmp_path / "out"
    line = refused(capsys, verb, "--sft.steps=1", ACT, f"--output_dir={out}", *SIMULATED, *TINY)
    assert "no observation.images.corner2 in the environment, which offers " + FRONT in line
    assert not out.exists()


def test_tasks_that_would_be_left_out(tmp_path: Path, capsys, caplog):
    both, out = ["--env.type=simulated", "--env.task=match,mirror"], tmp_path / "out"
    line = refused(capsys, "demos", *both, "--demos.episodes=1", f"--root={out}")
    assert line == "accerl: demos.episodes=1: env has 2 tasks; use 2 or more" and not out.exists()
    spec = replace(SPEC, tasks=("a", "b", "c"))
    evaluation = EvaluationConfig(episodes=200, every_updates=5, episodes_during=2)
    check_evaluation(evaluation, LiberoConfig(), spec)
    assert "evaluation.episodes_during=2: the last 1 of 3 tasks are left out" in caplog.text
    assert "evaluation.episodes=200: each task has 50 starts" in caplog.text
    caplog.clear()
    check_evaluation(replace(evaluation, episodes=150, episodes_during=3), LiberoConfig(), spec)
    check_evaluation(replace(evaluation, episodes_during=3), SimulatedConfig(), spec)
    assert not caplog.records


QUICK = ["train", str(ROOT / "recipes" / "quickstart.yaml")]
NO_GPU = "no CUDA device here; use cpu or auto"


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ([*QUICK, "--policy.device=cuda"], f"policy.device='cuda': {NO_GPU}"),
        (["sft", *TINY, "--sft.steps=1", "--device=cuda"], f"device='cuda': {NO_GPU}"),
        ([*QUICK, "--wandb.enable=true"], "wandb.enable=True: this machine is not logged in"),
        (QUICK, "output_dir='{out}': "),
        (["demos", f"--config_path={QUICK[1]}"], "root='{out}': "),
    ],
)
def test_what_the_machine_lacks(arguments: list[str], line: str, tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(type(wandb.api), "api_key", None)
    monkeypatch.delenv("WANDB_MODE", raising=False)
    if "output_dir" in line or "root" in line:
        pytest.importorskip("metaworld")
        monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=10 * 2**20))
    out = tmp_path / "out"
    where = f"--{'root' if arguments[0] == 'demos' else 'output_dir'}={out}"
    assert refused(capsys, *arguments, where).startswith("accerl: " + line.replace("{out}", str(out)))
    assert not out.exists()


def test_a_second_gpu_is_no_device_of_ray_s_workers(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    config = RunConfig(policy=PolicyConfig(path="x", device="cuda:1"))
    with pytest.raises(InputError, match=r"^policy\.device='cuda:1': Ray shows each worker its own GPU only"):
        check_device(config)


def test_a_simulator_that_is_not_installed(tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch):
    for name in [n for n in sys.modules if n.partition(".")[0] == "metaworld"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "metaworld", None)  # an import of it fails, as if it was not there
    out = tmp_path / "out"
    given = ["train", "--env.type=metaworld", "--sft.steps=1", ACT, f"--output_dir={out}"]
    assert "env.type='metaworld': the package metaworld is not installed; pip" in refused(capsys, *given)
    assert not out.exists()


def test_an_off_policy_algorithm_needs_a_policy_that_imitates_a_chunk():
    act = SimpleNamespace(type="act", use_relative_actions=False)
    check_imitates(AWRConfig(), PolicyConfig(path="x"), act)
    act.use_relative_actions = True
    with pytest.raises(InputError, match=r"^policy\.use_relative_actions=True: algorithm\.type=awr keeps"):
        check_imitates(AWRConfig(), PolicyConfig(path="x"), act)
    with pytest.raises(InputError, match=r"^policy\.sampler\.type='tokens': .*use chunk_noise, flow or"):
        check_imitates(AWRConfig(), PolicyConfig(path="x"), SimpleNamespace(type="pi0_fast"))


def test_actions_in_another_unit_than_the_environment_s(caplog: pytest.LogCaptureFixture):
    actions = np.array([[0.5, 0.5], [1.001, -1.0]] * 20, np.float32)
    check_actions(actions, SPEC, "dataset.repo_id", "x")
    assert not caplog.text
    check_actions(actions * [1, 90], SPEC, "dataset.repo_id", "x")
    assert "100% of its actions lie outside" in caplog.text
    assert "number 1 is from -90 to 45 in the dataset, and -1 to 1 in the environment" in caplog.text


SMALL_ACT = {
    "type": "act", "chunk_size": 4, "n_action_steps": 4, "pretrained_backbone_weights": None,
    "dim_model": 8, "n_heads": 1, "n_encoder_layers": 1, "dim_feedforward": 8,
}  # fmt: skip
VECTOR = {"dtype": "float32", "shape": (2,), "names": None}
READ = {FRONT: {"type": "VISUAL", "shape": [3, 32, 32]}, STATE: {"type": "STATE", "shape": [4]}}


PADDED = {"type": "smolvla", "max_state_dim": 4, "max_action_dim": 2}


@pytest.mark.parametrize(
    ("features", "without", "policy", "why"),
    [
        ({}, "", PADDED, None),
        ({}, "", PADDED | {"max_state_dim": 3}, f"sft.policy.max_state_dim=3: {STATE} has 4 numbers; use 4"),
        ({}, "", PADDED | {"max_action_dim": 1}, "sft.policy.max_action_dim=1: action has 2 numbers; use 2"),
        ({f"{STATE}.joints": VECTOR}, STATE, SMALL_ACT, r"it is in parts \(observation.state.joints\)"),
        ({"action.pose": VECTOR}, "action", SMALL_ACT, r"no action for a .* parts \(action.pose\); join"),
        ({}, "action", SMALL_ACT, "no action, so that there is nothing to imitate"),
        ({TOP: IMAGE}, "", SMALL_ACT, "no observation.images.top in the env.*name fewer in"),
        ({TOP: IMAGE}, "", SMALL_ACT | {"input_features": READ}, None),
    ],
)
def test_what_a_policy_reads_of_a_dataset_is_looked_at_before_any_work(
    features: dict[str, Any], without: str, policy: dict[str, Any], why: str | None, tmp_path: Path
):
    dataset = write_dataset(tmp_path / "data", more={FRONT: IMAGE, **features}, without=[without])
    sft = SFTConfig(steps=1, policy=policy)
    refusal = contextlib.nullcontext() if why is None else pytest.raises(InputError, match=why)
    with refusal:
        check_training_data(sft, dataset, check_sft_policy(sft), SPEC, {})
