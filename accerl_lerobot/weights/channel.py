# SPDX-License-Identifier: Apache-2.0
"""The contract every weight transport keeps, and the transport for one process.

What must hold, whatever carries the tensors:

* *whole*: a reader gets all tensors of one version, never a mixture;
* *monotone*: versions only grow, so a reader that passes on what it has seen never gets the same or an
  older set;
* *detached*: once `publish` has returned, the publisher may change its tensors in place, and no reader can
  change what another one gets;
* *newest only*: a slow reader skips versions; nothing queues up.

A new transport passes the checks in ``tests/weights/contract.py``.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod

import numpy as np

Tensors = dict[str, np.ndarray]
"""Parameter name → array; dtype and shape arrive as they were sent."""


class WeightChannel(ABC):
    """One publisher, any number of readers.

    Example:
        >>> channel.publish(8, {"head.weight": array})
        >>> channel.newest(than=-1)
        (8, {'head.weight': array(...)})
        >>> channel.newest(than=8) is None  # nothing newer yet
        True
    """

    @abstractmethod
    def publish(self, version: int, tensors: Tensors) -> None:
        """Makes a set of weights the newest one.

        Args:
            version: updates behind these weights, larger than that of any set published before.
            tensors: copied, or at least safe to change afterwards.

        Raises:
            ValueError: `version` is not larger than the last one; nothing is changed then.
        """

    @abstractmethod
    def newest(self, than: int) -> tuple[int, Tensors] | None:
        """The newest set, if it is newer than what the reader has.

        Does not wait for a publication.

        Args:
            than: the version the reader has; −1 if none.

        Returns:
            (version, tensors), the arrays read-only; None if there is nothing newer than `than`.
        """


class MemoryChannel(WeightChannel):
    """Publisher and readers are threads of one process."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: tuple[int, Tensors] | None = None

    def publish(self, version: int, tensors: Tensors) -> None:
        copies = {name: np.array(tensor) for name, tensor in tensors.items()}
        for copy in copies.values():
            copy.flags.writeable = False
        with self._lock:
            check_grows(version, None if self._newest is None else self._newest[0])
            self._newest = (version, copies)

    def newest(self, than: int) -> tuple[int, Tensors] | None:
        with self._lock:
            newest = self._newest
        if newest is None or newest[0] <= than:
            return None
        return newest[0], dict(newest[1])


def check_grows(version: int, last: int | None) -> None:
    """For transports: refuses a version that does not grow.

    Raises:
        ValueError: `version` is negative, or not larger than `last`.
    """
    if version < 0:
        raise ValueError(f"published version {version}: versions count updates from 0")
    if last is not None and version <= last:
        raise ValueError(f"published version {version} after {last}: versions must grow")


def wall_clock(moment: float) -> float:
    """A moment of `time.monotonic` on the clock that machines share as well as theirs are set."""
    return time.time() - (time.monotonic() - moment)


def monotonic_clock(moment: float) -> float:
    """The inverse of `wall_clock`, on the machine that asks; never in the future."""
    return time.monotonic() - max(0.0, time.time() - moment)
