# SPDX-License-Identifier: Apache-2.0
"""The trainer's end of a weight channel: one copy in the trainer's thread, everything else in another one.

    publish    copies the tensors into a free buffer and returns; it waits for no reader
    thread     sends the newest set, and hears which reader has applied what
    flush      waits until all readers have the newest set
    failures   of the thread are raised by the next `publish` or `flush`

Guarantees: a reader gets all tensors of one version, never a mixture; versions grow; once `publish` has
returned, the trainer may change its tensors; at most one set per reader is under way, so a slow reader skips
versions. Readers that die are dropped, and new ones get the newest set.

A set of weights in one piece of memory, which another process can map.

    data      every tensor, each at a multiple of 64 bytes
    layout    where which tensor is, as JSON

The digest covers version, layout and data, so a mixture of two sets is noticed.
"""

from __future__ import annotations

import json
import mmap
import os
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping
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


FLUSH_S = 300.0
"""Timeout for all readers together: a forward pass and a copy of the weights."""
_CLOSE_S = 10.0


@dataclass(eq=False)
class WeightUpdate:
    """A published set."""

    version: int
    layout: BufferLayout
    buffer: WeightBuffer
    published_s: float
    """When `publish` was called, on `time.monotonic`, which all processes of a machine share."""
    digest: bytes = b""
    """See `digest`; added by the thread."""


class Publisher(ABC):
    """Base of both publishers."""

    def __init__(self, make: Callable[[int], WeightBuffer]) -> None:
        self._make = make
        self._buffers: list[WeightBuffer] = []
        """By slot; one that has become too small is replaced in its slot."""
        self._changed = threading.Condition()
        self._version: int | None = None
        self._pending: WeightUpdate | None = None
        """Published, and not taken by the thread yet."""
        self._current: WeightUpdate | None = None
        """The set that the thread sends."""
        self._failure: BaseException | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="publisher", daemon=True)

    def publish(self, version: int, tensors: Mapping[str, np.ndarray]) -> None:
        """Copy a set and make it the newest one.

        Args:
            version: updates behind these weights, larger than that of any set published before.

        Raises:
            ValueError: `version` does not grow; nothing is changed then.
            BaseException: the failure of the thread.
        """
        self._check()
        if version < 0:
            raise ValueError(f"published version {version}: versions count updates from 0")
        if self._version is not None and version <= self._version:
            raise ValueError(f"published version {version} after {self._version}: versions must grow")
        now = time.monotonic()
        layout = BufferLayout.of(tensors)
        buffer = self._free_buffer(layout.end)
        buffer.fill(layout, tensors)
        with self._changed:
            self._pending, self._version = WeightUpdate(version, layout, buffer, now), version
            self._wake()

    def flush(self, timeout_s: float = FLUSH_S) -> None:
        """Wait until every reader has the newest set.

        Raises:
            TimeoutError: names the readers that do not.
            BaseException: the failure of the thread.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._failure is not None or not self._missing(), timeout_s)
            missing = self._missing()
        self._check()
        if missing:
            raise TimeoutError(f"weights of version {self._version}, after {timeout_s:g} s: {missing}")

    def close(self) -> None:
        """End the thread and release all memory; readers keep what they have."""
        with self._changed:
            self._closing = True
            self._wake()
        if self._thread.ident is not None:
            self._thread.join(_CLOSE_S)
        for buffer in self._buffers:
            buffer.close()

    @abstractmethod
    def _serve(self) -> None:
        """The thread's work, until `_closing`."""

    @abstractmethod
    def _wake(self) -> None:
        """Tell the thread that there is something to do; called with the lock held."""

    @abstractmethod
    def _missing(self) -> str:
        """Readers without the newest set, in words; empty if all have it. Called with the lock held."""

    def _held(self) -> list[WeightBuffer]:
        """Buffers that readers still read, besides the current one. Called with the lock held."""
        return []

    def _run(self) -> None:
        try:
            self._serve()
        except BaseException as error:
            with self._changed:
                self._failure = error
                self._changed.notify_all()

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure
        if self._closing:
            raise RuntimeError("these weights have no readers any more: the publisher is closed")

    def _take(self) -> WeightUpdate | None:
        """Take the newest set, if there is a new one; on the thread."""
        with self._changed:
            taken, self._pending = self._pending, None
            if taken is not None:
                self._current = taken
            return taken

    def _free_buffer(self, size: int) -> WeightBuffer:
        """A buffer to write to. A set that has not been taken yet is overwritten, since a newer one comes."""
        with self._changed:
            self._pending = None
            used = {id(buffer) for buffer in self._held()}
            if self._current is not None:
                used.add(id(self._current.buffer))
            free = [buffer for buffer in self._buffers if id(buffer) not in used]
        if large := [buffer for buffer in free if len(buffer) >= size]:
            return large[0]
        made = self._make(size)
        with self._changed:
            if free:
                self._buffers[self._buffers.index(free[0])] = made
                free[0].close()
            else:
                self._buffers.append(made)
        return made


class PublishDelay:
    """Publishes weights some updates after they were made, for studies of what lag does to an algorithm.

    Args:
        updates: age of weights when they are published; 0: at once. As many copies are kept.
    """

    def __init__(self, updates: int) -> None:
        self.updates = updates
        self._waiting: deque[tuple[int, Tensors]] = deque()

    def push(self, version: int, tensors: Tensors, *, last: bool = False) -> list[tuple[int, Tensors]]:
        """Take the newest weights and return those that are due, oldest first; version 0 always is.

        Args:
            tensors: must not change afterwards.
            last: no update follows, so return the newest.
        """
        self._waiting.append((version, tensors))
        due = []
        while self._waiting and (last or self._waiting[0][0] <= max(0, version - self.updates)):
            due.append(self._waiting.popleft())
        return due[-1:] if last else due

    def state(self) -> list[tuple[int, Tensors]]:
        """Everything that `restore` needs; see `snapshot`."""
        return list(self._waiting)

    def restore(self, state: list[tuple[int, Tensors]]) -> None:
        """Resume from `state`."""
        self._waiting.extend(state)


def wall_clock(moment: float) -> float:
    """A moment of `time.monotonic` on the clock that machines share as well as theirs are set."""
    return time.time() - (time.monotonic() - moment)


def monotonic_clock(moment: float) -> float:
    """The inverse of `wall_clock`, on the machine that calls it; never in the future."""
    return time.monotonic() - max(0.0, time.time() - moment)
