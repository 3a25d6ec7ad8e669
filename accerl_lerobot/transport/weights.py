# SPDX-License-Identifier: Apache-2.0
"""Weights from the trainer to inference replicas, through Ray's object store.

The trainer puts each set into the store once. A replica asks for the newest one whenever it has applied the
one before, so a slow replica skips versions and the trainer waits for none.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

FLUSH_S = 300.0  # timeout for all replicas together: a forward pass and a copy of the weights
ASK_S = 10.0  # how long a replica's question for newer weights waits before it is answered with nothing

Tensors = dict[str, np.ndarray]  # parameter name → array; dtype and shape arrive as they were sent


class WeightPublisher:
    """Keeps the newest weights for the replicas, which ask from other threads.

    Args:
        readers: names of the replicas that `flush` waits for.
        put: copies tensors into the store; returns the reference that replicas get.
    """

    def __init__(self, readers: Iterable[str], put: Callable[[Tensors], Any]) -> None:
        self._put = put
        self._changed = threading.Condition()
        self._applied = dict.fromkeys(readers, -1)
        self.version = -1
        self._reference = None

    def publish(self, version: int, tensors: Tensors) -> None:
        """Copy a set; the tensors may change afterwards."""
        reference = self._put(tensors)
        with self._changed:
            self.version = version
            self._reference = reference
            self._changed.notify_all()

    def newer_than(self, reader: str, version: int) -> tuple[int, list[Any]]:
        """Note that a replica has applied a version; returns the newest one and its reference.

        The list is empty if there was none within `ASK_S`. Ray would replace a reference outside of a list by
        the tensors.
        """
        with self._changed:
            self._applied[reader] = version
            self._changed.notify_all()
            if not self._changed.wait_for(lambda: self.version > version, ASK_S):
                return version, []
            return self.version, [self._reference]

    def flush(self, timeout_s: float = FLUSH_S) -> None:
        """Wait until every replica has applied the newest set."""

        def late() -> list[str]:
            return [name for name, version in self._applied.items() if version < self.version]

        with self._changed:
            if not self._changed.wait_for(lambda: not late(), timeout_s):
                raise TimeoutError(f"weights not applied within {timeout_s:g} s by {', '.join(late())}")
