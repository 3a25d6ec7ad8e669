# SPDX-License-Identifier: Apache-2.0
"""A tree of values on disk: a JSON file with its structure, and a safetensors file with its arrays.

    NAME.json           the tree: dicts, lists, tuples, numbers, texts, known kinds of things
    NAME.safetensors    its arrays and tensors, by number

Reading executes nothing. A tree may hold, beside plain values, NumPy arrays, torch tensors, and dataclasses
and named tuples that were registered with `kind`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file, save_file

from accerl_lerobot.errors import InputError, in_one_line

MARK = "$"  # key of a JSON object that stands for something JSON does not know
_KINDS: dict[str, type[Any]] = {}

State = dict[str, Any]
"""All that an object needs to go on from where it is: a tree that `save` writes."""


def kind[T](cls: type[T]) -> type[T]:
    """Class decorator: instances of this dataclass or named tuple, which has no base, may be in a tree."""
    if _KINDS.setdefault(cls.__name__, cls) is not cls:
        raise TypeError(f"two kinds are called {cls.__name__}")
    return cls


def save(path: Path, tree: Any) -> None:
    """Writes ``path.json`` and ``path.safetensors``.

    Raises:
        TypeError: the tree holds something of a kind that is not known, or a dict whose keys are no texts.
    """
    arrays: dict[str, np.ndarray] = {}
    text = json.dumps(to_json(tree, arrays))
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file(arrays, path.with_suffix(".safetensors"))
    path.with_suffix(".json").write_text(text + "\n")


def load(path: Path) -> Any:
    """Reads a file of `save`; arrays are writable and owned by the caller."""
    file = path.with_suffix(".json")
    try:
        tree = json.loads(file.read_text())
        arrays = load_file(path.with_suffix(".safetensors"))
        return from_json(tree, arrays)
    except Exception as error:  # the files may hold anything
        hint = f"not a state that accerl has saved ({in_one_line(error)}); resume from another checkpoint"
        raise InputError("checkpoint", str(file), hint) from error


def to_json(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """A tree as JSON can hold it; its arrays go into `arrays`, by number. Raises as `save` does."""
    cls: Any = type(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if cls is np.ndarray:
        return _stored(value, "array", arrays)
    if cls in (list, tuple):
        items = [to_json(part, arrays) for part in value]
        return items if cls is list else {MARK: "tuple", "items": items}
    if cls is dict:
        for key in value:
            if not isinstance(key, str) or key == MARK:
                raise TypeError(f"a dict with the key {key!r} cannot be saved")
        return {key: to_json(part, arrays) for key, part in value.items()}
    if cls in _KINDS.values():
        fields = {name: to_json(getattr(value, name), arrays) for name in cls.__annotations__}
        return {MARK: cls.__name__, "fields": fields}
    if isinstance(value, np.generic):
        return value.item()
    if cls.__module__ == "torch":
        return _stored(value.detach().cpu().numpy(), "tensor", arrays)
    raise TypeError(f"a {cls.__name__} cannot be saved")


def _stored(array: np.ndarray, mark: str, arrays: dict[str, np.ndarray]) -> dict[str, str]:
    """Put an array into `arrays`; returns the JSON object that stands for it."""
    if array.dtype.kind not in "biuf":
        raise TypeError(f"an array of {array.dtype} cannot be saved")
    name = str(len(arrays))
    arrays[name] = np.asarray(array, order="C")
    return {MARK: mark, "name": name}


def from_json(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """The tree that `to_json` was given."""
    if isinstance(value, list):
        return [from_json(part, arrays) for part in value]
    if not isinstance(value, dict):
        return value
    if MARK not in value:
        return {key: from_json(part, arrays) for key, part in value.items()}
    match value[MARK]:
        case "array":
            return arrays[value["name"]]
        case "tensor":
            import torch

            return torch.from_numpy(arrays[value["name"]])
        case "tuple":
            return tuple(from_json(part, arrays) for part in value["items"])
        case name:
            fields = from_json(value["fields"], arrays)
            return _KINDS[name](**fields)
