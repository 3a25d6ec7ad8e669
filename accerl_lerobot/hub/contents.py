# SPDX-License-Identifier: Apache-2.0
"""Which files of a folder go to the Hub, and what becomes of them on the way."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from accerl_lerobot.checkpoint import layout as checkpoints
from accerl_lerobot.checkpoint.layout import (
    BACKBONE,
    CHECKPOINTS,
    CONFIG_FOLDERS,
    LAST,
    PREPROCESSOR,
    PRETRAINED,
    defect,
)
from accerl_lerobot.errors import InputError
from accerl_lerobot.hub.kinds import CONFIG, DATASET, POLICY, RUN, read_json
from accerl_lerobot.hub.manifest import CARD, MANIFEST, entry_of
from accerl_lerobot.hub.portable import cleaned, is_record, own_names

RECORD = "accerl_pulled.json"
"""File that a pull leaves beside the others: the commit that they are of."""
NOT_CONTENTS = (CARD, MANIFEST, RECORD, ".gitattributes")
OF_A_RUN = (".yaml", ".json", ".jsonl", ".png", ".jpg", ".gif", ".svg", ".mp4", ".html")
"""Suffixes of files at the top of a run that are results."""
WEIGHTS = (".safetensors", ".bin", ".pt", ".pth")

Files = dict[str, Path | bytes]
"""Name in the repository → a file, or the bytes that stand for it."""


def contents(folder: Path, kind: str, include: Sequence[str] = ()) -> Files:
    """Files of a folder that are worth keeping, without paths of this machine.

    Args:
        folder: of `kind`.
        kind: see `kinds`.
        include: folders of a run that are left at home otherwise.

    Raises:
        InputError: `include` names no folder of the run; its checkpoint is broken; or a policy's backbone is
            gone.
    """
    if include and kind != RUN:
        raise InputError("include", list(include), f"for a run; a {kind} is pushed whole")
    if kind == RUN:
        files = _of_a_run(folder, include)
        policies = [f"checkpoints/{_last(folder).name}/{PRETRAINED}"]
    else:
        files = {name: path for name, path in walk(folder) if name not in NOT_CONTENTS}
        if kind == DATASET:  # what LeRobot leaves behind of pictures that are in the tables or films now
            files = {name: path for name, path in files.items() if not name.startswith("images/")}
        policies = [""] if kind == POLICY else []
    for policy in policies:
        _bring_backbone(files, folder, policy)
    for name, content in files.items():
        if is_record(name):
            data = content if isinstance(content, bytes) else content.read_bytes()
            files[name] = cleaned(name, data, folder)
    if kind == RUN:
        _renew_manifest(files, f"checkpoints/{_last(folder).name}/")
    return files


def walk(folder: Path) -> Iterator[tuple[str, Path]]:
    """Files below a folder by their names in a repository; hidden ones, and linked folders, are not of it."""
    for at, folders, names in os.walk(folder):
        folders[:] = sorted(f for f in folders if not f.startswith(".") and f != "__pycache__")
        for name in sorted(names):
            path = Path(at, name)
            if not name.startswith(".") and path.is_file():
                yield path.relative_to(folder).as_posix(), path


def _last(run: Path) -> Path:
    return (run / CHECKPOINTS / LAST).resolve()


def _of_a_run(run: Path, include: Sequence[str]) -> Files:
    files: Files = {
        path.name: path
        for path in sorted(run.iterdir())
        if path.is_file() and path.suffix in OF_A_RUN and path.name not in NOT_CONTENTS
    }
    last = _last(run)
    if (last / checkpoints.MANIFEST).is_file() and (why := defect(last)) is not None:
        raise InputError("path", str(last), f"the checkpoint is broken: {why}")
    parts = {f"checkpoints/{last.name}": last} | {name.strip("/"): run / name for name in include}
    for name, folder in parts.items():
        if not folder.is_dir() or folder is not last and (folder.name != name or name.startswith(".")):
            raise InputError("include", name, f"no such folder in {run}")
        files |= {f"{name}/{below}": path for below, path in walk(folder)}
    return files


def _renew_manifest(files: Files, checkpoint: str) -> None:
    """Has a checkpoint's own manifest say what its files are now."""
    if (name := f"{checkpoint}{checkpoints.MANIFEST}") in files:
        listed = {
            n.removeprefix(checkpoint): c for n, c in files.items() if n.startswith(checkpoint) and n != name
        }
        entries = {n: asdict(entry_of(content)) for n, content in sorted(listed.items())}
        content = {"format": checkpoints.FORMAT, "files": entries}
        files[name] = (json.dumps(content, indent=2) + "\n").encode()


def _bring_backbone(files: Files, folder: Path, policy: str) -> None:
    """Has a policy name the backbone beside it; brings it there if it is elsewhere on this machine.

    Raises:
        InputError: it is gone, or only a tokeniser is elsewhere.
    """
    home = folder / policy
    config, processor = read_json(home / CONFIG), read_json(home / PREPROCESSOR)
    prefix = f"{policy}/" if policy else ""
    elsewhere = Path(config.get("vlm_model_name") or "")
    if elsewhere.is_absolute() and not (home / BACKBONE).is_dir():
        for name, path in walk(elsewhere):
            # The policy's own file holds its weights, unless LeRobot builds it from the backbone's.
            if config.get("load_vlm_weights") or path.suffix not in WEIGHTS:
                files[f"{prefix}{BACKBONE}/{name}"] = path
    has = {own for own in CONFIG_FOLDERS.values() if any(n.startswith(f"{prefix}{own}/") for n in files)}
    before = json.dumps([config, processor])
    if left := own_names(config, processor, has):
        remedy = f"it needs {left[0]}, which is not in it; put a copy into {BACKBONE}/ beside {CONFIG}"
        raise InputError("path", str(home), remedy)
    if json.dumps([config, processor]) != before:
        files[f"{prefix}{CONFIG}"] = (json.dumps(config, indent=4) + "\n").encode()
        files[f"{prefix}{PREPROCESSOR}"] = (json.dumps(processor, indent=4) + "\n").encode()
