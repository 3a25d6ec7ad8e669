# SPDX-License-Identifier: Apache-2.0
"""Checkpoints in LeRobot's layout, visible only when whole.

    checkpoints/NNNNNN/
      pretrained_model/     what stock LeRobot loads
      training_state/       what a run needs to go on, see `snapshot`; `training_step.json` is LeRobot's
      world_model/          the world model in use, where one was promoted in the run
      config.yaml           the run's
      manifest.json         size and SHA-256 of all of these
    checkpoints/last        the newest

A checkpoint is written under another name, its manifest last, and renamed, so that a reader never finds half
of one. Whoever goes on from one looks at every byte first.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from accerl_lerobot.checkpoint.safety import Origin, safe_join
from accerl_lerobot.errors import InputError
from accerl_lerobot.fault_points import reach

PRETRAINED, TRAINING_STATE, WORLD_MODEL = "pretrained_model", "training_state", "world_model"
CHECKPOINTS = "checkpoints"
"""Folder of a run's."""
DEMOS = "demos"
"""Folder of the demonstrations that a run has recorded for itself."""
CONFIG, SUMMARY = "config.yaml", "summary.json"
"""Files of a run: how it is to be, and what came of it once it has ended."""
MANIFEST, LAST = "manifest.json", "last"
WRITING, REPLACED = ".writing-", ".replaced-"
"""How the names of checkpoints begin that are being written, and of those that are being replaced."""
RUN_STATE, WEIGHTS = "run", "weights"
"""Names of states in `TRAINING_STATE`: how far the run has come; what is trained, exactly as it is."""
STEP = "training_step.json"
"""LeRobot's file of how far it has come."""
FORMAT = 2
"""Format of the manifest and the training state; another one is refused."""
UNREADABLE = (OSError, ValueError, KeyError, TypeError, AttributeError)
"""Exceptions of reading a broken manifest."""
AWAY = "LOCAL"
"""Stands for the folders above a file that was on the pusher's machine."""
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


def save_checkpoint(checkpoints: Path, write: Callable[[Path], int]) -> Path:
    """Writes one checkpoint and points ``last`` at it; both survive a loss of power once this returns.

    Args:
        checkpoints: the run's ``checkpoints`` folder.
        write: creates and fills ``pretrained_model``, and what else there is to be, in the folder it is
            given, and returns the version of what it wrote, the number of updates behind it.

    Returns:
        ``checkpoints/NNNNNN``; one of that version that was there before is replaced, since what goes with
        the same weights need not be the same.

    Raises:
        Exception: whatever `write` raises; older checkpoints and ``last`` are as before.
    """
    checkpoints.mkdir(parents=True, exist_ok=True)
    _tidy(checkpoints)
    temporary = checkpoints / f"{WRITING}{os.getpid()}"
    try:
        temporary.mkdir()
        reach("driver.save")
        version = write(temporary)
        final = checkpoints / f"{version:06d}"
        reach("driver.files")
        relocate(temporary / PRETRAINED, final / PRETRAINED)
        (temporary / TRAINING_STATE).mkdir(exist_ok=True)
        step = json.dumps({"step": version}, indent=2)
        (temporary / TRAINING_STATE / STEP).write_text(step + "\n")
        write_manifest(temporary)
        _make_durable(temporary)
        if final.exists():
            final.rename(checkpoints / f"{REPLACED}{final.name}")
        temporary.rename(final)
        reach("driver.renamed", final)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    _point_at(final)
    _tidy(checkpoints)
    return final


def _tidy(checkpoints: Path) -> None:
    """Removes what a process that was killed has left half written, and brings back what it had put aside."""
    for left in checkpoints.glob(f"{WRITING}*"):
        shutil.rmtree(left)
    for aside in checkpoints.glob(f"{REPLACED}*"):
        place = checkpoints / aside.name.removeprefix(REPLACED)
        if place.exists():
            shutil.rmtree(aside)
        else:
            aside.rename(place)


def _point_at(checkpoint: Path) -> None:
    """Makes it the last one."""
    link = checkpoint.parent / ".last-new"
    link.unlink(missing_ok=True)
    link.symlink_to(checkpoint.name)
    link.replace(checkpoint.parent / LAST)
    _sync(checkpoint.parent)


def go_back_to(checkpoint: Path) -> None:
    """Makes it the last one: of what came after it the policy is kept, as ``abandoned-NNNNNN``."""
    for later in _numbered(checkpoint.parent):
        if int(later.name) > int(checkpoint.name):
            aside = later.with_name(f"abandoned-{later.name}")
            shutil.rmtree(aside, ignore_errors=True)
            later.rename(aside)
            shutil.rmtree(aside / TRAINING_STATE, ignore_errors=True)
    _point_at(checkpoint)


def begun(checkpoints: Path) -> bool:
    """True if there is a checkpoint, whole or not."""
    if checkpoints.is_dir():
        _tidy(checkpoints)
    return bool(_numbered(checkpoints))


def write_atomically(path: Path, text: str) -> None:
    """Replaces a file in one stroke: readers find the old one or the new one, even after a loss of power."""
    new = path.with_name(f".{path.name}.new")
    new.write_text(text)
    _sync(new)
    new.replace(path)
    _sync(path.parent)


def write_manifest(directory: Path) -> None:
    """Writes the size and SHA-256 of every file in a checkpoint, in one stroke."""
    files = {
        str(path.relative_to(directory)): {"size": path.stat().st_size, "sha256": digest(path)}
        for path in sorted(directory.rglob("*"))
        if path.is_file() and path.relative_to(directory).parts[0] not in (MANIFEST, f".{MANIFEST}.new")
    }
    _write_manifest(directory, {"format": FORMAT, "files": files})


