# SPDX-License-Identifier: Apache-2.0
"""Two processes between which gloo carries bytes, each at one address of its machine.

A group of two for each reader, and none of all: who is lost takes nobody along, and who comes later disturbs
nobody. What is sent says nothing of itself; both ends know from elsewhere what comes, how much, and in which
order.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from typing import Any

import numpy as np
import torch
import torch.distributed as dist

PUBLISHES, READS = 0, 1
"""Ranks in the group of two."""
PIECE = 1 << 26
"""Bytes that are sent at a time: a limit on time is one for so many."""


class Pair:
    """One end of the two; made at both at once, as each waits for the other.

    Args:
        store: where they have met, see `transport.meeting`.
        rank: `PUBLISHES` or `READS`.
        address: of this machine, by which the other end can reach it.
        meet_s: how long the other end may take to come.
        timeout_s: how long it may take with each piece.

    Raises:
        RuntimeError: it has not come, or is lost.
    """

    def __init__(
        self, store: dist.Store, rank: int, address: str, *, meet_s: float, timeout_s: float
    ) -> None:
        self._other, self._timeout = 1 - rank, timedelta(seconds=timeout_s)
        options = dist.ProcessGroupGloo._Options()
        # Said here, not by GLOO_SOCKET_IFNAME: that is the whole process's, and users may have set it.
        options._devices = [dist.ProcessGroupGloo.create_device(hostname=address)]
        options._timeout = timedelta(seconds=meet_s)
        self._group: Any = dist.ProcessGroupGloo(store, rank, 2, options)
        self._under_way: list[object] = []

    def send(self, memory: np.ndarray) -> None:
        """Begins to send bytes, which must not change before the other end says that it has them all.

        Raises:
            RuntimeError: the other end is lost.
        """
        for piece in _pieces(memory):
            self._under_way.append((piece, self._group.send([piece], self._other, 0)))

    def sent(self) -> None:
        """The other end has said that it has everything."""
        self._under_way.clear()

    def receive(self, memory: np.ndarray) -> None:
        """Waits for as many bytes, in the order in which they are sent.

        Raises:
            RuntimeError: the other end is lost, or silent.
        """
        for piece in _pieces(memory):
            self._group.recv([piece], self._other, 0).wait(self._timeout)

    def close(self) -> None:
        """Lets go of the connection, and of all that was being sent."""
        self._under_way.clear()
        self._group = None


def _pieces(memory: np.ndarray) -> Iterator[torch.Tensor]:
    whole = torch.from_numpy(memory)
    for start in range(0, len(whole), PIECE):
        yield whole[start : start + PIECE]
