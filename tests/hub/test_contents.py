# SPDX-License-Identifier: Apache-2.0
"""Files of a folder that go to the Hub, and the facts about the run behind it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from accerl_lerobot.errors import InputError
from accerl_lerobot.hub.card import find_provenance
from accerl_lerobot.hub.push import contents
from tests.hub.folders import SUMMARY, write_json, write_policy_folder, write_run_folder

TOKENIZER = {"registry_name": "tokenizer_processor", "config": {"tokenizer_name": "x"}}


def test_hidden_files_and_what_a_pull_left_stay_here(tmp_path: Path):
    folder = write_policy_folder(tmp_path / "policy")
    for name in (".cache/huggingface/x.json", ".secret", "accerl_pulled.json"):
        write_json(folder / name, {})
    (folder / "linked").symlink_to(tmp_path)
    assert {n for n in contents(folder, "policy") if not (folder / n).exists()} == set()
    assert not {
        n
        for n in contents(folder, "policy")
        if "secret" in n or "cache" in n or "accerl_" in n or "link" in n
    }


def test_a_backbone_elsewhere_is_brought(tmp_path: Path):
    backbone = tmp_path / "backbone"
    write_json(backbone / "config.json", {"model_type": "smolvlm"})
    (backbone / "model.safetensors").write_bytes(b"weights that are in the policy as well")
    folder = write_policy_folder(
        tmp_path / "policy", type="smolvla", vlm_model_name=str(backbone), load_vlm_weights=False
    )
    step = TOKENIZER | {"config": {"tokenizer_name": str(backbone)}}
    write_json(folder / "policy_preprocessor.json", {"steps": [step]})
    files = contents(folder, "policy")
    assert json.loads(bytes(files["config.json"]))["vlm_model_name"] == "backbone"
    stored = json.loads(bytes(files["policy_preprocessor.json"]))
    assert stored["steps"][0]["config"]["tokenizer_name"] == "backbone"
    assert "backbone/config.json" in files and "backbone/model.safetensors" not in files
    assert str(backbone) in (folder / "config.json").read_text(), "the folder itself is as it was"
    write_json(
        folder / "config.json", json.loads((folder / "config.json").read_text()) | {"load_vlm_weights": True}
    )
    assert "backbone/model.safetensors" in contents(folder, "policy")
    backbone.rename(tmp_path / "gone")
    with pytest.raises(InputError, match="put a copy into backbone/"):
        contents(folder, "policy")


def test_numbers_go_only_with_the_policy_they_are_of(tmp_path: Path):
    run = write_run_folder(tmp_path / "run")
    last = find_provenance(run / "checkpoints" / "last" / "pretrained_model", "policy", None)
    assert last.summary == SUMMARY and last.recipe["algorithm"] == {"type": "gipo"}
    assert set(last.files) == {
        f"accerl_run/{n}" for n in ("config.yaml", "summary.json", "success_curve.png", "before_after.mp4")
    }
    earlier = find_provenance(run / "checkpoints" / "000006" / "pretrained_model", "policy", None)
    assert earlier.summary == {} and set(earlier.files) == {"accerl_run/config.yaml"}
    alone = find_provenance(write_policy_folder(tmp_path / "alone"), "policy", None)
    assert not alone.recipe and not alone.files


def test_an_evaluation_is_of_this_policy_or_refused(tmp_path: Path):
    run = write_run_folder(tmp_path / "run")
    policy = run / "checkpoints" / "000006" / "pretrained_model"
    found = {"success": 0.5, "n": 10, "ci95": [0.2366, 0.7634], "tasks": {}, "policy": str(policy)}
    write_json(tmp_path / "eval" / "evaluation.json", found)
    provenance = find_provenance(policy, "policy", str(tmp_path / "eval"))
    assert provenance.evaluation == found and "accerl_run/evaluation.json" in provenance.files
    with pytest.raises(InputError, match="of another policy"):
        find_provenance(run / "checkpoints" / "000012" / "pretrained_model", "policy", str(tmp_path / "eval"))
    with pytest.raises(InputError, match="not a file of accerl eval"):
        find_provenance(policy, "policy", str(tmp_path))
    with pytest.raises(InputError, match="only a policy is evaluated"):
        find_provenance(tmp_path, "dataset", str(tmp_path / "eval"))