def defect(directory: Path) -> str | None:
    """Why a checkpoint is not what was written; None if it is, byte by byte."""
    try:
        manifest = _manifest(directory)
        if manifest["format"] != FORMAT:
            return f"its format is {manifest['format']}, and this accerl reads {FORMAT}"
        files = {str(name): (int(v["size"]), str(v["sha256"])) for name, v in manifest["files"].items()}
    except FileNotFoundError:
        return f"it has no {MANIFEST}"
    except UNREADABLE as error:
        return f"its {MANIFEST} is broken ({' '.join(str(error).split())[:80]})"
    for name, (size, expected) in files.items():
        try:
            path = safe_join(directory, name, Origin("config_path", str(directory)))
        except InputError:
            return f"its {MANIFEST} names {name!r}, outside of it"
        if not path.is_file():
            return f"{name} is missing"
        if path.stat().st_size != size:
            return f"{name} has {path.stat().st_size} bytes, not {size}"
        if digest(path) != expected:
            return f"{name} is not what was written"
    return None


def newest_whole(checkpoints: Path, wanted: str = LAST) -> tuple[Path, list[str]]:
    """The checkpoint to go on from.

    Args:
        checkpoints: the run's folder of them.
        wanted: which one; where it is broken, or its training state was let go, the newest before it.

    Returns:
        Its folder, and why each that was passed over was.

    Raises:
        InputError: none is left.
    """
    _tidy(checkpoints)
    numbers = _numbered(checkpoints)
    if wanted != LAST:
        if checkpoints / wanted not in numbers:
            names = ", ".join(p.name for p in numbers) or "none"
            raise InputError(
                "config_path", str(checkpoints / wanted), f"no such checkpoint; there are {names}"
            )
        numbers = numbers[: numbers.index(checkpoints / wanted) + 1]
    passed: list[str] = []
    for path in reversed(numbers):
        why = defect(path)
        if why is None and f"{TRAINING_STATE}/{RUN_STATE}.json" not in _manifest(path)["files"]:
            why = "its training state was not kept, see save_keep"
        if why is None:
            return path, passed
        passed.append(f"{path.name}: {why}")
    said = "; ".join(passed) or "there is none"
    remedy = (
        f"no checkpoint here can be gone on from ({said}); begin a new run from a policy, with --policy.path"
    )
    raise InputError("config_path", str(checkpoints), remedy)


def saved_version(state: Path) -> int:
    """Updates behind what a ``training_state`` holds."""
    return int(json.loads((state / STEP).read_text())["step"])


def let_go(checkpoints: Path, keep: int, needed: str | None = None) -> None:
    """Removes the training state of all but the newest `keep` checkpoints; their policies stay.

    Args:
        checkpoints: their folder.
        keep: how many.
        needed: name of one more whose weights are spared, although it cannot be gone on from any more: a
            service that is lost begins again where all workers did.
    """
    having = [path for path in _numbered(checkpoints) if (path / TRAINING_STATE).is_dir()]
    for path in having[: max(0, len(having) - keep)]:
        # First, or one half removed would count as broken. What is left is not read, let alone vouched for.
        with contextlib.suppress(*UNREADABLE):  # a broken manifest says nothing of it
            manifest = _manifest(path)
            left = {k: v for k, v in manifest["files"].items() if Path(k).parts[0] != TRAINING_STATE}
            if left != manifest["files"]:
                _write_manifest(path, manifest | {"files": left})
        if path.name != needed:
            shutil.rmtree(path / TRAINING_STATE)
            continue
        for file in (path / TRAINING_STATE).iterdir():
            if file.stem != WEIGHTS:
                shutil.rmtree(file) if file.is_dir() else file.unlink()


def _numbered(checkpoints: Path) -> list[Path]:
    """The oldest first."""
    return sorted((p for p in checkpoints.glob("*") if p.name.isdigit()), key=lambda p: int(p.name))


def _manifest(directory: Path) -> Any:
    return json.loads((directory / MANIFEST).read_text())


def _write_manifest(directory: Path, manifest: dict[str, Any]) -> None:
    write_atomically(directory / MANIFEST, json.dumps(manifest, indent=2) + "\n")


def digest(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _make_durable(directory: Path) -> None:
    """Has the disk hold all files in a folder, and their names."""
    for path in sorted(directory.rglob("*"), reverse=True):
        _sync(path)
    _sync(directory)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


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
    """True if a checkpoint has a backbone folder of its own and its files name one that is not there."""
    if not (directory / BACKBONE).is_dir():
        return False
    return any(not Path(fields[key]).is_dir() for fields, key, _ in _local_names(*_named(directory)))


def _named(directory: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    config = json.loads((directory / "config.json").read_text())
    return config, json.loads((directory / PREPROCESSOR).read_text())


def _local_names(config: dict[str, Any], processor: dict[str, Any]) -> list[tuple[dict[str, Any], str, str]]:
    """Where a checkpoint's files name a folder of this machine, or by its bare name one beside them, as they
    do on the Hub: (mapping, key, our folder for it)."""
    named = [(place, place[0].get(place[1]) or "") for place in places_of_names(config, processor)]
    return [place for place, name in named if Path(name).is_absolute() or name == place[2]]


def places_of_names(
    config: dict[str, Any], processor: dict[str, Any]
) -> list[tuple[dict[str, Any], str, str]]:
    """Where a policy's files may name a folder: (mapping, key, our folder for it)."""
    places = [(config, key, folder) for key, folder in CONFIG_FOLDERS.items()]
    for step in processor.get("steps", []):
        if (option := STEP_FOLDERS.get(step.get("registry_name"))) is not None:
            places.append((step["config"], *option))
    return places
