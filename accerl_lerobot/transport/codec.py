# SPDX-License-Identifier: Apache-2.0
"""Messages as bytes: a JSON header that holds everything but the arrays, then the arrays.

    0    size of the header
    4    the header: values as they are, ``[code, …]`` for everything that JSON does not know
         each array, at a multiple of 64 bytes

Offsets follow from the dtypes and shapes in the header, so none is read. Nothing that is read is executed.
"""

from __future__ import annotations

import functools
import json
import struct
from typing import Any, NamedTuple

import numpy as np

from accerl_lerobot.checkpoint.snapshot import field_names, kind_named

SIZE = struct.Struct("<I")
ALIGNMENT = 64
"""Alignment of arrays in shared memory, in bytes: a cache line."""
NUMBERS = "biuf"
"""Dtypes that can be sent, see `numpy.dtype.kind`: none of them holds Python objects."""

ARRAY, SCALAR, LIST, TUPLE, KIND = range(5)
"""The first entry of every JSON list in a header. A dict is a JSON object."""
_VALUES = frozenset((bool, int, float, str, type(None)))
_to_json = json.JSONEncoder(separators=(",", ":"), check_circular=False).encode


def aligned(offset: int) -> int:
    """The next offset at which an array may begin."""
    return -(-offset // ALIGNMENT) * ALIGNMENT


class Encoded(NamedTuple):
    """A message that is ready to be written; its arrays are still the sender's."""

    header: bytes
    arrays: list[np.ndarray]
    offsets: list[int]
    size: int

    def write(self, buffer: Any, start: int) -> None:
        """Copy it into a writable buffer from `start` on, a multiple of `ALIGNMENT`."""
        SIZE.pack_into(buffer, start, len(self.header))
        head = start + SIZE.size
        buffer[head : head + len(self.header)] = self.header
        for array, offset in zip(self.arrays, self.offsets, strict=True):
            np.ndarray(array.shape, array.dtype, buffer, start + offset)[...] = array


def encode(message: Any) -> Encoded:
    """Encode lists, tuples, dicts with str keys, registered kinds, arrays and plain values."""
    arrays: list[np.ndarray] = []
    try:
        header = _to_json(_node(message, arrays)).encode()
    except RecursionError:
        raise TypeError("what holds itself cannot be sent") from None
    offsets, end = [], SIZE.size + len(header)
    for array in arrays:
        offsets.append(aligned(end))
        end = offsets[-1] + array.nbytes
    return Encoded(header, arrays, offsets, end)


def decode(buffer: Any, start: int = 0, *, copy: bool = True) -> Any:
    """Decode the message that begins at `start`.

    Args:
        copy: False: its arrays are views of the buffer.
    """
    head = start + SIZE.size
    (length,) = SIZE.unpack_from(buffer, start)
    reader = _Reader(buffer, start, SIZE.size + length, copy)
    return reader.read(json.loads(bytes(buffer[head : head + length])))


def _node(part: Any, arrays: list[np.ndarray]) -> Any:
    """The header's entry for a part; appends the arrays in it."""
    cls: Any = type(part)
    if cls in _VALUES:
        return part
    if cls is np.ndarray or isinstance(part, np.generic):
        if part.dtype.kind not in NUMBERS:
            raise TypeError(f"an array of {part.dtype} cannot be sent")
        arrays.append(np.asarray(part))
        return [ARRAY, part.dtype.str, *part.shape] if cls is np.ndarray else [SCALAR, part.dtype.str]
    if cls is dict:
        if not all(type(key) is str for key in part):
            raise TypeError("a dict whose keys are not texts cannot be sent")
        return {key: _node(inner, arrays) for key, inner in part.items()}
    if cls is list or cls is tuple:
        return [LIST if cls is list else TUPLE, *[_node(inner, arrays) for inner in part]]
    names = _fields(cls)
    return [KIND, cls.__name__, *[_node(getattr(part, name), arrays) for name in names]]


class _Reader:
    """Builds a message from its header; takes arrays one after the other.

    Args:
        end: where the header ends, counted from `start`.
    """

    def __init__(self, buffer: Any, start: int, end: int, copy: bool) -> None:
        self._buffer, self._start, self._copy = buffer, start, copy
        self.end = end

    def read(self, node: Any) -> Any:
        """Build the part that a header's entry stands for."""
        if type(node) is dict:
            return {key: self.read(inner) for key, inner in node.items()}
        if type(node) is not list:
            return node
        code = node[0]
        if code == ARRAY:
            return self._array(node)
        if code == LIST:
            return [self.read(inner) for inner in node[1:]]
        if code == KIND:
            cls, names = _kind(node[1])
            parts = [self.read(inner) for inner in node[2:]]
            return cls(**dict(zip(names, parts, strict=True)))
        if code == TUPLE:
            return tuple([self.read(inner) for inner in node[1:]])
        return self._array(node)[()]

    def _array(self, node: list[Any]) -> Any:
        dtype, shape, offset = _dtype(node[1]), node[2:], aligned(self.end)
        array: np.ndarray = np.ndarray(shape, dtype, self._buffer, self._start + offset)
        self.end = offset + array.nbytes
        return array.copy() if self._copy else array


@functools.lru_cache(maxsize=256)
def _fields(cls: Any) -> tuple[str, ...]:
    registered = kind_named(cls.__name__)
    if registered is None or registered is not cls:
        raise TypeError(f"a {cls.__name__} cannot be sent")
    return field_names(registered)


@functools.lru_cache(maxsize=256)
def _kind(name: str) -> tuple[type[Any], tuple[str, ...]]:
    cls = kind_named(name)
    if cls is None:
        raise ValueError(f"no kind of thing is called {name!r}")
    return cls, field_names(cls)


_dtype = functools.lru_cache(maxsize=256)(np.dtype)
