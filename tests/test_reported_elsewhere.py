# SPDX-License-Identifier: Apache-2.0
"""Situations of docs/reported_elsewhere.md: what other projects' users reported, tried here."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from accerl_lerobot.cli import main
from accerl_lerobot.demos.dataset_files import open_metadata, opened
from accerl_lerobot.engines.config import RunConfig, parse
from accerl_lerobot.envs import SimulatedConfig, make_environment
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.features import check_features, env_features, policy_features
from accerl_lerobot.policies.loading import load_lerobot_config
from tests.policies.checkpoints import edit_config, write_smolvla
from tests.policies.tiny import adapter_at, requests
from tests.tiny_datasets import ACTION, FPS, FRONT, IMAGE, STATE, labels, rewrite, write_dataset


def test_a_recipe_from_windows_names_a_policy(tiny_checkpoint: Path, tmp_path: Path):
    recipe = tmp_path / "recipe.yaml"
    text = f"\ufeffenv:\r\n  type: simulated\r\npolicy:\r\n  path: {tiny_checkpoint}\r\n"
    recipe.write_bytes(text.encode())
    config = parse(RunConfig, [f"--config_path={recipe}"])
    assert config.policy.path == str(tiny_checkpoint) and config.env.tasks == ("match",)


def test_a_run_is_not_resumed_from_lerobot_s_own_file(tiny_checkpoint: Path):
    with pytest.raises(InputError, match="^config_path='.*config.json': LeRobot wrote it; resume a run with"):
        parse(RunConfig, [f"--config_path={tiny_checkpoint / 'config.json'}", "--resume=true"])


def test_the_device_in_the_checkpoint_is_replaced(tiny_checkpoint: Path, tmp_path: Path):
    copied = Path(shutil.copytree(tiny_checkpoint, tmp_path / "policy"))
    edit_config(copied, device="mps", use_amp=True)
    asked = requests(1, explore=False)
    chunks = [adapter_at(path).decide(asked, 0)[0].chunk for path in (tiny_checkpoint, copied)]
    np.testing.assert_array_equal(*chunks)


def test_a_config_without_a_type_is_told_what_to_add(tiny_checkpoint: Path, tmp_path: Path):
    copied = Path(shutil.copytree(tiny_checkpoint, tmp_path / "policy"))
    path = copied / "config.json"
    path.write_text(json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k != "type"}))
    with pytest.raises(InputError, match=r'^policy\.type=None: .*names no type; add "type": one of act, '):
        adapter_at(copied)


def test_a_policy_that_reads_an_instruction_warns_of_none(
    tiny_checkpoint: Path, caplog: pytest.LogCaptureFixture
):
    policy = policy_features(load_lerobot_config(PolicyConfig(path=str(tiny_checkpoint), device="cpu")))
    spec = make_environment(SimulatedConfig()).spec
    for task, warned in (("Reach", False), ("", True)):
        offered = env_features(replace(spec, instructions=(task,) if task else ()))
        needed = replace(policy, shapes={})
        check_features(needed, offered, {}, "policy.path", "mine")
        assert ("name it in env.task" in caplog.text) is warned


def with_column(table: pa.Table, name: str, values: Any) -> pa.Table:
    return table.set_column(table.schema.get_field_index(name), name, pa.array(values))


def move_border(table: pa.Table) -> pa.Table:
    return with_column(with_column(table, "dataset_to_index", [8, 12]), "dataset_from_index", [0, 8])


def delay(table: pa.Table) -> pa.Table:
    stamps = table.column("timestamp").to_numpy().copy()
    stamps[2] += 1 / FPS
    return with_column(table, "timestamp", stamps)


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("meta/episodes", move_border, "data: row 6: by meta/episodes it is of another episode"),
        ("data", delay, "data: row 2: its timestamp is not frame_index / 80"),
    ],
)
def test_rows_that_contradict_the_metadata_are_refused(file: str, change: Any, message: str, tmp_path: Path):
    dataset = write_dataset(tmp_path / "data", more={FRONT: IMAGE | {"dtype": "video"}})
    rewrite(tmp_path / "data" / file / "chunk-000/file-000.parquet", change)
    with pytest.raises(InputError, match=message), opened(dataset, open_metadata(dataset)):
        pass


@pytest.mark.parametrize("size", [1, 2], ids=["one joint", "one of two joints never moves"])
def test_a_policy_learns_from(size: int, tiny_checkpoint: Path, tmp_path: Path):
    checkpoint = tiny_checkpoint
    if size == 1:
        checkpoint = write_smolvla(tmp_path / "policy", state_dim=1, action_dim=1, padded_dim=1)
    shapes = {STATE: (1 if size == 1 else 4,), ACTION: (size,)}
    more = {name: {"dtype": "float32", "shape": shape, "names": None} for name, shape in shapes.items()}

    def value(name: str, episode: int, step: int) -> Any:
        still = np.array([0.1 * step - 0.3, 0.25]) if name == ACTION and size == 2 else None
        return [step == 5] if name == "next.success" else still

    write_dataset(tmp_path / "data", more=more | {FRONT: IMAGE, "next.success": labels()}, values=value)
    arguments = {
        "policy.path": checkpoint, "policy.device": "cpu", "dataset.repo_id": "a/b",
        "dataset.root": tmp_path / "data", "output_dir": tmp_path / "out", "trainer.updates": 1,
        "trainer.value_warmup_updates": 0, "algorithm.type": "self_imitation",
    }  # fmt: skip
    assert main(["offline", *(f"--{name}={given}" for name, given in arguments.items())]) == 0
    loss = json.loads((tmp_path / "out/summary.json").read_text())["imitation_loss"]
    assert 0 < loss["after"]["successes"] < loss["before"]["successes"] < 10
