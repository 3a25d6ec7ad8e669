# SPDX-License-Identifier: Apache-2.0
"""A folder is recognised by what is in it, and one that is not whole says what it lacks."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from accerl_lerobot.errors import InputError
from accerl_lerobot.hub.card import PullConfig, PushConfig, recognise, repo_type
from tests.hub.folders import write_json, write_policy_folder, write_run_folder

TINY = Path(__file__).parents[2] / "datasets" / "metaworld_tiny"


def test_kinds(tmp_path: Path):
    assert recognise(write_policy_folder(tmp_path / "policy")) == "policy"
    assert recognise(TINY) == "dataset" and repo_type("dataset") == "dataset"
    write_json(tmp_path / "world" / "config.json", {"spec": {}, "model": {}})
    (tmp_path / "world" / "model.safetensors").write_bytes(b"x")
    assert recognise(tmp_path / "world") == "world model" and repo_type("world model") == "model"


@pytest.mark.parametrize(
    ("artifact", "missing"),
    [
        ("policy", "model.safetensors"),
        ("policy", "policy_preprocessor.json"),
        ("policy", "policy_postprocessor.json"),
        ("dataset", "meta/tasks.parquet"),
    ],
)
def test_an_incomplete_folder_says_what_it_lacks(tmp_path: Path, artifact: str, missing: str):
    write = {"policy": write_policy_folder, "dataset": copy_dataset}[artifact]
    (write(tmp_path / "folder") / missing).unlink()
    with pytest.raises(InputError, match=f"looks like a {artifact} but lacks {missing}"):
        recognise(tmp_path / "folder")


def copy_dataset(folder: Path) -> Path:
    return Path(shutil.copytree(TINY, folder))


def test_folders_one_above_say_which_below(tmp_path: Path):
    run = write_run_folder(tmp_path / "run")
    with pytest.raises(InputError, match="name the folder checkpoints/last/pretrained_model in it"):
        recognise(run)
    with pytest.raises(InputError, match="name the folder pretrained_model in it"):
        recognise(run / "checkpoints" / "000012")
    (tmp_path / "learnt" / "world_model").mkdir(parents=True)
    with pytest.raises(InputError, match="name the folder world_model in it"):
        recognise(tmp_path / "learnt")
    write_json(tmp_path / "success_model" / "config.json", {"type": "success_pairs"})
    with pytest.raises(InputError, match="no known artifact"):
        recognise(tmp_path / "success_model")
    with pytest.raises(InputError, match="a policy has config.json, model.safetensors"):
        recognise(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        recognise(tmp_path / "nowhere")


@pytest.mark.parametrize(
    "name", [None, "", "door", "a/b/c", "../x/y", "a/..", "a/b c", "https://x/y", "/a/b"]
)
def test_what_is_no_name_of_a_repository(name: str | None):
    for make in (
        lambda: PushConfig(path="x", repo_id=name),
        lambda: PullConfig(repo_id=name, output_dir="x"),
    ):
        with pytest.raises(InputError, match="user/name"):
            make()
