# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Two processes between which torch.distributed carries bytes: gloo through the hosts, NCCL from GPU to GPU.

A group of two for each reader, and none of all: who is lost takes nobody along, and who comes later disturbs
nobody. What is sent says nothing of itself; both ends know from elsewhere what comes, how much, and in which
order.
"""

from __future__ import annotations

from datetime import timedelta
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
import torch.distributed as dist

Backend = Literal["gloo", "nccl"]
PUBLISHES, READS = 0, 1
"""Ranks in the group of two."""


class Place(NamedTuple):
    """Where a worker's weights are."""

    node: str
    """Ray's id of the machine."""
    device: str
    """``cpu``, or the identity of a GPU."""


def place_of(device: torch.device) -> Place:
    """Of this Ray worker, whose policy is on `device`."""
    import ray

    node = ray.get_runtime_context().get_node_id()
    if device.type == "cpu":
        return Place(node, "cpu")
    return Place(node, str(torch.cuda.get_device_properties(device).uuid))


class Pair:
    """One end of the two; made at both at once, as each waits for the other.

    Args:
        store: where they have met, see `transport.meeting`.
        rank: `PUBLISHES` or `READS`.
        backend: gloo for memory of the host, nccl for that of a GPU.
        meet_s: how long the other end may take to come.
        timeout_s: how long it may take with each message.

    Raises:
        RuntimeError: it has not come, or is lost.
    """

    def __init__(
        self, store: dist.Store, rank: int, backend: Backend, *, meet_s: float, timeout_s: float
    ) -> None:
        self._other, self._timeout = 1 - rank, timedelta(seconds=timeout_s)
        if backend == "gloo":
            self._group: Any = dist.ProcessGroupGloo(store, rank, 2, timedelta(seconds=meet_s))
        else:
            options = dist.ProcessGroupNCCL.Options()
            options._timeout = self._timeout
            self._group = dist.ProcessGroupNCCL(store, rank, 2, options)

    def send(self, memory: torch.Tensor | np.ndarray) -> object:
        """Begins to send bytes, which must neither change nor go before the other end says that it has them.

        Returns:
            To be kept as long.
        """
        tensor = _tensor(memory)
        return tensor, self._group.send([tensor], self._other, 0)

    def receive(self, memory: torch.Tensor | np.ndarray) -> None:
        """Waits for as many bytes, in the order in which they are sent."""
        self._group.recv([_tensor(memory)], self._other, 0).wait(self._timeout)


def _tensor(memory: torch.Tensor | np.ndarray) -> torch.Tensor:
    return memory if isinstance(memory, torch.Tensor) else torch.from_numpy(memory)
