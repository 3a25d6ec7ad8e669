# SPDX-License-Identifier: Apache-2.0
"""Checkpoints in LeRobot's layout, visible only when complete.

    checkpoints/NNNNNN/
      pretrained_model/     loaded by stock LeRobot
      training_state/       needed to resume, see `snapshot`; `training_step.json` is LeRobot's
      world_model/          the world model of imagined environments, where it learns in the run
      config.yaml           the run's config
      manifest.json         size and SHA-256 of all of these
    checkpoints/last        the newest

A checkpoint is written under another name, its manifest last, and renamed, so that a reader never finds half
of one. Every byte is checked before a run resumes from it.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from accerl_lerobot.checkpoint.safety import FileSource, leads_out, read_json, safe_join, texts_in
from accerl_lerobot.errors import InputError, in_one_line
from accerl_lerobot.fault_points import fault_point

PRETRAINED, TRAINING_STATE, WORLD_MODEL = "pretrained_model", "training_state", "world_model"
CHECKPOINTS, DEMOS = "checkpoints", "demos"
CONFIG, SUMMARY = "config.yaml", "summary.json"
MANIFEST, LAST = "manifest.json", "last"
KEEP = 2  # newest checkpoints that can be resumed from; the others keep their policies only
WRITING = ".writing-"  # how names of folders begin that are not complete, or replaced
RUN_STATE, WEIGHTS = "run", "weights"
"""Names of states in `TRAINING_STATE`: the progress of the run, and the exact trained weights."""
STEP = "training_step.json"
FORMAT = 9  # format of the manifest and the training state; another one is refused
AWAY = "LOCAL"  # replaces the folders above a file of the machine that pushed it
BACKBONE = "backbone"  # folder beside the weights with the vision-language backbone's config and tokenisers
FAST = f"{BACKBONE}/fast"  # folder with the tokeniser of actions, where a policy has one
CONFIG_FOLDERS = {"vlm_model_name": BACKBONE, "text_tokenizer_name": BACKBONE, "action_tokenizer_name": FAST}
"""Field of a LeRobot policy config that names files → our folder for them."""
STEP_FOLDERS = {
    "tokenizer_processor": ("tokenizer_name", BACKBONE),
    "action_tokenizer_processor": ("action_tokenizer_name", FAST),
}
"""LeRobot processor step → its option that names files, and our folder for them."""
PREPROCESSOR = "policy_preprocessor.json"
NAMING_BACKBONE = ("config.json", PREPROCESSOR)  # files of a policy that name its backbone or tokenisers
BACKBONE_FILES = (
    "config.json", "*_config.json", "tokenizer.json", "vocab.json", "vocab.txt", "merges.txt", "*.model",
    "special_tokens_map.json", "added_tokens.json", "chat_template.*", "processing_*.py",
)  # fmt: skip
"""Files of a backbone's folder, without its weights."""
BACKBONE_WEIGHTS = ("model*.safetensors", "model.safetensors.index.json")
NAMING = ("config.json", "*_config.json", "*processor.json", "info.json", "config.yaml")
"""Files of a checkpoint, dataset or run whose texts may be taken for names of other files."""
NOT_READ = "train_config.json"  # LeRobot's record of a training
RECORDED = ("pretrained_path", "_name_or_path", "name_or_path", "special_tokens_map_file")
"""Keys that say where something once was. Nothing reads it there."""
PATTERNS = ("targets",)  # keys of regular expressions, in which two dots are no folder


def save_checkpoint(checkpoints: Path, write: Callable[[Path], int]) -> Path:
    """Writes one checkpoint and points ``last`` at it; both survive a loss of power once this returns.

    `write` creates and fills ``pretrained_model``, and other folders as needed, in the folder it is given,
    and returns the number of updates behind what it wrote; a checkpoint of that version is replaced. If it
    raises, older checkpoints and ``last`` are as before.
    """
    checkpoints.mkdir(parents=True, exist_ok=True)
    _tidy(checkpoints)
    temporary = checkpoints / f"{WRITING}{os.getpid()}"
    try:
        temporary.mkdir()
        fault_point("driver.save")
        version = write(temporary)
        final = checkpoints / f"{version:06d}"
        fault_point("driver.files")
        relocate(temporary / PRETRAINED, final / PRETRAINED)
        (temporary / TRAINING_STATE).mkdir(exist_ok=True)
        (temporary / TRAINING_STATE / STEP).write_text(json.dumps({"step": version}, indent=2) + "\n")
        write_manifest(temporary)
        for path in sorted(temporary.rglob("*"), reverse=True):
            _sync(path)
        _sync(temporary)
        if final.exists():
            final.rename(checkpoints / f"{WRITING}{final.name}")
        temporary.rename(final)
        fault_point("driver.renamed", final)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    _point_at(final)
    _tidy(checkpoints)
    return final


