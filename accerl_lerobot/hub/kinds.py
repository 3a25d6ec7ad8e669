# SPDX-License-Identifier: Apache-2.0
"""Kinds of folders, told by their files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from accerl_lerobot.checkpoint.layout import CHECKPOINTS, PREPROCESSOR, PRETRAINED, SUMMARY
from accerl_lerobot.checkpoint.layout import CONFIG as RECIPE
from accerl_lerobot.checkpoint.safety import JSON_MOST
from accerl_lerobot.errors import InputError

POLICY, WORLD_MODEL, SUCCESS_MODEL = "policy", "world model", "success model"
DATASET, RUN = "dataset", "run"

CONFIG, WEIGHTS, POSTPROCESSOR = "config.json", "model.safetensors", "policy_postprocessor.json"
INFO = "meta/info.json"
LAST = f"checkpoints/last/{PRETRAINED}"
NEEDED = {
    POLICY: (CONFIG, WEIGHTS, PREPROCESSOR, POSTPROCESSOR),
    WORLD_MODEL: (CONFIG, WEIGHTS),
    SUCCESS_MODEL: (CONFIG, WEIGHTS),
    DATASET: (INFO, "meta/tasks.parquet", "meta/episodes", "data"),
    RUN: (RECIPE, SUMMARY, LAST),
}
"""Kind → what its folder has at least."""
CODEBASE_VERSION = "v3.0"
"""Version of LeRobotDatasets, and the tag under which LeRobot looks for them on the Hub."""


def repo_type(kind: str) -> str:
    """In which sort of repository a kind belongs."""
    return "dataset" if kind == DATASET else "model"


def recognise(folder: Path, field: str = "path") -> str:
    """The kind of a folder, whole.

    Args:
        folder: to look into.
        field: that named it, for the error.

    Raises:
        InputError: it is nothing of ours or LeRobot's; says what it lacks.
    """
    if not folder.is_dir():
        raise InputError(field, str(folder), "no such folder")
    kind = _likely(folder)
    if kind is None:
        raise InputError(field, str(folder), _hint(folder))
    lacking = [name for name in NEEDED[kind] if not (folder / name).exists()]
    if lacking:
        remedy = f"looks like a {kind} but lacks {', '.join(lacking)}; name a folder that is whole"
        raise InputError(field, str(folder), remedy)
    if kind == DATASET:
        version = read_json(folder / INFO).get("codebase_version")
        if version != CODEBASE_VERSION:
            remedy = f"a LeRobotDataset of version {version}; convert it to {CODEBASE_VERSION} with LeRobot"
            raise InputError(field, str(folder), remedy)
    return kind


def read_json(path: Path) -> dict[str, Any]:
    """The mapping in a JSON file; empty if there is none, or a pipe or device in its place."""
    try:
        readable = path.is_file() and path.stat().st_size <= JSON_MOST
        content = json.loads(path.read_text()) if readable else None
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _likely(folder: Path) -> str | None:
    if (folder / INFO).is_file():
        return DATASET
    config = read_json(folder / CONFIG)
    if {"spec", "model"} <= config.keys():
        return WORLD_MODEL
    if "type" in config:
        # LeRobot stores how far a policy looks back, and nothing like it of a reward model.
        return POLICY if "n_obs_steps" in config else SUCCESS_MODEL
    if (folder / CHECKPOINTS).is_dir() and (folder / RECIPE).is_file():
        return RUN
    return None


def _hint(folder: Path) -> str:
    if (folder / PRETRAINED).is_dir():
        return f"name the folder {PRETRAINED} in it"
    if (folder / "world_model").is_dir():
        return "name the folder world_model in it"
    shapes = [f"a {kind} has {', '.join(NEEDED[kind])}" for kind in (POLICY, WORLD_MODEL, DATASET, RUN)]
    return f"nothing that we know: {'; '.join(shapes)}; a success model has what a world model has"
