# SPDX-License-Identifier: Apache-2.0
"""A set of weights in one piece of memory, which another process can map.

    data      every tensor, each at a multiple of 64 bytes
    layout    where which tensor is, as JSON

The digest covers version, layout and data, so a mixture of two sets is noticed.
"""

from __future__ import annotations

import json
import mmap
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import xxhash

from accerl_lerobot.transport.memfd import aligned, new_memory

Tensors = dict[str, np.ndarray]
"""Parameter name → array; dtype and shape arrive as they were sent."""


class TornSetError(RuntimeError):
    """The received set is not the one that was published; none of it has been used."""


class TensorSpec(NamedTuple):
    """One tensor in a buffer."""

    dtype: str
    shape: tuple[int, ...]
    offset: int

    @property
    def nbytes(self) -> int:
        """Bytes without padding."""
        return np.dtype(self.dtype).itemsize * int(np.prod(self.shape, dtype=np.int64))


@dataclass(frozen=True)
class BufferLayout:
    """Positions of the tensors of a set.

    Example:
        >>> layout = BufferLayout.of({"weight": np.zeros((2, 3), np.float32)})
        >>> layout.size, BufferLayout.read(layout.text) == layout
        (64, True)
    """

    specs: dict[str, TensorSpec]
    size: int
    """Bytes of the data, padding included."""
    text: bytes
    """JSON of `specs`."""

    @classmethod
    def of(cls, tensors: Mapping[str, np.ndarray]) -> BufferLayout:
        """Put one tensor after the other."""
        specs, end = {}, 0
        for name, tensor in tensors.items():
            specs[name] = TensorSpec(tensor.dtype.str, tensor.shape, end)
            end = aligned(end + tensor.nbytes)
        return cls(specs, end, json.dumps(specs, separators=(",", ":")).encode())

    @classmethod
    def read(cls, text: bytes) -> BufferLayout:
        """Parse `text`."""
        rows = json.loads(text).items()
        specs = {name: TensorSpec(dtype, tuple(shape), at) for name, (dtype, shape, at) in rows}
        return cls(specs, max((aligned(s.offset + s.nbytes) for s in specs.values()), default=0), text)

    @property
    def end(self) -> int:
        """Bytes of data and layout."""
        return aligned(self.size + len(self.text))


class WeightBuffer:
    """Memory for one set at a time.

    Args:
        size: bytes.
        fd: memfd to be mapped, which the buffer owns from now on; None: private memory of this process.
        writable: False: map it read-only.
    """

    def __init__(self, size: int, fd: int | None = None, *, writable: bool = True) -> None:
        self.fd = fd
        protection = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
        sharing = mmap.MAP_SHARED if fd is not None else mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
        # Populated: a copy into pages that are not there yet takes several times as long.
        flags = sharing | mmap.MAP_POPULATE
        file, size = -1 if fd is None else fd, max(size, mmap.PAGESIZE)
        self.memory: np.ndarray = np.frombuffer(mmap.mmap(file, size, flags=flags, prot=protection), np.uint8)

    @classmethod
    def shared(cls, size: int) -> WeightBuffer:
        """Memory that other processes can map once they are sent `fd`."""
        fd = new_memory(max(size, mmap.PAGESIZE))
        try:
            return cls(size, fd)
        except BaseException:
            os.close(fd)
            raise

    def __len__(self) -> int:
        return len(self.memory)

    def views(self, layout: BufferLayout) -> Tensors:
        """The tensors where they lie."""
        return {
            name: self.memory[s.offset : s.offset + s.nbytes].view(s.dtype).reshape(s.shape)
            for name, s in layout.specs.items()
        }

    def fill(self, layout: BufferLayout, tensors: Mapping[str, np.ndarray]) -> None:
        """Copy a set into it."""
        for view, tensor in zip(self.views(layout).values(), tensors.values(), strict=True):
            np.copyto(view, tensor)
        self.memory[layout.size : layout.size + len(layout.text)] = np.frombuffer(layout.text, np.uint8)

    def close(self) -> None:
        """Release the memory as soon as no array points into it any more."""
        if self.fd is not None:
            os.close(self.fd)
            self.fd = None
        self.memory = self.memory[:0].copy()


def digest(version: int, layout: BufferLayout, buffer: WeightBuffer) -> bytes:
    """128 bits of XXH3 over version, layout and data, padding included."""
    state = xxhash.xxh3_128(version.to_bytes(8, "little"))
    state.update(layout.text)
    state.update(memoryview(buffer.memory[: layout.size]))
    return state.digest()