def _tidy(checkpoints: Path) -> None:
    """Removes the incomplete folders that a killed process has left."""
    for partial in checkpoints.glob(f"{WRITING}*"):
        shutil.rmtree(partial)


def _point_at(checkpoint: Path) -> None:
    link = checkpoint.parent / ".last-new"
    link.unlink(missing_ok=True)
    link.symlink_to(checkpoint.name)
    link.replace(checkpoint.parent / LAST)
    _sync(checkpoint.parent)


def go_back_to(checkpoint: Path) -> None:
    """Makes a checkpoint the last one. The policies of later checkpoints are kept as ``abandoned-NNNNNN``."""
    version = int(checkpoint.name)
    for later in _numbered(checkpoint.parent):
        if int(later.name) > version:
            aside = later.with_name(f"abandoned-{later.name}")
            shutil.rmtree(aside, ignore_errors=True)
            later.rename(aside)
            shutil.rmtree(aside / TRAINING_STATE, ignore_errors=True)
    _point_at(checkpoint)


def has_checkpoint(checkpoints: Path) -> bool:
    """True if there is a checkpoint, broken or not."""
    _tidy(checkpoints)
    return bool(_numbered(checkpoints))


def write_atomically(path: Path, text: str) -> None:
    """Replaces a file: readers find the old one or the new one, even after a loss of power."""
    new = path.with_name(f".{path.name}.new")
    new.write_text(text)
    _sync(new)
    new.replace(path)
    _sync(path.parent)


def write_json(path: Path, values: Any) -> None:
    """Replaces a JSON file as `write_atomically` does."""
    text = json.dumps(values, indent=2)
    write_atomically(path, f"{text}\n")


def write_manifest(directory: Path) -> None:
    """Writes the size and SHA-256 of every file in a new checkpoint."""
    files = {}
    for path in sorted(directory.rglob("*")):
        if path.is_file():
            name = str(path.relative_to(directory))
            files[name] = {"size": path.stat().st_size, "sha256": digest(path)}
    manifest = {"format": FORMAT, "files": files}
    (directory / MANIFEST).write_text(json.dumps(manifest, indent=2) + "\n")


def resumable(directory: Path) -> bool:
    """True if a checkpoint has its training state."""
    return (directory / TRAINING_STATE / f"{RUN_STATE}.json").is_file()


def defect(directory: Path) -> str | None:
    """The first difference between a checkpoint and its manifest; None if there is no difference.

    The training state does not count where it was removed.
    """
    source = FileSource("config_path", str(directory))
    try:
        manifest = read_json(directory / MANIFEST, source)
        if manifest["format"] != FORMAT:
            return f"its format is {manifest['format']}, and this accerl reads {FORMAT}"
        for name, written in manifest["files"].items():
            path = safe_join(directory, name, source)
            if name.startswith(f"{TRAINING_STATE}/") and not resumable(directory):
                continue
            if not path.is_file():
                return f"{name} is missing"
            if path.stat().st_size != written["size"] or digest(path) != written["sha256"]:
                return f"{name} is not what was written"
    except Exception as error:  # it may hold anything
        return f"its {MANIFEST} is broken ({in_one_line(error)})"
    return None


def newest_whole(checkpoints: Path, wanted: str = LAST) -> tuple[Path, list[str]]:
    """The checkpoint to resume from: `wanted`, or the newest good one before it.

    Returns:
        Its folder, and why each later one was skipped: it is broken, or has no training state any more.
    """
    _tidy(checkpoints)
    numbers = _numbered(checkpoints)
    if wanted != LAST:
        asked = checkpoints / wanted
        if asked not in numbers:
            names = ", ".join(path.name for path in numbers) or "none"
            raise InputError("config_path", str(asked), f"no such checkpoint; there are {names}")
        numbers = numbers[: numbers.index(asked) + 1]
    skipped: list[str] = []
    for path in reversed(numbers):
        why = defect(path)
        if why is None and not resumable(path):
            why = f"only the newest {KEEP} keep their training state"
        if why is None:
            return path, skipped
        skipped.append(f"{path.name}: {why}")
    hint = f"no checkpoint here can be resumed ({'; '.join(skipped) or 'there is none'})"
    raise InputError("config_path", str(checkpoints), f"{hint}; start a new run from a policy: --policy.path")


