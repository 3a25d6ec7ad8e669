# SPDX-License-Identifier: Apache-2.0
"""Where processes of `torch.distributed` find each other: on one address of a machine and on no other."""

from __future__ import annotations

import os
import socket
from datetime import timedelta
from typing import NamedTuple

import psutil
import torch.distributed as dist

LOOPBACK = "127.0.0.1"


class Rendezvous(NamedTuple):
    """Address of the store."""

    address: str
    port: int


def create(address: str, size: int, timeout_s: float) -> tuple[dist.Store, Rendezvous]:
    """Open a store on one of this machine's addresses, for `size` processes."""
    listener = socket.socket()
    listener.bind((address, 0))
    listener.listen()
    rendezvous = Rendezvous(address, listener.getsockname()[1])
    # A store that opens its own socket listens on every interface.
    fd = listener.detach()
    return _store(rendezvous, size, timeout_s, master_listen_fd=fd, is_master=True), rendezvous


def join(rendezvous: Rendezvous, size: int, timeout_s: float) -> dist.Store:
    """Connect to a store that another process has opened."""
    return _store(rendezvous, size, timeout_s)


def _store(rendezvous: Rendezvous, size: int, timeout_s: float, **options: bool | int) -> dist.Store:
    timeout = timedelta(seconds=timeout_s)
    return dist.TCPStore(*rendezvous, world_size=size, timeout=timeout, wait_for_workers=False, **options)


def use_only(address: str) -> None:
    """Have gloo and NCCL use the interface with this address, by environment variables of this process.

    Left alone, gloo takes the one that the host name leads to, which others often cannot reach.

    Raises:
        RuntimeError: no interface has it.
    """
    interfaces = psutil.net_if_addrs().items()
    names = [name for name, addresses in interfaces if any(a.address == address for a in addresses)]
    if not names:
        raise RuntimeError(f"no interface of this machine has the address {address}")
    os.environ["GLOO_SOCKET_IFNAME"] = names[0]
    if address != LOOPBACK:
        os.environ["NCCL_SOCKET_IFNAME"] = names[0]
