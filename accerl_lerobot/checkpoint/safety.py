# SPDX-License-Identifier: Apache-2.0
"""Validation of files from untrusted sources: names, sizes, JSON and safetensors.

Checkpoints, world models and datasets may be anybody's. Everything here reads little, runs nothing, writes
nothing, and refuses with an `InputError` that names the file. Free of torch and LeRobot.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import stat
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import yaml
from safetensors import SafetensorError, safe_open

from accerl_lerobot.errors import InputError

MIB = 1024**2
JSON_MOST = 4 * MIB  # bytes of a JSON file, unless it is one that is known to be larger
PART_MOST, PATH_MOST = 255, 1024  # bytes of one part of a file's name, and of all of it
PICKLES = (".bin", ".pt", ".pth", ".pkl", ".pickle", ".ckpt")
"""Endings of files that PyTorch unpickles, which may run whatever their author wished."""
REVISION = re.compile(r"[0-9a-f]{40}")
HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]{0,95}(/[A-Za-z0-9][\w.-]{0,95})?", re.ASCII)
_DRIVE = re.compile(r"[A-Za-z]:")
_ABSOLUTE = re.compile(r"(~[^/\s]*)?/[\w.]|[A-Za-z]:[\\/]|file:|~$")
_CONTROL = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")


@dataclass(frozen=True)
class FileSource:
    """Where files came from, as the user named it.

    Example:
        >>> raise Origin("policy.path", "runs/a").refuse("config.json", "it is empty; save it again")
        Traceback (most recent call last):
        accerl_lerobot.errors.InputError: policy.path='runs/a': config.json: it is empty; save it again
    """

    field: str
    value: str | None

    def refuse(self, file: str, why: str) -> InputError:
        """The error to raise: a file or a key in it, and what is wrong and what to do."""
        return InputError(self.field, self.value, f"{_shown(file)}: {why}")


def safe_join(root: Path, name: object, origin: FileSource) -> Path:
    """`root` / `name` for a name from an untrusted file; one that is not relative or leads out is refused.

    Links may point within `root`, and in the Hub's cache to its blobs.
    """
    if why := unsafe_name(name):
        raise origin.refuse(str(name)[:PATH_MOST], f"{why}; only files inside the folder are read")
    path = root / str(name)
    _check_link(path, root, str(name), origin)
    return path


def _check_link(path: Path, root: Path, name: str, origin: FileSource) -> None:
    try:
        real, home = path.resolve(), root.resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise origin.refuse(name, "its links go in a circle; put the file itself there") from error
    homes = [home]
    if home.parent.name == "snapshots" and re.match(r"(models|datasets)--", home.parent.parent.name):
        homes.append(home.parent.parent / "blobs")
    if not any(real.is_relative_to(home) for home in homes):
        raise origin.refuse(name, "a link that leads out of the folder; put the file itself there")


def matching_files(root: Path, patterns: Iterable[str], origin: FileSource) -> dict[str, Path]:
    """Files below `root` whose names match a pattern, by these names; hidden ones are left out.

    A ``*`` stands for a part of one name. A link that leads out of `root` is refused.
    """
    found: dict[str, Path] = {}
    for path in (path for pattern in patterns for path in sorted(root.glob(pattern))):
        name = path.relative_to(root).as_posix()
        if not any(part.startswith(".") for part in name.split("/")):
            _check_link(path, root, name, origin)
            if path.is_file():
                found[name] = path
    return found


def leads_out(text: str) -> bool:
    """True for a text that, as the name of a file, is absolute or goes above its folder."""
    return _ABSOLUTE.match(text) is not None or ".." in re.split(r"[\\/]", text)


def texts_in(content: Any) -> Iterator[tuple[dict[str, Any], str, str]]:
    """(mapping, key, text) of every text below a key of JSON or YAML, those in lists included."""
    parts, seen = [content], set()
    while parts:
        part = parts.pop()
        if id(part) in seen or not isinstance(part, dict):
            continue
        seen.add(id(part))
        for key, value in part.items():
            values = [value]
            while values:
                value = values.pop()
                if isinstance(value, list) and id(value) not in seen:
                    seen.add(id(value))
                    values += value
                elif isinstance(value, str):
                    yield part, str(key), value
                elif isinstance(value, dict):
                    parts.append(value)


def check_folder(folder: Path, origin: FileSource) -> None:
    """Refuses what is no folder, or has a link that leads out, a pipe or a device."""
    if not folder.is_dir():
        hint = "a file; name the folder of a run" if folder.exists() else "no such folder"
        raise InputError(origin.field, origin.value, hint)
    for at, folders, files in os.walk(folder):
        for path in (Path(at, name) for name in (*folders, *files)):
            name = path.relative_to(folder).as_posix()
            _check_link(path, folder, name, origin)
            with contextlib.suppress(FileNotFoundError):  # the run may still be going on
                if not path.is_dir() and not stat.S_ISREG(path.stat().st_mode):
                    raise origin.refuse(name, "neither a file nor a folder; remove it")
        if Path(at) == folder and "wandb" in folders:
            folders.remove("wandb")  # its client links a log that lies elsewhere, and nothing here reads it


def check_name(name: object, what: str, origin: FileSource) -> None:
    """A name that will become part of a path, such as a camera's; more than one part is refused."""
    why = unsafe_name(name) or ("it has a slash in it" if "/" in str(name) else "")
    if why:
        raise origin.refuse(what, f"the name {_shown(str(name))!r} cannot be part of a path: {why}")


