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
"""What a checkpoint needs beside its weights: a backbone's config, and tokenisers.

LeRobot names them, by Hub id or by absolute path, and looks them up when it loads. Ours carry them in the
folder `checkpoint.BACKBONE`, which goes first when one of ours is loaded: no Hub, and no gate such as
PaliGemma's. The names in the files stay as they were where they are Hub ids, so that stock LeRobot loads the
checkpoint the way it loaded the original; local paths are set to the folder by `checkpoint.relocate`.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from accerl_lerobot.checkpoint import BACKBONE, PREPROCESSOR, TOKENIZER_STEP
from accerl_lerobot.errors import InputError


def use_backbone(lerobot_config: Any, folder: Path, path: str | None) -> None:
    """Points a LeRobot policy config at the checkpoint's own backbone, if it has one.

    Raises:
        InputError: the config names a local backbone that is gone.
    """
    if not hasattr(lerobot_config, "vlm_model_name"):
        return
    if (folder / BACKBONE).is_dir():
        lerobot_config.vlm_model_name = str((folder / BACKBONE).resolve())
    backbone = Path(lerobot_config.vlm_model_name)
    if backbone.is_absolute() and not backbone.is_dir():
        remedy = (
            f"its backbone was in {backbone}, which is gone; put a copy into {BACKBONE}/ beside config.json"
        )
        raise InputError("policy.path", path, remedy)


def tokenizer_overrides(folder: Path) -> dict[str, dict[str, Any]]:
    """Processor step → options, such that its tokeniser is the checkpoint's own, if it has one."""
    if not (folder / BACKBONE).is_dir():
        return {}
    return {TOKENIZER_STEP: {"tokenizer_name": str((folder / BACKBONE).resolve())}}


def keep_names(preprocessor: Any, folder: Path) -> None:
    """Gives a step whose tokeniser was overridden the name back that is to be saved with it."""
    stored = json.loads((folder / PREPROCESSOR).read_text())["steps"]
    for step, entry in zip(preprocessor.steps, stored, strict=True):
        if entry.get("registry_name") == TOKENIZER_STEP:
            step.tokenizer_name = entry["config"].get("tokenizer_name")


def save_backbone(lerobot_config: Any, preprocessor: Any, directory: Path) -> None:
    """Writes the backbone folder of a checkpoint in `directory`, unless its backbone is on the Hub."""
    if not hasattr(lerobot_config, "vlm_model_name"):
        for step in preprocessor.steps:
            if (tokenizer := getattr(step, "input_tokenizer", None)) is not None:
                tokenizer.save_pretrained(directory / BACKBONE)
        return
    source = Path(lerobot_config.vlm_model_name)
    if source.is_absolute() and source.resolve() != (directory / BACKBONE).resolve():
        # The policy's own file holds the backbone's weights, unless LeRobot builds it from the backbone's.
        weights = () if lerobot_config.load_vlm_weights else ("*.safetensors", "*.bin", "*.pt", "*.pth")
        ignore = shutil.ignore_patterns(*weights)
        shutil.copytree(source, directory / BACKBONE, ignore=ignore, dirs_exist_ok=True)
