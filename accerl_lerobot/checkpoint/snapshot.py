# SPDX-License-Identifier: Apache-2.0
"""The state of things on disk: a JSON file that says how they are put together, beside their arrays.

    NAME.json           the tree: dicts, lists, tuples, numbers, texts, known kinds of things
    NAME.safetensors    its arrays and tensors, by number

Nothing in either is ever executed, so a file from elsewhere is at worst refused. What may be in a tree beside
plain values: NumPy arrays, torch tensors, NumPy's default generator, and dataclasses and named tuples that
were registered with `kind`.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from accerl_lerobot.errors import InputError

MARK = "$"
"""Key of a JSON object that stands for something JSON does not know."""
_KINDS: dict[str, type[Any]] = {}


def kind[T](cls: type[T]) -> type[T]:
    """Class decorator: instances of this dataclass or named tuple may be in a tree."""
    if _KINDS.setdefault(cls.__name__, cls) is not cls:
        raise TypeError(f"two kinds are called {cls.__name__}")
    return cls


def kind_named(name: str) -> type[Any] | None:
    """Type that was registered under this name; None: nothing."""
    return _KINDS.get(name)


def save(path: Path, tree: Any) -> None:
    """Writes ``path.json`` and ``path.safetensors``.

    Raises:
        TypeError: the tree holds something of a kind that is not known; names its place.
    """
    arrays: dict[str, np.ndarray] = {}
    text = json.dumps(_encode(tree, path.name, arrays))
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file(arrays, path.with_suffix(".safetensors"))
    path.with_suffix(".json").write_text(text + "\n")


def load(path: Path) -> Any:
    """Reads a file of `save`; arrays are writable and owned by the caller."""
    file = path.with_suffix(".json")
    try:
        text, arrays = file.read_text(), load_file(path.with_suffix(".safetensors"))
        return _decode(json.loads(text), arrays)
    except (OSError, ValueError, KeyError, TypeError, RecursionError, SafetensorError) as error:
        said = " ".join(str(error).split())[:160]
        remedy = f"not a state that accerl has saved ({said}); resume from another checkpoint"
        raise InputError("checkpoint", str(file), remedy) from error


def _encode(value: Any, place: str, arrays: dict[str, np.ndarray]) -> Any:
    def within(key: object, part: Any) -> Any:
        return _encode(part, f"{place}.{key}", arrays)

    def stored(array: np.ndarray) -> str:
        if array.dtype.kind not in "biuf":
            raise TypeError(f"{place}: an array of {array.dtype} cannot be saved")
        name = str(len(arrays))
        arrays[name] = np.asarray(array, order="C")
        return name

    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return {MARK: "array", "name": stored(value)}
    if type(value).__module__ == "torch":
        return {MARK: "tensor", "name": stored(value.detach().cpu().numpy())}
    if isinstance(value, np.random.Generator):
        return {MARK: "generator", "state": value.bit_generator.state}
    if type(value) is list:
        return [within(i, part) for i, part in enumerate(value)]
    if type(value) is tuple:
        return {MARK: "tuple", "items": [within(i, part) for i, part in enumerate(value)]}
    if type(value) is dict:
        if all(isinstance(key, str) for key in value) and MARK not in value:
            return {key: within(key, part) for key, part in value.items()}
        items = [[within("key", key), within(key, part)] for key, part in value.items()]
        return {MARK: "map", "items": items}
    name = type(value).__name__
    if kind_named(name) is type(value):
        names = field_names(type(value))
        return {MARK: name, "fields": {field: within(field, getattr(value, field)) for field in names}}
    raise TypeError(f"{place}: a {name} cannot be saved")


def _decode(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    if isinstance(value, list):
        return [_decode(part, arrays) for part in value]
    if not isinstance(value, dict):
        return value
    if MARK not in value:
        return {key: _decode(part, arrays) for key, part in value.items()}
    if (name := value[MARK]) in _READERS:
        return _READERS[name](value, arrays)
    cls = kind_named(name)
    if cls is None:
        raise ValueError(f"no kind of thing is called {name!r}")
    return cls(**{key: _decode(part, arrays) for key, part in value["fields"].items()})


def _tensor(value: dict[str, Any], arrays: dict[str, np.ndarray]) -> Any:
    import torch

    return torch.from_numpy(arrays[value["name"]])


def _generator(value: dict[str, Any], arrays: dict[str, np.ndarray]) -> np.random.Generator:
    generator = np.random.default_rng()
    generator.bit_generator.state = value["state"]
    return generator


_READERS: dict[str, Callable[[dict[str, Any], dict[str, np.ndarray]], Any]] = {
    "array": lambda value, arrays: arrays[value["name"]],
    "tensor": _tensor,
    "generator": _generator,
    "tuple": lambda value, arrays: tuple(_decode(part, arrays) for part in value["items"]),
    "map": lambda value, arrays: {
        _decode(key, arrays): _decode(part, arrays) for key, part in value["items"]
    },
}


def field_names(cls: type[Any]) -> tuple[str, ...]:
    """Fields of a dataclass or named tuple, in order."""
    if dataclasses.is_dataclass(cls):
        return tuple(field.name for field in dataclasses.fields(cls))
    return tuple(cls._fields)
