# SPDX-License-Identifier: Apache-2.0
"""The processes that make an update together, as one of them sees the others.

Each rank has the whole batch and runs the network on its rows of it. What is said of rows is gathered, so
that every rank knows it of all rows: targets, moments and numbers are computed from the same values, by the
same code, everywhere, and nobody has to be told whether an update was finite. Only gradients are averaged.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Sequence
from datetime import timedelta
from typing import NamedTuple

import numpy as np
import psutil
import torch
import torch.distributed as dist
from torch import Tensor, nn

from accerl_lerobot.algorithms.batch import split_rows


class Ranks:
    """A trainer that is one process; `Group` is one of several."""

    rank, size = 0, 1

    def gather(self, mine: Tensor, total: int) -> Tensor:
        """All ranks' rows, from each one's own: (rows, ...), on the CPU in the order of `np.array_split`."""
        return mine

    def average(self, parameters: Sequence[nn.Parameter]) -> None:
        """Puts the mean over ranks into each gradient."""

    def begin_alike(self, parameters: Sequence[nn.Parameter]) -> None:
        """Puts the first rank's values into those of all."""

    def each(self, score: Callable[[np.ndarray], Tensor], rows: np.ndarray, size: int) -> Tensor:
        """Results of `score` for rows, (rows, ...) on the CPU; a rank is asked of its own, `size` at once."""
        parts = split_rows(rows, size, self.rank, self.size)
        return self.gather(
            torch.cat([score(part).cpu()[: None if own else 0] for part, own in parts]), len(rows)
        )


ALONE = Ranks()


class Group(Ranks):
    """One of several ranks, once all of them have come."""

    def __init__(
        self, store: dist.Store, rank: int, size: int, device: torch.device, timeout_s: float
    ) -> None:
        self.rank, self.size = rank, size
        timeout = timedelta(seconds=timeout_s)
        # What is gathered lies on the CPU.
        backend = "gloo" if device.type == "cpu" else f"cpu:gloo,{device.type}:nccl"
        dist.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=timeout)

    def gather(self, mine: Tensor, total: int) -> Tensor:
        counts = [len(part) for part in np.array_split(np.arange(total), self.size)]
        padded = mine.new_zeros((counts[0], *mine.shape[1:]))
        padded[: len(mine)] = mine
        parts = [torch.empty_like(padded) for _ in counts]
        dist.all_gather(parts, padded)
        return torch.cat([part[:count] for part, count in zip(parts, counts, strict=True)])

    def average(self, parameters: Sequence[nn.Parameter]) -> None:
        gradients = [p.grad for p in parameters if p.grad is not None]
        if not gradients:
            return
        flat = nn.utils.parameters_to_vector(gradients)
        dist.all_reduce(flat)
        nn.utils.vector_to_parameters(flat.div_(self.size), gradients)

    def begin_alike(self, parameters: Sequence[nn.Parameter]) -> None:
        for parameter in parameters:
            dist.broadcast(parameter.data, src=0)


LOOPBACK = "127.0.0.1"


class Rendezvous(NamedTuple):
    """Address of the store."""

    address: str
    port: int


def create(address: str, size: int, timeout_s: float) -> tuple[dist.Store, Rendezvous]:
    """Opens a store on one of this machine's addresses, for `size` processes."""
    listener = socket.socket()
    listener.bind((address, 0))
    listener.listen()
    rendezvous = Rendezvous(address, listener.getsockname()[1])
    # A store that opens its own socket listens on every interface.
    return join(rendezvous, size, timeout_s, master_listen_fd=listener.detach(), is_master=True), rendezvous


def join(rendezvous: Rendezvous, size: int, timeout_s: float, **options: bool | int) -> dist.Store:
    timeout = timedelta(seconds=timeout_s)
    return dist.TCPStore(*rendezvous, world_size=size, timeout=timeout, wait_for_workers=False, **options)


def use_only(address: str) -> None:
    """Have gloo and NCCL use the interface with this address, by environment variables of this process.

    Left alone, gloo takes the one that the host name leads to, which others often cannot reach.
    """
    interfaces = psutil.net_if_addrs().items()
    names = [name for name, addresses in interfaces if any(a.address == address for a in addresses)]
    if not names:
        raise RuntimeError(f"no interface of this machine has the address {address}")
    os.environ["GLOO_SOCKET_IFNAME"] = names[0]
    if address != LOOPBACK:
        os.environ["NCCL_SOCKET_IFNAME"] = names[0]
