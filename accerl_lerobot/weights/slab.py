# SPDX-License-Identifier: Apache-2.0
"""A set of weights in one piece of memory, which another process can map.

    data      every tensor, each at a multiple of 64 bytes
    layout    where which tensor lies, as JSON

The digest is of version, layout and data, so a set of which any part belongs to another one is noticed.
Memory that is to be shared has no name, and goes with the last process that holds it.
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


class TornSetError(RuntimeError):
    """The received set is not the one that was published; none of it has been used."""


class Place(NamedTuple):
    """One tensor in a slab."""

    dtype: str
    shape: tuple[int, ...]
    offset: int

    @property
    def nbytes(self) -> int:
        """Bytes without padding."""
        return np.dtype(self.dtype).itemsize * int(np.prod(self.shape, dtype=np.int64))


@dataclass(frozen=True)
class Layout:
    """Where the tensors of a set lie.

    Example:
        >>> layout = Layout.of({"weight": np.zeros((2, 3), np.float32)})
        >>> layout.size, Layout.read(layout.text) == layout
        (64, True)
    """

    places: dict[str, Place]
    size: int
    """Bytes of the data, padding included."""
    text: bytes
    """JSON of `places`."""

    @classmethod
    def of(cls, tensors: Mapping[str, np.ndarray]) -> Layout:
        """One tensor after the other."""
        places, end = {}, 0
        for name, tensor in tensors.items():
            places[name] = Place(tensor.dtype.str, tensor.shape, end)
            end = aligned(end + tensor.nbytes)
        return cls(places, end, json.dumps(places, separators=(",", ":")).encode())

    @classmethod
    def read(cls, text: bytes) -> Layout:
        """The inverse of `text`."""
        places = {n: Place(dtype, tuple(shape), at) for n, (dtype, shape, at) in json.loads(text).items()}
        return cls(places, max((aligned(p.offset + p.nbytes) for p in places.values()), default=0), text)

    def fits(self, tensors: Mapping[str, np.ndarray]) -> bool:
        """True if these lie like that."""
        return len(self.places) == len(tensors) and all(
            name == other and place.shape == tensor.shape and place.dtype == tensor.dtype.str
            for (name, place), (other, tensor) in zip(self.places.items(), tensors.items(), strict=True)
        )

    @property
    def end(self) -> int:
        """Bytes of data and layout."""
        return aligned(self.size + len(self.text))

    def views(self, memory: np.ndarray) -> dict[str, np.ndarray]:
        """The tensors as they lie in `memory`, bytes."""
        return {
            name: memory[p.offset : p.offset + p.nbytes].view(p.dtype).reshape(p.shape)
            for name, p in self.places.items()
        }


class Slab:
    """Memory for one set at a time.

    Args:
        size: bytes.
        fd: of a memfd that is to be mapped, which the slab owns from now on; None: memory of this process.
        writable: whether this process may write to it.
    """

    def __init__(self, size: int, fd: int | None = None, *, writable: bool = True) -> None:
        self.fd = fd
        self._seen: tuple[Layout, dict[str, np.ndarray]] | None = None
        protection = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
        sharing = mmap.MAP_SHARED if fd is not None else mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
        # Populated: a copy into pages that are not there yet takes several times as long.
        flags = sharing | mmap.MAP_POPULATE
        size = max(size, mmap.PAGESIZE)
        self.memory: np.ndarray = np.frombuffer(
            mmap.mmap(-1 if fd is None else fd, size, flags=flags, prot=protection), np.uint8
        )

    @classmethod
    def shared(cls, size: int) -> Slab:
        """Memory that other processes can map once they are sent `fd`."""
        fd = new_memory(max(size, mmap.PAGESIZE))
        try:
            return cls(size, fd)
        except BaseException:
            os.close(fd)
            raise

    def __len__(self) -> int:
        return len(self.memory)

    def views(self, layout: Layout) -> dict[str, np.ndarray]:
        """See `Layout.views`; made once, as long as the layout is the same one."""
        if self._seen is None or self._seen[0] is not layout:
            self._seen = (layout, layout.views(self.memory))
        return dict(self._seen[1])

    def fill(self, layout: Layout, tensors: Mapping[str, np.ndarray]) -> None:
        """Copies a set into it."""
        for view, tensor in zip(self.views(layout).values(), tensors.values(), strict=True):
            np.copyto(view, tensor)
        self.memory[layout.size : layout.size + len(layout.text)] = np.frombuffer(layout.text, np.uint8)

    def close(self) -> None:
        """Lets the memory go, as soon as nothing points into it any more."""
        if self.fd is not None:
            os.close(self.fd)
            self.fd = None
        self._seen, self.memory = None, self.memory[:0].copy()


def digest(version: int, layout: Layout, data: np.ndarray) -> bytes:
    """128 bits of XXH3: of version, layout and `data`, all bytes with their padding."""
    found = xxhash.xxh3_128(version.to_bytes(8, "little"))
    found.update(layout.text)
    found.update(memoryview(data[: layout.size]))
    return found.digest()
