# SPDX-License-Identifier: Apache-2.0
"""Messages as bytes: a skeleton that says how they are put together, their arrays, their other values.

    0    two sizes, of the skeleton and of the values
    8    the skeleton: JSON, the same for all messages of equal structure
         each array, at a multiple of 64 bytes
         the values: a JSON list of all numbers, texts and None, in the order of the skeleton

A skeleton names kinds of things (see `snapshot.kind`), fields, keys, dtypes and shapes, so all offsets follow
from it and none is read. Taking one apart is paid for once: messages between workers have few structures, and
those are remembered. Nothing that is read is ever executed; what does not fit is a `DamagedMessageError`.
"""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from accerl_lerobot.checkpoint.snapshot import field_names, kind_named
from accerl_lerobot.transport.nameless import aligned

SIZES = struct.Struct("<II")
REMEMBERED = 1024
"""Structures that are remembered; a process that has met more begins anew."""
NUMBERS = "biuf"
"""Dtypes that travel, see `numpy.dtype.kind`: none of them holds Python objects."""

VALUE, ARRAY, SCALAR, LIST, TUPLE, DICT, KIND = range(7)
"""The first entry of each node of a skeleton; a value is no more than that."""
_VALUES = frozenset((bool, int, float, str, type(None)))
_from_json = json.JSONDecoder().raw_decode
_to_json = json.JSONEncoder(separators=(",", ":"), check_circular=False).encode

Shaped = tuple[tuple[int, ...], np.dtype[Any]]
Next = Callable[[], Any]
Build = Callable[[Next, Next], Any]
"""From the next value and the next array to a part of a message."""


class DamagedMessageError(ValueError):
    """Bytes that no `Encoded.write` has written."""


class Layout(NamedTuple):
    """Common layout of all messages of one structure, as their writer sees it."""

    skeleton: bytes
    offsets: list[int]
    """Offsets of the arrays."""
    end: int
    """Where the values begin."""


class Plan(NamedTuple):
    """The same as who reads them sees it."""

    arrays: list[tuple[tuple[int, ...], np.dtype[Any], int]]
    """Shape, dtype and offset of each."""
    end: int
    values: int
    build: Build


class Encoded(NamedTuple):
    """A message that is ready to be written; its arrays are still the sender's.

    Example:
        >>> encoded = encode([Request(observation={"task": "push"}, noise_seed=7)])
        >>> buffer = bytearray(encoded.size)
        >>> encoded.write(buffer, 0)
        >>> decode(buffer, 0, encoded.size)
        [Request(observation={'task': 'push'}, noise_seed=7, explore=True)]
    """

    layout: Layout
    values: bytes
    arrays: list[np.ndarray]

    @property
    def size(self) -> int:
        """Bytes that it takes."""
        return self.layout.end + len(self.values)

    def write(self, buffer: Any, start: int) -> None:
        """Copies it into a writable buffer from `start` on, a multiple of `nameless.ALIGNMENT`."""
        skeleton, offsets, end = self.layout
        head = start + SIZES.size
        SIZES.pack_into(buffer, start, len(skeleton), len(self.values))
        buffer[head : head + len(skeleton)] = skeleton
        for array, offset in zip(self.arrays, offsets, strict=True):
            np.ndarray(array.shape, array.dtype, buffer, start + offset)[...] = array
        buffer[start + end : start + end + len(self.values)] = self.values


def encode(message: Any) -> Encoded:
    """Takes a message apart: lists, tuples, dicts with texts as keys, known kinds, arrays, plain values.

    Raises:
        TypeError: it holds something else.
    """
    structure: list[Any] = []
    values: list[Any] = []
    arrays: list[np.ndarray] = []
    try:
        _take_apart(message, structure, values, arrays)
    except RecursionError:
        raise TypeError("what holds itself cannot be sent") from None
    key = tuple(structure)
    layout = _layouts.get(key)
    if layout is None:
        layout = _remember(_layouts, key, _lay_out(message, arrays))
    return Encoded(layout, _to_json(values).encode(), arrays)


def decode(buffer: Any, start: int, size: int, *, copy: bool = True) -> Any:
    """The message that was written.

    Args:
        buffer: that holds it, among other things.
        start: where it begins.
        size: bytes that it takes.
        copy: False: its arrays are views of the buffer.

    Raises:
        DamagedMessageError: this is no message, or not all of one.
    """
    try:
        if not 0 <= start <= start + size <= len(buffer):
            raise ValueError(f"{size} bytes from {start} on are not in a buffer of {len(buffer)}")
        if size < SIZES.size:
            raise ValueError("not even its sizes")
        head, count = start + SIZES.size, SIZES.unpack_from(buffer, start)
        if SIZES.size + count[0] > size:
            raise ValueError(f"a skeleton of {count[0]} bytes in {size}")
        skeleton = bytes(buffer[head : head + count[0]])
        plan = _plans.get(skeleton)
        if plan is None:
            plan = _remember(_plans, skeleton, _plan(skeleton))
        if plan.end + count[1] != size:
            raise ValueError(f"{size} bytes where its skeleton and values take {plan.end + count[1]}")
        text = str(buffer[start + plan.end : start + size], "utf-8")
        values, end = _from_json(text)
        fits = type(values) is list and len(values) == plan.values and end == len(text)
        if not (fits and _VALUES.issuperset(map(type, values))):
            raise ValueError(f"not the {plan.values} values of its skeleton")
        arrays: list[Any] = [
            np.ndarray(shape, dtype, buffer, start + offset) for shape, dtype, offset in plan.arrays
        ]
        if copy:
            arrays = [array.copy() for array in arrays]
        return plan.build(iter(values).__next__, iter(arrays).__next__)
    except (ValueError, TypeError, KeyError, IndexError, OverflowError, RecursionError) as error:
        raise DamagedMessageError(f"a message that cannot be read: {error}") from error


