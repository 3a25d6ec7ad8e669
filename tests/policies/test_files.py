# SPDX-License-Identifier: Apache-2.0
"""Hostile files of a checkpoint, and what LeRobot would have made of them."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from accerl_lerobot.checkpoint.layout import BACKBONE
from accerl_lerobot.checkpoint.safety import Origin
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.guard import check_checkpoint
from accerl_lerobot.policies.loading import load_adapter
from accerl_lerobot.policies.saving import save_pretrained
from tests.policies.checkpoints import edit_config, write_gaussian_actor

PRE = "policy_preprocessor.json"
ORIGIN = Origin("policy.path", "theirs")


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = write_gaussian_actor(tmp_path_factory.mktemp("files") / "made")
    config = PolicyConfig(path=str(made), device="cpu")
    save_pretrained(load_adapter(config), made.parent / "saved", config)
    return made.parent / "saved"


@pytest.fixture
def copied(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "policy"))


def edit_steps(path: Path, edit: Callable[[list[dict[str, Any]]], object]) -> None:
    content = json.loads((path / PRE).read_text())
    edit(content["steps"])
    (path / PRE).write_text(json.dumps(content))


def refused(path: Path, why: str) -> None:
    with pytest.raises(InputError, match=f"^policy.path='.*': .*{why}") as caught:
        load_adapter(PolicyConfig(path=str(path), device="cpu"))
    assert "\n" not in str(caught.value)


def test_good_ones_pass(good: Path, tiny_checkpoint: Path):
    for path in (good, tiny_checkpoint):
        assert check_checkpoint(path, ORIGIN)["type"]


def call(marker: Path) -> dict[str, Any]:
    """LeRobot 0.6.1's way to a processor step: it imports the class and calls it."""
    return {"class": "subprocess.Popen", "config": {"args": ["touch", str(marker)]}}


def test_lerobot_calls_whatever_a_processor_names(copied: Path, tmp_path: Path):
    """Why this is checked: the same file, loaded by LeRobot alone."""
    from lerobot.processor import PolicyProcessorPipeline

    marker = tmp_path / "was-run"
    edit_steps(copied, lambda steps: steps.insert(0, call(marker)))
    with pytest.raises(TypeError, match="must inherit from ProcessorStep"):  # which it says too late
        PolicyProcessorPipeline.from_pretrained(copied, config_filename=PRE)
    ends = time.monotonic() + 30
    while not marker.exists() and time.monotonic() < ends:
        time.sleep(0.05)
    assert marker.exists()


@pytest.mark.parametrize("beside", [{}, {"registry_name": "device_processor"}, {"registry_name": None}])
def test_a_step_is_named_and_not_imported(copied: Path, tmp_path: Path, beside: dict[str, Any]):
    marker = tmp_path / "was-run"
    edit_steps(copied, lambda steps: steps.insert(0, call(marker) | beside))
    refused(copied, "only steps with a registry_name are loaded")
    assert not marker.exists()


def test_a_state_file_lies_in_the_folder(copied: Path, tmp_path: Path):
    steps = json.loads((copied / PRE).read_text())["steps"]
    (index,) = (i for i, step in enumerate(steps) if "state_file" in step)
    shutil.copy(copied / steps[index]["state_file"], tmp_path / "outside.safetensors")
    for name in ("../outside.safetensors", str(tmp_path / "outside.safetensors")):
        edit_steps(copied, lambda steps, name=name: steps[index].update(state_file=name))
        refused(copied, "only files inside the folder are read")
    (copied / "link.safetensors").symlink_to(tmp_path / "outside.safetensors")
    edit_steps(copied, lambda steps: steps[index].update(state_file="link.safetensors"))
    refused(copied, "a link that leads out of the folder")


@pytest.mark.parametrize(
    "name", ["config.json", PRE, "model.safetensors", "value_head.safetensors", "accerl.json"]
)
def test_links_out_of_the_folder(copied: Path, tmp_path: Path, name: str):
    (copied / name).rename(tmp_path / "outside")
    (copied / name).symlink_to(tmp_path / "outside")
    refused(copied, f"{name}: a link that leads out")


@pytest.mark.parametrize(
    ("name", "fetched", "why"),
    [
        ("../../secret", False, "neither a Hub id nor an absolute path"),
        ("./secret", False, "neither a Hub id nor an absolute path"),
        ("a/b/c", False, "neither a Hub id nor an absolute path"),
        ("https://example.com/x", False, "neither a Hub id nor an absolute path"),
        ("/a/../secret", False, "may not name"),
        ("/somewhere/secret", True, "may not name"),
        (7, False, "a name is wanted"),
        ("a\x00", False, "a name is wanted"),
    ],
)
def test_backbones_are_not_fetched_from_just_anywhere(copied: Path, name: object, fetched: bool, why: str):
    edit_config(copied, vlm_model_name=name)
    with pytest.raises(InputError, match=f"^policy.path='theirs': config.json: vlm_model_name: .*{why}"):
        check_checkpoint(copied, ORIGIN, fetched=fetched)


def test_names_that_are_fine(copied: Path):
    for name, fetched in (("google/paligemma-3b-pt-224", True), ("gpt2", True), ("/somewhere/mine", False)):
        edit_config(copied, vlm_model_name=name)
        check_checkpoint(copied, ORIGIN, fetched=fetched)


@pytest.mark.parametrize("files", [["pytorch_model.bin"], ["model.pt", "config.yaml"], ["policy.ckpt"]])
def test_pickled_weights_only(copied: Path, files: list[str]):
    (copied / "model.safetensors").unlink()
    for name in files:
        (copied / name).write_bytes(b"\x80\x04.")
    refused(copied, f"model.safetensors: is missing, and {files[0]} is a pickle.*convert it to safetensors")


@pytest.mark.parametrize("key", ["attn_implementation", "_attn_implementation"])
def test_attention_is_not_fetched_as_compiled_code(copied: Path, key: str):
    (copied / BACKBONE).mkdir()
    content = {"model_type": "smolvlm", "text_config": {key: "them/kernels"}}
    (copied / BACKBONE / "config.json").write_text(json.dumps(content))
    refused(copied, f"{key} names code on the Hub")


@pytest.mark.parametrize(
    ("text", "why"),
    [("[]", "a mapping is wanted"), ('{"sampler": 7}', "accerl.json: sampler"), ("{", "not good JSON")],
)
def test_what_is_ours_is_checked_too(copied: Path, text: str, why: str):
    (copied / "accerl.json").write_text(text)
    refused(copied, why)


def test_a_critic_of_another_size(copied: Path):
    shutil.copy(copied / "model.safetensors", copied / "value_head.safetensors")
    refused(copied, "value_head.safetensors: accerl.json says another critic than it is")
