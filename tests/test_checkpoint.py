# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""A checkpoint is there whole or not at all, and ``last`` always points at one that is."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from accerl_lerobot.checkpoint import BACKBONE, PRETRAINED, displaced, relocate, save_checkpoint


def writer(version: int, content: str = "weights") -> Callable[[Path], int]:
    def write(directory: Path) -> int:
        directory.mkdir(parents=True)
        (directory / "model.safetensors").write_text(content)
        return version

    return write


def listing(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_layout(tmp_path: Path):
    path = save_checkpoint(tmp_path / "checkpoints", writer(7), {"algorithm": "gipo"})
    assert path == tmp_path / "checkpoints" / "000007"
    assert listing(path) == [PRETRAINED, "training_state"] and listing(path / PRETRAINED) == [
        "model.safetensors"
    ]
    step = json.loads((path / "training_state" / "training_step.json").read_text())
    assert step == {"step": 7, "algorithm": "gipo"}
    assert listing(path.parent) == ["000007", "last"]


def test_last_is_the_newest_and_survives_a_move(tmp_path: Path):
    for version in (1, 20):
        save_checkpoint(tmp_path / "run" / "checkpoints", writer(version), {})
    last = tmp_path / "run" / "checkpoints" / "last"
    assert os.readlink(last) == "000020", "relative"
    shutil.move(tmp_path / "run", tmp_path / "moved")
    moved = tmp_path / "moved" / "checkpoints"
    assert (moved / "last" / PRETRAINED / "model.safetensors").read_text() == "weights"
    assert listing(moved) == ["000001", "000020", "last"]


def test_nothing_is_visible_while_it_is_written(tmp_path: Path):
    seen: list[list[str]] = []

    def write(directory: Path) -> int:
        seen.append([name for name in listing(tmp_path) if not name.startswith(".")])
        return writer(3)(directory)

    save_checkpoint(tmp_path, write, {})
    assert seen == [[]]


@pytest.mark.parametrize("state", [{}, {"unwritable": object()}], ids=["write fails", "state is not JSON"])
def test_a_failure_leaves_everything_as_it_was(tmp_path: Path, state: dict):
    save_checkpoint(tmp_path, writer(1), {})

    def write(directory: Path) -> int:
        writer(2)(directory)
        if state:
            return 2
        raise OSError("no space left on device")

    with pytest.raises((OSError, TypeError)):
        save_checkpoint(tmp_path, write, state)
    assert listing(tmp_path) == ["000001", "last"] and os.readlink(tmp_path / "last") == "000001"
    save_checkpoint(tmp_path, writer(2), {})
    assert os.readlink(tmp_path / "last") == "000002", "and the next attempt succeeds"


def test_what_a_killed_process_left_behind_is_no_obstacle(tmp_path: Path):
    (tmp_path / f".writing-{os.getpid()}" / PRETRAINED).mkdir(parents=True)
    (tmp_path / f".writing-{os.getpid()}" / PRETRAINED / "half").touch()
    (tmp_path / ".last-new").symlink_to("000000")
    path = save_checkpoint(tmp_path, writer(1), {})
    assert listing(path / PRETRAINED) == ["model.safetensors"]
    assert listing(tmp_path) == ["000001", "last"]


def test_the_same_version_again_keeps_the_first(tmp_path: Path):
    first = save_checkpoint(tmp_path, writer(5, "first"), {"saved": 1})
    again = save_checkpoint(tmp_path, writer(5, "again"), {"saved": 2})
    assert first == again and (first / PRETRAINED / "model.safetensors").read_text() == "first"
    assert json.loads((first / "training_state" / "training_step.json").read_text())["saved"] == 1
    assert listing(tmp_path) == ["000005", "last"]


def test_paths_in_the_files_are_those_of_the_final_place(tmp_path: Path):
    def write(directory: Path) -> int:
        (directory / BACKBONE).mkdir(parents=True)
        (directory / "config.json").write_text(json.dumps({"vlm_model_name": "/elsewhere", "chunk_size": 4}))
        steps = [
            {"registry_name": "device_processor", "config": {"device": "cpu"}},
            {
                "registry_name": "tokenizer_processor",
                "config": {"tokenizer_name": "/elsewhere", "max_length": 48},
            },
        ]
        (directory / "policy_preprocessor.json").write_text(json.dumps({"name": "pre", "steps": steps}))
        return 4

    pretrained = save_checkpoint(tmp_path, write, {}) / PRETRAINED
    home = str(pretrained / BACKBONE)
    assert json.loads((pretrained / "config.json").read_text()) == {"vlm_model_name": home, "chunk_size": 4}
    first, second = json.loads((pretrained / "policy_preprocessor.json").read_text())["steps"]
    assert first["config"] == {"device": "cpu"}
    assert second["config"] == {"tokenizer_name": home, "max_length": 48}


def test_a_backbone_from_the_hub_is_left_alone(tmp_path: Path):
    (tmp_path / "config.json").write_text('{"vlm_model_name": "some/backbone"}')
    relocate(tmp_path, tmp_path / "home")
    assert (tmp_path / "config.json").read_text() == '{"vlm_model_name": "some/backbone"}'


def test_a_backbone_by_its_bare_name_is_the_one_beside(tmp_path: Path):
    (tmp_path / BACKBONE).mkdir()
    (tmp_path / "config.json").write_text(json.dumps({"vlm_model_name": BACKBONE}))
    (tmp_path / "policy_preprocessor.json").write_text('{"steps": []}')
    assert displaced(tmp_path), "LeRobot would look for it where the process runs"
    relocate(tmp_path, tmp_path)
    assert json.loads((tmp_path / "config.json").read_text()) == {"vlm_model_name": str(tmp_path / BACKBONE)}
    assert not displaced(tmp_path)