def saved_version(state: Path) -> int:
    """Number of updates behind a ``training_state``."""
    record = json.loads((state / STEP).read_text())
    return int(record["step"])


def prune(checkpoints: Path, *, needed: str | None = None, every: int = 0) -> None:
    """Removes all but the newest `KEEP` checkpoints; of those due `every` so many updates the policies stay.

    The files of the one named `needed` stay too, although it cannot be resumed from any more: an inference
    replica that is lost starts again where all workers did.
    """
    former = 0
    for checkpoint in _numbered(checkpoints)[:-KEEP]:
        # Without this file the others do not count, even where their removal is interrupted.
        (checkpoint / TRAINING_STATE / f"{RUN_STATE}.json").unlink(missing_ok=True)
        version = int(checkpoint.name)
        by_number = every > 0 and version // every > former // every
        former = version
        removed = checkpoint / TRAINING_STATE if by_number else checkpoint
        if checkpoint.name != needed and removed.exists():
            shutil.rmtree(removed)


def _numbered(checkpoints: Path) -> list[Path]:
    """All checkpoints, the oldest first."""
    numbered = [path for path in checkpoints.glob("*") if path.name.isdigit()]
    return sorted(numbered, key=lambda path: int(path.name))


def digest(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def relocate(directory: Path, home: Path) -> None:
    """Points a checkpoint's config and processors at the files in its own folder, which will be `home`.

    LeRobot 0.6.1 stores a local backbone by absolute path. Names on the Hub are left as they are.
    """
    for path, content, places in _naming_own_backbone(directory):
        for fields, key, folder in places:
            fields[key] = str((home / folder).absolute())
        path.write_text(json.dumps(content, indent=4) + "\n")


def displaced(directory: Path) -> bool:
    """True if a checkpoint has a backbone folder of its own and its files name one that does not exist."""
    for _, _, places in _naming_own_backbone(directory):
        for fields, key, _ in places:
            if not Path(fields[key]).is_dir():
                return True
    return False


Place = tuple[dict[str, Any], str, str]  # mapping, its key that may name a folder, and our folder for that


def _naming_own_backbone(directory: Path) -> Iterator[tuple[Path, dict[str, Any], list[Place]]]:
    """Files of a checkpoint with a backbone of its own, their contents, and the places in them that name it.

    It is named by its absolute path, or as a folder beside the file.
    """
    if not (directory / BACKBONE).is_dir():
        return
    for file in NAMING_BACKBONE:
        path = directory / file
        content = json.loads(path.read_text())
        places = []
        for fields, key, folder in places_of_names(content):
            name = fields.get(key)
            if name and (name == folder or Path(name).is_absolute()):
                places.append((fields, key, folder))
        yield path, content, places


def check_names(folder: Path, origin: FileSource) -> None:
    """Refuses files from elsewhere that name a file outside their own folder.

    The name of a backbone or tokeniser that lies in the folder is accepted: it is not read.
    """
    for path in sorted(folder.rglob("*")):
        names_files = path.name != NOT_READ and any(map(path.match, NAMING))
        if not names_files or not path.is_file():
            continue
        content = read_json(path, origin)
        for fields, key, own in places_of_names(content):
            if path.parent == folder and (folder / own).is_dir():
                fields.pop(key, None)
        for key, text in texts_in(content):
            if key not in (*RECORDED, *PATTERNS) and leads_out(text):
                name = path.relative_to(folder).as_posix()
                why = f"{text[:80]!r} is a place on this machine, which files from elsewhere may not name"
                raise origin.refuse(f"{name}: {key}", f"{why}; a copy of a backbone goes into {BACKBONE}/")


def places_of_names(content: dict[str, Any]) -> list[Place]:
    """Places where a policy's file, one of `NAMING_BACKBONE`, may name a folder."""
    places = [(content, key, folder) for key, folder in CONFIG_FOLDERS.items()]
    for step in content.get("steps", []):
        option = STEP_FOLDERS.get(step.get("registry_name"))
        if option is not None:
            places.append((step["config"], *option))
    return places
