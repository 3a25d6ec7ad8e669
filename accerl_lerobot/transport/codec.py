# SPDX-License-Identifier: Apache-2.0
"""Messages as bytes: a JSON header with everything but the arrays, as `snapshot` has it, then the arrays.

    0    size of the header
    4    [tree, [dtype, *shape] of each array]
         each array, at a multiple of 64 bytes

Offsets follow from dtypes and shapes, so none is read. Nothing that is read is executed.
"""

from __future__ import annotations

import json
import struct
from typing import Any, NamedTuple

import numpy as np

from accerl_lerobot.checkpoint.snapshot import from_json, to_json

SIZE = struct.Struct("<I")
ALIGNMENT = 64  # alignment of arrays in shared memory, in bytes: a cache line
_dumps = json.JSONEncoder(separators=(",", ":"), check_circular=False).encode


def aligned(offset: int) -> int:
    """The next offset at which an array may begin."""
    return -(-offset // ALIGNMENT) * ALIGNMENT


class Encoded(NamedTuple):
    """A message that is ready to be written; its arrays are still the sender's."""

    header: bytes
    arrays: list[np.ndarray]
    size: int

    def write(self, buffer: Any, start: int) -> None:
        """Copy it into a writable buffer from `start` on, a multiple of `ALIGNMENT`."""
        SIZE.pack_into(buffer, start, len(self.header))
        end = start + SIZE.size + len(self.header)
        buffer[start + SIZE.size : end] = self.header
        for array in self.arrays:
            np.ndarray(array.shape, array.dtype, buffer, aligned(end))[...] = array
            end = aligned(end) + array.nbytes


def encode(message: Any) -> Encoded:
    """Encode what `snapshot` can save; a `TypeError` names the place of anything else."""
    named: dict[str, np.ndarray] = {}
    tree = to_json(message, "message", named)
    arrays = list(named.values())
    header = _dumps([tree, [[array.dtype.str, *array.shape] for array in arrays]]).encode()
    size = SIZE.size + len(header)
    for array in arrays:
        size = aligned(size) + array.nbytes
    return Encoded(header, arrays, size)


def decode(buffer: Any, start: int = 0, *, copy: bool = True) -> Any:
    """Decode the message that begins at `start`; unless `copy`, its arrays are views of the buffer."""
    (length,) = SIZE.unpack_from(buffer, start)
    end = start + SIZE.size + length
    tree, kinds = json.loads(bytes(buffer[start + SIZE.size : end]))
    arrays = {}
    for number, (dtype, *shape) in enumerate(kinds):
        array: np.ndarray = np.ndarray(shape, dtype, buffer, aligned(end))
        end = aligned(end) + array.nbytes
        arrays[str(number)] = array.copy() if copy else array
    return from_json(tree, arrays)