def file_size(path: Path, origin: FileSource) -> int:
    """Bytes of a regular file; a pipe or a device is refused, since reading it may never end."""
    try:
        found = path.stat()
    except (OSError, ValueError) as error:
        raise origin.refuse(path.name, "is missing; give the whole folder") from error
    if not stat.S_ISREG(found.st_mode):
        raise origin.refuse(path.name, "not a regular file; give the whole folder")
    return found.st_size


def read_json(path: Path, origin: FileSource, most: int = JSON_MOST) -> dict[str, Any]:
    """The mapping in a JSON file, or a YAML one by its suffix, of at most `most` bytes."""
    parse, language = (yaml.safe_load, "YAML") if path.suffix == ".yaml" else (json.loads, "JSON")
    if (size := file_size(path, origin)) > most:
        hint = f"{size} bytes, more than the {most} that such a file may have; it is not what it says"
        raise origin.refuse(path.name, hint)
    try:
        with path.open("rb") as file:
            content = parse(file.read(most + 1).decode())
    except OSError as error:
        raise origin.refuse(path.name, f"cannot be read ({error.strerror})") from error
    except (RecursionError, ValueError, yaml.YAMLError) as error:
        why = "it is nested too deeply" if isinstance(error, RecursionError) else brief(error)
        raise origin.refuse(path.name, f"not good {language} ({why})") from error
    if not isinstance(content, dict):
        raise origin.refuse(path.name, f"a mapping is wanted, not {type(content).__name__}")
    return content


@contextlib.contextmanager
def opened(path: Path, origin: FileSource, framework: str = "np") -> Iterator[Any]:
    """A safetensors file, whose header safetensors itself compares with the file."""
    file_size(path, origin)
    try:
        with safe_open(path, framework) as file:
            yield file
    except (OSError, SafetensorError) as error:
        raise origin.refuse(path.name, f"not safetensors ({brief(error)}); get it again") from error


def tensor_shapes(path: Path, origin: FileSource) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Dtype and shape by name of what a safetensors file holds; no tensor is read."""
    with opened(path, origin) as file:
        slices = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118
        return {name: (one.get_dtype(), tuple(one.get_shape())) for name, one in slices.items()}


def read_tensors(path: Path, origin: FileSource) -> Iterator[tuple[str, Any]]:
    """Name and PyTorch tensor, one after the other, of a safetensors file; NaN and infinity are refused.

    A tensor is a view of the file, so that none is in memory twice.
    """
    with opened(path, origin, "pt") as file:
        for name in file.keys():  # noqa: SIM118
            tensor = file.get_tensor(name)
            if not _finite(tensor):
                raise origin.refuse(path.name, f"{_shown(name)} holds NaN or infinity; train it again")
            yield name, tensor


def _finite(tensor: Any) -> bool:
    if not tensor.is_floating_point() or not tensor.numel():
        return True
    least, most = (tensor.float() if tensor.itemsize == 1 else tensor).aminmax()
    return math.isfinite(least) and math.isfinite(most)


def check_not_pickled(folder: Path, weights: str, origin: FileSource) -> None:
    """Refuses a folder without `weights`, and says so where there are only pickled ones."""
    if (folder / weights).is_file():
        return
    pickled = sorted(path.name for path in folder.iterdir() if path.suffix in PICKLES)
    if pickled:
        hint = f"is missing, and {pickled[0]} is a pickle, which may run code when it is loaded; convert it"
        raise origin.refuse(weights, f"{hint} to safetensors where you trust it: save_pretrained does")
    raise origin.refuse(weights, "is missing; give a folder with the weights as safetensors")


def brief(error: BaseException) -> str:
    """An error's words on one line, not more than a line's worth."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 160 else text[:159] + "…"


def unsafe_name(name: object) -> str:
    """The reason why a name must not be joined to a folder; empty if it may."""
    if not isinstance(name, str) or not name:
        return "not a name"
    if _CONTROL.search(name):
        return "it has control characters, or is not good Unicode"
    if len(name.encode()) > PATH_MOST or any(len(part.encode()) > PART_MOST for part in name.split("/")):
        return "too long"
    if "\\" in name or _DRIVE.match(name):
        return "a Windows path"
    if name.startswith(("/", "~")):
        return "it begins outside the folder"
    parts = PurePosixPath(name).parts
    if ".." in parts or not parts:
        return "it leads out of the folder"
    return ""


def _shown(text: str) -> str:
    return text if len(text) <= 80 else f"{text[:79]}…"
