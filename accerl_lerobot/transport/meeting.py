# SPDX-License-Identifier: Apache-2.0
"""Where processes meet that talk through torch.distributed, on one address of a machine and on no other."""

from __future__ import annotations

import os
import socket
from datetime import timedelta
from typing import NamedTuple

import psutil
import torch.distributed as dist

LOOPBACK = "127.0.0.1"


class Meeting(NamedTuple):
    """Where they find each other."""

    address: str
    port: int


def host(address: str, size: int, timeout_s: float) -> tuple[dist.Store, Meeting]:
    """Opens a meeting place on one of this machine's addresses, and on no other.

    Args:
        address: the loopback, where all are on one machine.
        size: how many will come.
        timeout_s: how long they wait for what another one has to say there.
    """
    listener = socket.socket()
    listener.bind((address, 0))
    listener.listen()
    meeting = Meeting(address, listener.getsockname()[1])
    # A store that opens its own socket listens on every interface.
    return _store(meeting, size, timeout_s, master_listen_fd=listener.detach(), is_master=True), meeting


def visit(meeting: Meeting, size: int, timeout_s: float) -> dist.Store:
    """Goes to a meeting place that another one has opened."""
    return _store(meeting, size, timeout_s)


def _store(meeting: Meeting, size: int, timeout_s: float, **options: bool | int) -> dist.Store:
    timeout = timedelta(seconds=timeout_s)
    return dist.TCPStore(*meeting, world_size=size, timeout=timeout, wait_for_workers=False, **options)


def only_at(address: str) -> None:
    """Has gloo and NCCL use the interface with this address; they read variables of this process.

    Left alone, gloo takes the one that this machine's name leads to, which others often cannot reach.

    Raises:
        RuntimeError: no interface has it.
    """
    names = [
        name for name, found in psutil.net_if_addrs().items() if any(a.address == address for a in found)
    ]
    if not names:
        raise RuntimeError(f"no interface of this machine has the address {address}")
    os.environ["GLOO_SOCKET_IFNAME"] = names[0]
    if address != LOOPBACK:
        os.environ["NCCL_SOCKET_IFNAME"] = names[0]
