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
"""Checkpoints in LeRobot's layout, visible only when whole.

``checkpoints/NNNNNN/pretrained_model`` holds what stock LeRobot loads; ``checkpoints/last`` points at the
newest. A checkpoint is written under a temporary name and renamed, so that a reader never finds half of one.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

PRETRAINED = "pretrained_model"
BACKBONE = "backbone"
"""Folder beside the weights with the vision-language backbone's config and tokenisers."""
FAST = f"{BACKBONE}/fast"
"""Folder with the tokeniser of actions, where a policy has one."""
CONFIG_FOLDERS = {"vlm_model_name": BACKBONE, "text_tokenizer_name": BACKBONE, "action_tokenizer_name": FAST}
"""Field of a LeRobot policy config that names files → where ours have them."""
STEP_FOLDERS = {
    "tokenizer_processor": ("tokenizer_name", BACKBONE),
    "action_tokenizer_processor": ("action_tokenizer_name", FAST),
}
"""LeRobot processor step → its option that names files, and where ours have them."""
PREPROCESSOR = "policy_preprocessor.json"
"""LeRobot's file of the processor steps before the policy."""


def save_checkpoint(checkpoints: Path, write: Callable[[Path], int], state: dict[str, Any]) -> Path:
    """Writes one checkpoint and points ``last`` at it.

    Args:
        checkpoints: the run's ``checkpoints`` folder.
        write: creates and fills the ``pretrained_model`` folder it is given and returns the version of what
            it wrote, the number of updates behind it.
        state: plain JSON, stored as ``training_state/training_step.json``; ``step`` is added.

    Returns:
        ``checkpoints/NNNNNN``, left as it is if that version has been saved before.

    Raises:
        Exception: whatever `write` raises; older checkpoints and ``last`` are as before.
    """
    checkpoints.mkdir(parents=True, exist_ok=True)
    temporary = checkpoints / f".writing-{os.getpid()}"
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        version = write(temporary / PRETRAINED)
        final = checkpoints / f"{version:06d}"
        if not final.exists():  # the same version is the same weights
            relocate(temporary / PRETRAINED, final / PRETRAINED)
            (temporary / "training_state").mkdir()
            step = json.dumps({"step": version, **state}, indent=2)
            (temporary / "training_state" / "training_step.json").write_text(step + "\n")
            temporary.rename(final)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    link = checkpoints / ".last-new"
    link.unlink(missing_ok=True)
    link.symlink_to(final.name)
    link.replace(checkpoints / "last")
    return final


def relocate(directory: Path, home: Path) -> None:
    """Points a checkpoint's config and processors at the files in its own folder.

    LeRobot 0.6.1 stores a local backbone by absolute path. Names on the Hub are left as they are.

    Args:
        directory: where the files are now.
        home: where they will be.
    """
    if not (directory / BACKBONE).is_dir():
        return
    config, processor = _named(directory)
    for fields, key, folder in _local_names(config, processor):
        fields[key] = str((home / folder).absolute())
    (directory / "config.json").write_text(json.dumps(config, indent=4) + "\n")
    (directory / PREPROCESSOR).write_text(json.dumps(processor, indent=4) + "\n")


def displaced(directory: Path) -> bool:
    """Whether a checkpoint has a backbone folder of its own and its files name one that is not there."""
    if not (directory / BACKBONE).is_dir():
        return False
    return any(not Path(fields[key]).is_dir() for fields, key, _ in _local_names(*_named(directory)))


def _named(directory: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    config = json.loads((directory / "config.json").read_text())
    return config, json.loads((directory / PREPROCESSOR).read_text())


def _local_names(config: dict[str, Any], processor: dict[str, Any]) -> list[tuple[dict[str, Any], str, str]]:
    """Where a checkpoint's files name a folder of this machine, or by its bare name one beside them, as they
    do on the Hub: (mapping, key, our folder for it)."""
    places = [(config, key, folder) for key, folder in CONFIG_FOLDERS.items()]
    for step in processor["steps"]:
        if (option := STEP_FOLDERS.get(step.get("registry_name"))) is not None:
            places.append((step["config"], *option))
    named = [(place, place[0].get(place[1]) or "") for place in places]
    return [place for place, name in named if Path(name).is_absolute() or name == place[2]]
