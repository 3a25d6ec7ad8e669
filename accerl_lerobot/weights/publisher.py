# SPDX-License-Identifier: Apache-2.0
"""The trainer's end of a transport: one copy in the trainer's thread, everything else in another one.

    publish    copies the tensors into a slab that nobody uses, and returns; it waits for nobody
    thread     hashes, sends, hears who has what; takes the newest set and never one before it
    flush      waits until all readers have the newest set
    readers    that die are let go of, and others may come at any time: they get the newest set
    failures   of the thread are raised by the next `publish` or `flush`

At most one set per reader is under way, so a slow one skips versions.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from accerl_lerobot.weights.channel import check_grows
from accerl_lerobot.weights.slab import Layout, Slab

FLUSH_S = 300.0
"""How long all readers together may take for the last set: a forward pass and a copy of the weights."""
_CLOSE_S = 10.0


@dataclass(eq=False)
class Shipment:
    """A set on its way."""

    version: int
    layout: Layout
    slab: Slab
    published_s: float
    """When `publish` was called, on the clock `time.monotonic`, which all processes of a machine share."""
    digest: bytes = b""
    """Digest of the whole set; the thread adds it."""


class Publisher(ABC):
    """Base of all publishers.

    Args:
        slabs: how many there may be; enough of them that one is always free, see `_held`.
        make: makes one of at least so many bytes.
    """

    def __init__(self, slabs: int, make: Callable[[int], Slab]) -> None:
        self._limit, self._make = slabs, make
        self._slabs: list[Slab] = []
        """By slot; one that has become too small is replaced in its slot."""
        self._changed = threading.Condition()
        self._version: int | None = None
        self._layout = Layout.of({})
        self._writing: Slab | None = None
        self._pending: Shipment | None = None
        self._current: Shipment | None = None
        self._failure: BaseException | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="publisher", daemon=True)

    def publish(self, version: int, tensors: Mapping[str, np.ndarray]) -> None:
        """Makes a set the newest one; returns once it is copied.

        Args:
            version: updates behind these weights, larger than that of any set published before.
            tensors: may change as soon as this has returned.

        Raises:
            ValueError: `version` does not grow; nothing is changed then.
            BaseException: what has ended the thread.
        """
        self._check()
        check_grows(version, self._version)
        now = time.monotonic()
        if not self._layout.fits(tensors):
            self._layout = Layout.of(tensors)
        layout = self._layout
        self._writing = self._free(layout.end)
        self._writing.fill(layout, tensors)
        with self._changed:
            self._pending = Shipment(version, layout, self._writing, now)
            self._version, self._writing = version, None
            self._wake()

    def flush(self, timeout_s: float = FLUSH_S) -> None:
        """Waits until every reader has the newest set.

        Raises:
            TimeoutError: names those that do not, after `timeout_s` seconds.
            BaseException: what has ended the thread.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._failure is not None or not self._owed(), timeout_s)
            owed = self._owed()
        self._check()
        if owed:
            raise TimeoutError(f"weights of version {self._version}, after {timeout_s:g} s: {owed}")

    def add(self, reader: Any) -> None:
        """Has another one receive what is published, from the newest set on; not where they come alone.

        Args:
            reader: actor handle.

        Raises:
            BaseException: what has ended the thread.
        """
        raise NotImplementedError(f"readers connect to a {type(self).__name__}")

    def close(self) -> None:
        """Ends the thread and lets all memory go; readers keep what they have."""
        with self._changed:
            self._closing = True
            self._wake()
        if self._thread.ident is not None:
            self._thread.join(_CLOSE_S)
        for slab in self._slabs:
            slab.close()

    @abstractmethod
    def _serve(self) -> None:
        """The thread's work, until `_closing`."""

    @abstractmethod
    def _wake(self) -> None:
        """Tells the thread that there is something to do; called with the lock held."""

    @abstractmethod
    def _owed(self) -> str:
        """Which readers do not have the newest set, in words; empty if all have it. Called with the lock."""

    def _held(self) -> list[Slab]:
        """Slabs that readers or the thread still need, besides the current one. Called with the lock."""
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

    def _take(self) -> Shipment | None:
        """The thread takes the newest set, if it has not begun with it yet."""
        with self._changed:
            taken, self._pending = self._pending, None
            if taken is not None:
                self._current = taken
            return taken

    def _spare(self) -> None:
        """Makes a slab for the next publication ahead of it, so that the trainer need not wait for memory."""
        with self._changed:
            free = self._unused()
            if free or self._current is None or len(self._slabs) >= self._limit:
                return
            size = self._current.layout.end
        made = self._make(size)
        with self._changed:
            self._slabs.append(made)

    def _free(self, size: int) -> Slab:
        """A slab to write to. What nobody has begun to send is overwritten: something newer comes."""
        with self._changed:
            self._pending = None
            free = self._unused()
            large = [slab for slab in free if len(slab) >= size]
            if large:
                return large[0]
            assert free or len(self._slabs) < self._limit, "a slab is always free"
            self._writing = free[0] if free else None
        made = self._make(size)
        with self._changed:
            if free:
                self._slabs[self._slabs.index(free[0])] = made
                free[0].close()
            else:
                self._slabs.append(made)
        return made

    def _unused(self) -> list[Slab]:
        """Slabs that hold nothing anybody needs; called with the lock."""
        shipments = [s.slab for s in (self._pending, self._current) if s is not None]
        used = {id(slab) for slab in (*shipments, self._writing, *self._held())}
        return [slab for slab in self._slabs if id(slab) not in used]
