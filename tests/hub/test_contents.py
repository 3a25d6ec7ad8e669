# SPDX-License-Identifier: Apache-2.0
"""A folder's type by its files, the files that go to the Hub without paths of this machine, and their run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import yaml

from accerl_lerobot.errors import InputError
from accerl_lerobot.hub.card import Files, PullConfig, PushConfig, recognise, run_files
from accerl_lerobot.hub.transfer import stage, without_paths
from tests.hub.folders import write_json, write_policy_folder, write_run_folder

TINY = Path(__file__).parents[2] / "datasets" / "metaworld_tiny"


@pytest.mark.parametrize(
    ("artifact", "missing"),
    [
        ("policy", "model.safetensors"),
        ("policy", "policy_preprocessor.json"),
        ("dataset", "meta/tasks.parquet"),
    ],
)
def test_an_incomplete_folder_says_what_it_lacks(tmp_path: Path, artifact: str, missing: str):
    folder = tmp_path / "folder"
    write_policy_folder(folder) if artifact == "policy" else shutil.copytree(TINY, folder)
    (folder / missing).unlink()
    with pytest.raises(InputError, match=f"looks like a {artifact} but lacks {missing}"):
        recognise(folder)


def test_folders_one_above_say_which_below(tmp_path: Path):
    last = "checkpoints/last/pretrained_model"
    for below in (last, f"sft/{last}", "pretrained_model", "world_model"):
        above = tmp_path / f"above {below.replace('/', ' ')}"
        (above / below).mkdir(parents=True)
        with pytest.raises(InputError, match=f"name the folder {below} in it"):
            recognise(above)
    write_json(tmp_path / "success_model" / "config.json", {"type": "success_pairs"})
    for folder in (tmp_path / "success_model", tmp_path):
        with pytest.raises(InputError, match="neither a policy, a world model nor a LeRobotDataset"):
            recognise(folder)
    with pytest.raises(InputError, match="no such folder"):
        recognise(tmp_path / "nowhere")


@pytest.mark.parametrize("name", [None, "", "door", "a/b/c", "../x/y", "a/b c", "https://x/y"])
def test_what_is_no_name_of_a_repository(name: str | None):
    with pytest.raises(InputError, match="user/name"):
        PushConfig(path="x", repo_id=name)
    with pytest.raises(InputError, match="user/name"):
        PullConfig(repo_id=name, output_dir="x")


def staged(folder: Path) -> Files:
    """Everything that a push of a policy uploads but its card."""
    files = stage(PushConfig(path=str(folder), repo_id="a/b"), folder, "policy")
    del files["README.md"]
    return files


def test_only_what_belongs_to_a_policy_is_pushed(tmp_path: Path):
    folder = write_policy_folder(tmp_path / "policy")
    own = {path.name for path in folder.iterdir()}
    others = (".cache/huggingface/x.json", ".secret", "accerl_pulled.json", "id_rsa", "passwords.json",
              "backbone/notes.txt", "backbone/deep/config.json", "accerl_run/wallet.json")  # fmt: skip
    for name in (*others, "backbone/config.json", "LICENSE", "accerl_run/summary.json"):
        write_json(folder / name, {})
    (folder / "linked").symlink_to(tmp_path)
    assert set(staged(folder)) == own | {"backbone/config.json", "LICENSE", "accerl_run/summary.json"}


def test_an_adapter_brings_its_own_weights(tmp_path: Path):
    folder = write_policy_folder(tmp_path / "policy", use_peft=True)
    (folder / "model.safetensors").rename(folder / "adapter_model.safetensors")
    write_json(folder / "adapter_config.json", {"base_model_name_or_path": "lerobot/smolvla_base"})
    assert recognise(folder) == "policy"
    assert {"adapter_config.json", "adapter_model.safetensors"} <= staged(folder).keys()


@pytest.mark.parametrize(
    "name", ["config.json", "backbone", "backbone/tokenizer.json", "README.md", "accerl_run"]
)
def test_no_link_that_leads_out_is_pushed(tmp_path: Path, name: str):
    secret = tmp_path / "secret"
    for file in ("config.json", "tokenizer.json", "summary.json"):
        write_json(secret / file, {"type": "act", "n_obs_steps": 1})
    folder = write_policy_folder(tmp_path / "policy")
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(secret if "." not in name else secret / "config.json")
    with pytest.raises(InputError, match=f"{name}.*: a link that leads out of the folder"):
        stage(PushConfig(path=str(folder), repo_id="a/b"), folder, "policy")


def test_a_backbone_is_named_by_its_place_beside_the_weights(tmp_path: Path):
    folder = write_policy_folder(tmp_path / "policy", type="smolvla", vlm_model_name=str(tmp_path / "gone"))
    step = {"registry_name": "tokenizer_processor", "config": {"tokenizer_name": str(tmp_path / "gone")}}
    write_json(folder / "policy_preprocessor.json", {"steps": [step]})
    with pytest.raises(InputError, match="put a copy into backbone/"):
        staged(folder)
    write_json(folder / "backbone" / "config.json", {"model_type": "smolvlm"})
    files = staged(folder)
    assert json.loads(bytes(files["config.json"]))["vlm_model_name"] == "backbone"
    stored = json.loads(bytes(files["policy_preprocessor.json"]))
    assert stored["steps"][0]["config"]["tokenizer_name"] == "backbone"
    assert str(tmp_path / "gone") in (folder / "config.json").read_text(), "the folder itself is as it was"


def test_an_evaluation_is_of_this_policy_or_refused(tmp_path: Path):
    run = write_run_folder(tmp_path / "run")
    policy = run / "checkpoints" / "000006" / "pretrained_model"
    write_json(tmp_path / "eval" / "evaluation.json", {"success": 0.5, "policy": str(policy)})
    other = run / "checkpoints" / "000012" / "pretrained_model"
    for folder, evaluation in ((other, tmp_path / "eval"), (policy, tmp_path)):
        with pytest.raises(InputError, match="not an evaluation of "):
            run_files(folder, "policy", str(evaluation))


@pytest.mark.parametrize("suffix", ["json", "yaml"])
def test_paths_in_json_and_yaml(tmp_path: Path, suffix: str):
    changes = {
        str(tmp_path.parent / "with blanks" / "demos"): "LOCAL/demos",
        f"--root={tmp_path.parent}/data/x.json,y": "--root=LOCAL/x.json,y",
        "~/runs/one": "LOCAL/one",
        "/Users/somebody/model": "LOCAL/model",
        "../runs/two": "LOCAL/two",
        "/data": "LOCAL/data",
        "..": "LOCAL/",
    }
    kept = ["lerobot/smolvla_base", "observation.front", 0.5, None, True, "m/s", "1/2/3", "/"]
    kept += ["https://example.org/tmp/a/b", "data/*/*.parquet"]
    same = {"kept": kept, "targets": r"layers\..\.q_proj"}
    tree = same | {"output_dir": str(tmp_path), "nested": [{"paths": list(changes)}]}
    wanted = same | {"output_dir": None, "nested": [{"paths": list(changes.values())}]}
    dump = json.dumps if suffix == "json" else yaml.safe_dump
    data = without_paths(f"a.{suffix}", dump(tree).encode())
    assert yaml.safe_load(bytes(data)) == wanted


def test_what_has_no_paths_keeps_every_byte():
    data = b'{"b":1e-5,\n   "url": "http://a/b/c"}'
    assert without_paths("config.json", data) is data
    assert without_paths("backbone/tokenizer.json", b'["/a/b/c"]') == b'["/a/b/c"]', "a vocabulary"
