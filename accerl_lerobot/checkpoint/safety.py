# SPDX-License-Identifier: Apache-2.0
"""Checks of files from untrusted sources: names, links, JSON and safetensors.

Checkpoints, world models and datasets may be anybody's. Nothing here runs or writes anything; a file that is
refused is named by an `InputError`. Free of torch and LeRobot.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import yaml
from safetensors import SafetensorError, safe_open

from accerl_lerobot.errors import InputError, in_one_line, shortened

_INSIDE = re.compile(r"(?![~/]|[A-Za-z]:)[^\\\x00-\x1f\x7f\ud800-\udfff]+")
_ABSOLUTE = re.compile(r"(~[^/\s]*)?/[\w.]|[A-Za-z]:[\\/]|file:|~$")


@dataclass(frozen=True)
class FileSource:
    """Where files came from, as the user named it.

    Example:
        >>> raise FileSource("policy.path", "runs/a").refuse("config.json", "it is empty; save it again")
        Traceback (most recent call last):
        accerl_lerobot.errors.InputError: policy.path='runs/a': config.json: it is empty; save it again
    """

    field: str
    value: str | None

    def refuse(self, file: str, why: str) -> InputError:
        """The error to raise: a file or a key in it, and what is wrong and what to do."""
        return InputError(self.field, self.value, f"{shortened(file)}: {why}")


def safe_join(root: Path, name: object, origin: FileSource) -> Path:
    """`root` / `name` for a name from an untrusted file; one that is not relative or leads out is refused.

    Links may point within `root`, and in the Hub's cache to its blobs.
    """
    text = str(name)
    why = unsafe_name(name)
    if why:
        raise origin.refuse(text, f"{why}; only files inside the folder are read")
    path = root / text
    _check_link(path, root, text, origin)
    return path


def _check_link(path: Path, root: Path, name: str, origin: FileSource) -> None:
    """Refuses a link that leads out of `root`; the Hub's cache keeps the content of files beside it."""
    home = Path(os.path.realpath(root))
    real = Path(os.path.realpath(path))
    inside = real.is_relative_to(home)
    if home.parent.name == "snapshots":
        blobs = home.parents[1] / "blobs"
        inside = inside or real.is_relative_to(blobs)
    if not inside:
        raise origin.refuse(name, "a link that leads out of the folder; put the file itself there")


def matching_files(root: Path, patterns: Iterable[str], origin: FileSource) -> dict[str, Path]:
    """Files below `root` whose names match a pattern, by these names; hidden ones are left out.

    A ``*`` stands for a part of one name. A link that leads out of `root` is refused.
    """
    found: dict[str, Path] = {}
    for pattern in patterns:
        for path in sorted(root.glob(pattern)):
            name = path.relative_to(root).as_posix()
            if name.startswith(".") or "/." in name:
                continue
            _check_link(path, root, name, origin)
            if path.is_file():
                found[name] = path
    return found


def leads_out(text: str) -> bool:
    """True for a text that, as the name of a file, is absolute or goes above its folder."""
    return _ABSOLUTE.match(text) is not None or ".." in re.split(r"[\\/]", text)


def texts_in(content: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Key and text of every text below a key of JSON or YAML, texts in lists included."""
    if isinstance(content, dict):
        for name, value in content.items():
            yield from texts_in(value, str(name))
    elif isinstance(content, list):
        for value in content:
            yield from texts_in(value, key)
    elif isinstance(content, str):
        yield key, content


def check_folder(folder: Path, origin: FileSource) -> None:
    """Refuses a path that is no folder, and a folder with a link that leads out."""
    if not folder.is_dir():
        hint = "a file; name the folder of a run" if folder.exists() else "no such folder"
        raise InputError(origin.field, origin.value, hint)
    for at, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(at, name)
            _check_link(path, folder, path.relative_to(folder).as_posix(), origin)
        if "wandb" in folders:
            folders.remove("wandb")  # its client links a log that lies elsewhere, and nothing here reads it


def check_name(name: object, what: str, origin: FileSource) -> None:
    """Refuses a name, such as a camera's, that cannot be one part of a path."""
    if unsafe_name(name) or "/" in str(name):
        raise origin.refuse(what, f"the name {shortened(str(name))!r} cannot be part of a path")


def read_json(path: Path, origin: FileSource) -> dict[str, Any]:
    """The mapping in a JSON file, or a YAML one by its suffix."""
    is_yaml = path.suffix == ".yaml"
    try:
        text = path.read_bytes().decode()
        content = yaml.safe_load(text) if is_yaml else json.loads(text)
    except FileNotFoundError as error:
        raise origin.refuse(path.name, "is missing; give the whole folder") from error
    except Exception as error:  # it may hold anything
        language = "YAML" if is_yaml else "JSON"
        raise origin.refuse(path.name, f"not good {language} ({in_one_line(error)})") from error
    if not isinstance(content, dict):
        raise origin.refuse(path.name, f"a mapping is wanted, not {type(content).__name__}")
    return content


@contextmanager
def opened(path: Path, origin: FileSource, framework: str = "np") -> Iterator[Any]:
    """An open safetensors file. The library compares its header with its size."""
    try:
        with safe_open(path, framework) as file:
            yield file
    except (OSError, SafetensorError) as error:
        raise origin.refuse(path.name, f"not safetensors ({in_one_line(error)}); get it again") from error


def tensor_shapes(path: Path, origin: FileSource) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Dtype and shape of each tensor of a safetensors file, by name; no tensor is read."""
    shapes = {}
    with opened(path, origin) as file:
        for name in file.keys():  # noqa: SIM118
            tensor = file.get_slice(name)
            shapes[name] = (tensor.get_dtype(), tuple(tensor.get_shape()))
    return shapes


def read_tensors(path: Path, origin: FileSource) -> Iterator[tuple[str, Any]]:
    """Name and PyTorch tensor, one after the other, of a safetensors file; NaN and infinity are refused.

    A tensor is a view of the file, so that none is in memory twice.
    """
    with opened(path, origin, "pt") as file:
        for name in file.keys():  # noqa: SIM118
            tensor = file.get_tensor(name)
            if not _finite(tensor):
                raise origin.refuse(path.name, f"{shortened(name)} holds NaN or infinity; train it again")
            yield name, tensor


def _finite(tensor: Any) -> bool:
    """True if a tensor holds neither NaN nor infinity."""
    if not tensor.is_floating_point() or not tensor.numel():
        return True
    if tensor.itemsize == 1:
        tensor = tensor.float()
    least, most = tensor.aminmax()
    return math.isfinite(least) and math.isfinite(most)


def unsafe_name(name: object) -> str:
    """The reason why a name must not be joined to a folder; empty if it may."""
    if not isinstance(name, str) or not _INSIDE.fullmatch(name):
        return "not the name of a file inside a folder"
    parts = PurePosixPath(name).parts
    if ".." in parts or not parts:
        return "it leads out of the folder"
    return ""
