# SPDX-License-Identifier: Apache-2.0
"""The processes that make an update together ("ranks"), by `torch.distributed`; without a group, one process.

Each rank has the whole batch and runs the network on its rows of it. Results of rows are gathered, so that
every rank has those of all rows: targets, moments and metrics are computed from the same values, by the same
code, everywhere, and all ranks agree on whether an update was finite. Only gradients are averaged.

With ``trainer.sharding`` zero2 or zero3 each rank keeps a part of the weights, by PyTorch's FSDP2
(`fully_shard`). The adapter is the root module: `evaluate` and `values` gather its weights and let go of
them. `PolicyAdapter.blocks` are gathered and let go of one by one: modules whose weights are used inside
their own forward pass and nowhere else.
"""

from __future__ import annotations

import math
import os
import socket
from collections.abc import Callable, Sequence
from datetime import timedelta
from functools import partial
from typing import NamedTuple

import numpy as np
import psutil
import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.adapter import PolicyAdapter

LOOPBACK = "127.0.0.1"


def rank() -> int:
    """This process's number, from 0."""
    return dist.get_rank() if dist.is_initialized() else 0


def size() -> int:
    """Number of ranks."""
    return dist.get_world_size() if dist.is_initialized() else 1


class Part(NamedTuple):
    """Rows on which a rank runs the network at once."""

    rows: np.ndarray
    own: bool  # False if the rows are another rank's, and the result is not counted

    def counted(self, result: Tensor) -> Tensor:
        """The result of these rows, (rows, ...), without rows that are not counted."""
        if self.own:
            return result
        return result[:0]


def split_rows(rows: np.ndarray, at_once: int, this_rank: int, ranks: int) -> list[Part]:
    """A rank's share of rows, consecutive ones, in parts of at most `at_once`.

    Every rank gets as many parts, because all ranks have to run a network of which each keeps a part: a rank
    without rows left repeats the first of all.
    """
    shares = np.array_split(rows, ranks)
    share = shares[this_rank]
    parts: list[Part] = []
    for start in range(0, len(share), at_once):
        parts.append(Part(share[start : start + at_once], own=True))
    turns = math.ceil(len(shares[0]) / at_once)
    while len(parts) < turns:
        parts.append(Part(rows[:1], own=False))
    return parts


def gather(local: Tensor, total: int) -> Tensor:
    """All ranks' rows, from each one's own: (total, ...), on the CPU in the order of `np.array_split`."""
    if size() == 1:
        return local
    shares = np.array_split(np.arange(total), size())
    rows = local.new_zeros((total, *local.shape[1:]))
    rows[shares[rank()]] = local
    dist.all_reduce(rows)
    return rows


def over_rows(score: Callable[[np.ndarray], Tensor], rows: np.ndarray, at_once: int) -> Tensor:
    """Results of `score` for rows, (rows, ...) on the CPU; each rank scores its own, `at_once` at a time."""
    parts = split_rows(rows, at_once, rank(), size())
    results = [part.counted(score(part.rows).cpu()) for part in parts]
    return gather(torch.cat(results), len(rows))


def average_gradients(parameters: Sequence[nn.Parameter]) -> None:
    """Puts the mean over ranks into each gradient."""
    gradients = [p.grad for p in parameters if p.grad is not None]
    if size() == 1 or not gradients:
        return
    flat = nn.utils.parameters_to_vector(gradients)
    dist.all_reduce(flat)
    nn.utils.vector_to_parameters(flat.div_(size()), gradients)


def prepare(adapter: PolicyAdapter, config: TrainerConfig) -> None:
    """Gives all ranks the first one's weights; shares them out, and lets blocks recompute, as configured.

    Where weights are shared out, parameters of the adapter are others afterwards.
    """
    if size() > 1:
        for parameter in adapter.trainable().values():
            dist.broadcast(parameter.data, src=0)
    if config.activation_checkpointing:
        recompute(adapter)
    if not config.zero:
        return
    from torch.distributed.device_mesh import init_device_mesh
    from torch.distributed.fsdp import fully_shard, register_fsdp_forward_method

    mesh = init_device_mesh(adapter.device.type, (size(),))
    reshard = config.sharding == "zero3"
    for module in (*adapter.blocks(), adapter):
        fully_shard(module, mesh=mesh, reshard_after_forward=reshard)
    for name in ("evaluate", "values"):
        register_fsdp_forward_method(adapter, name)


def recompute(adapter: PolicyAdapter) -> None:
    """Has blocks of several layers compute again for the gradient what they computed before."""
    layers = [block for block in adapter.blocks() if list(block.children())]
    if not layers:
        hint = "no block of this policy can be computed again by itself; leave the field out"
        raise InputError("trainer.activation_checkpointing", True, hint)
    for layer in layers:
        # FSDP's hooks stand around this, at the module's call: weights are there when it is repeated.
        layer.forward = partial(checkpoint, layer.forward, use_reentrant=False)


def open_store(address: str, ranks: int, timeout_s: float) -> tuple[dist.Store, int]:
    """A store on one of this machine's addresses where so many ranks meet, and its port."""
    listener = socket.socket()
    listener.bind((address, 0))
    listener.listen()
    port = listener.getsockname()[1]
    # A store that opens its own socket listens on every interface.
    return store_at(address, port, ranks, timeout_s, master_listen_fd=listener.detach(), is_master=True), port


def store_at(address: str, port: int, ranks: int, timeout_s: float, **options: bool | int) -> dist.Store:
    timeout = timedelta(seconds=timeout_s)
    return dist.TCPStore(address, port, world_size=ranks, timeout=timeout, wait_for_workers=False, **options)


def join(store: dist.Store, this_rank: int, ranks: int, device: torch.device, timeout_s: float) -> None:
    """Become one of several ranks, once all of them have come."""
    # Gathered tensors are on the CPU.
    backend = "gloo"
    if device.type != "cpu":
        backend = f"cpu:gloo,{device.type}:nccl"
    timeout = timedelta(seconds=timeout_s)
    dist.init_process_group(backend, store=store, rank=this_rank, world_size=ranks, timeout=timeout)


def use_only(address: str) -> None:
    """Have gloo and NCCL use the interface with this address, by environment variables of this process.

    Left alone, gloo takes the one that the host name leads to, which others often cannot reach.
    """
    for name, addresses in psutil.net_if_addrs().items():
        if any(entry.address == address for entry in addresses):
            os.environ["GLOO_SOCKET_IFNAME"] = name
            if address != LOOPBACK:
                os.environ["NCCL_SOCKET_IFNAME"] = name
            return
    raise RuntimeError(f"no interface of this machine has the address {address}")