_layouts: dict[tuple[Any, ...], Layout] = {}
_plans: dict[bytes, Plan] = {}
_fields: dict[type[Any], tuple[str, ...]] = {}


def _remember[K, V](memory: dict[K, V], key: K, value: V) -> V:
    if len(memory) >= REMEMBERED:
        memory.clear()
    memory[key] = value
    return value


def _take_apart(part: Any, structure: list[Any], values: list[Any], arrays: list[np.ndarray]) -> None:
    """Appends a part's leaves, and to `structure` what tells it from parts put together otherwise."""
    cls = type(part)
    if cls in _VALUES:
        structure.append(VALUE)
        values.append(part)
    elif cls is np.ndarray:
        structure += (ARRAY, part.dtype, part.shape)
        arrays.append(part)
    elif cls is dict:
        structure += (DICT, tuple(part))
        for inner in part.values():
            _take_apart(inner, structure, values, arrays)
    elif cls is list or cls is tuple:
        structure += (LIST if cls is list else TUPLE, len(part))
        for inner in part:
            _take_apart(inner, structure, values, arrays)
    elif isinstance(part, np.generic):
        structure += (SCALAR, part.dtype)
        arrays.append(np.asarray(part))
    else:
        structure += (KIND, cls)
        for name in _fields.get(cls) or _fields_of(cls):
            _take_apart(getattr(part, name), structure, values, arrays)


def _fields_of(cls: type[Any]) -> tuple[str, ...]:
    if kind_named(cls.__name__) is not cls:
        raise TypeError(f"a {cls.__name__} cannot be sent")
    return _remember(_fields, cls, field_names(cls))


def _lay_out(message: Any, arrays: list[np.ndarray]) -> Layout:
    skeleton = _to_json(_skeleton(message)).encode()
    kinds = [(array.shape, array.dtype) for array in arrays]
    return Layout(skeleton, *_places(len(skeleton), kinds))


def _places(skeleton: int, arrays: list[Shaped]) -> tuple[list[int], int]:
    """The arrays' offsets behind a skeleton of so many bytes, and where they end."""
    offsets, end = [], SIZES.size + skeleton
    for shape, dtype in arrays:
        offsets.append(aligned(end))
        end = offsets[-1] + math.prod(shape) * dtype.itemsize
    return offsets, end


def _skeleton(part: Any) -> Any:
    """A part without its leaves, as JSON has it."""
    cls = type(part)
    if cls in _VALUES:
        return VALUE
    if isinstance(part, np.generic | np.ndarray):
        if part.dtype.kind not in NUMBERS:
            raise TypeError(f"an array of {part.dtype} cannot be sent")
        return [SCALAR, part.dtype.str] if cls is not np.ndarray else [ARRAY, part.dtype.str, part.shape]
    if cls is dict:
        if not all(type(key) is str for key in part):
            raise TypeError("a dict whose keys are not texts cannot be sent")
        return [DICT, list(part), [_skeleton(inner) for inner in part.values()]]
    if cls is list or cls is tuple:
        return [LIST if cls is list else TUPLE, [_skeleton(inner) for inner in part]]
    return [KIND, cls.__name__, [_skeleton(getattr(part, name)) for name in _fields_of(cls)]]


def _plan(skeleton: bytes) -> Plan:
    arrays: list[Shaped] = []
    values: list[None] = []
    build = _builder(json.loads(skeleton), arrays, values)
    offsets, end = _places(len(skeleton), arrays)
    placed = [(shape, dtype, offset) for (shape, dtype), offset in zip(arrays, offsets, strict=True)]
    return Plan(placed, end, len(values), build)


def _builder(node: Any, arrays: list[Any], values: list[None]) -> Build:
    """How to put a part together; counts its leaves."""
    if node == VALUE and type(node) is int:
        values.append(None)
        return lambda value, array: value()
    what, *rest = node
    if what in (ARRAY, SCALAR):
        return _leaf(what, rest, arrays)
    parts = [_builder(inner, arrays, values) for inner in rest[-1]]
    if what == LIST:
        return lambda value, array: [part(value, array) for part in parts]
    if what == TUPLE:
        return lambda value, array: tuple([part(value, array) for part in parts])
    names, cls = (rest[0], None) if what == DICT else _named(what, rest[0])
    if len(names) != len(parts) or not all(type(name) is str for name in names):
        raise ValueError(f"{len(parts)} parts for {names!r}")
    pairs = list(zip(names, parts, strict=True))
    if cls is None:
        return lambda value, array: {name: part(value, array) for name, part in pairs}
    return lambda value, array: cls(**{name: part(value, array) for name, part in pairs})


def _leaf(what: int, rest: list[Any], arrays: list[Any]) -> Build:
    name, shape = rest[0], tuple(rest[1]) if what == ARRAY else ()
    # NumPy takes many texts for a dtype, and parses some of them as Python.
    fits = type(name) is str and re.fullmatch(rf"[<>|][{NUMBERS}]\d{{1,2}}", name)
    if not fits or not all(type(length) is int and length >= 0 for length in shape):
        raise ValueError(f"an array of {rest!r}")
    dtype = np.dtype(name)
    arrays.append((shape, dtype))
    if what == ARRAY:
        return lambda value, array: array()
    return lambda value, array: array()[()]


def _named(what: Any, name: Any) -> tuple[tuple[str, ...], type[Any]]:
    cls = kind_named(name) if what == KIND and type(name) is str else None
    if cls is None:
        raise ValueError(f"no kind of thing is called {name!r}")
    return field_names(cls), cls
