# SPDX-License-Identifier: Apache-2.0
"""Files that a checkpoint needs beside its weights: a backbone's config, and tokenisers.

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

from accerl_lerobot.checkpoint.layout import BACKBONE, CONFIG_FOLDERS, FAST, PREPROCESSOR, STEP_FOLDERS
from accerl_lerobot.errors import InputError


def use_backbone(lerobot_config: Any, folder: Path, path: str | None) -> None:
    """Points a LeRobot policy config at the checkpoint's own files, where it has them.

    Raises:
        InputError: the config names local ones that are gone.
    """
    for field, own in CONFIG_FOLDERS.items():
        if not hasattr(lerobot_config, field):
            continue
        if (folder / own).is_dir():
            setattr(lerobot_config, field, str((folder / own).resolve()))
        named = Path(getattr(lerobot_config, field))
        if named.is_absolute() and not named.is_dir():
            what = "backbone was" if field == "vlm_model_name" else "tokeniser was"
            remedy = f"its {what} in {named}, which is gone; put a copy into {own}/ beside config.json"
            raise InputError("policy.path", path, remedy)


def tokenizer_overrides(lerobot_config: Any, folder: Path) -> dict[str, dict[str, Any]]:
    """Processor step → options, such that tokenisers are the checkpoint's own, where it has them.

    Args:
        lerobot_config: as `use_backbone` left it.
        folder: the checkpoint's.
    """
    overrides: dict[str, dict[str, Any]] = {}
    for entry in _stored_steps(folder):
        step = entry.get("registry_name", "")
        if step in STEP_FOLDERS and (folder / STEP_FOLDERS[step][1]).is_dir():
            option, own = STEP_FOLDERS[step]
            overrides[step] = {option: str((folder / own).resolve())}
        if step == "action_tokenizer_processor":  # LeRobot does not save these two of its options
            overrides.setdefault(step, {})["paligemma_tokenizer_name"] = lerobot_config.text_tokenizer_name
            overrides[step]["fast_skip_tokens"] = lerobot_config.fast_skip_tokens
    return overrides


def keep_names(lerobot_config: Any, preprocessor: Any, folder: Path) -> None:
    """Undoes the two functions above in what will be saved, once tokenisers are loaded."""
    stored = json.loads((folder / "config.json").read_text())
    for field in CONFIG_FOLDERS.keys() - {"vlm_model_name"}:
        if hasattr(lerobot_config, field) and field in stored:
            setattr(lerobot_config, field, stored[field])
    for step, entry in zip(preprocessor.steps, _stored_steps(folder), strict=True):
        if (option := STEP_FOLDERS.get(entry.get("registry_name", ""))) is not None:
            setattr(step, option[0], entry["config"].get(option[0]))


def save_backbone(lerobot_config: Any, preprocessor: Any, directory: Path) -> None:
    """Writes the backbone folder of a checkpoint in `directory`, unless its backbone is on the Hub."""
    if not hasattr(lerobot_config, "vlm_model_name"):
        for step in preprocessor.steps:
            if (tokenizer := getattr(step, "input_tokenizer", None)) is not None:
                tokenizer.save_pretrained(directory / BACKBONE)
            if (tokenizer := getattr(step, "action_tokenizer", None)) is not None:
                tokenizer.save_pretrained(directory / FAST)
        return
    source = Path(lerobot_config.vlm_model_name)
    if source.is_absolute() and source.resolve() != (directory / BACKBONE).resolve():
        # The policy's own file holds the backbone's weights, unless LeRobot builds it from the backbone's.
        weights = () if lerobot_config.load_vlm_weights else ("*.safetensors", "*.bin", "*.pt", "*.pth")
        ignore = shutil.ignore_patterns(*weights)
        shutil.copytree(source, directory / BACKBONE, ignore=ignore, dirs_exist_ok=True)


def _stored_steps(folder: Path) -> list[dict[str, Any]]:
    steps: list[dict[str, Any]] = json.loads((folder / PREPROCESSOR).read_text())["steps"]
    return steps
