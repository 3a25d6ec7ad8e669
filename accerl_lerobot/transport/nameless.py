# SPDX-License-Identifier: Apache-2.0
"""Memory that two processes of one user share without a name, and the socket it is sent through.

Memory is a memfd and a socket's name is in Linux's abstract namespace, so nothing is left of either when
whoever holds it is gone, however that ended. Other users could see a socket's name, which says nothing, and
connect; each end asks the kernel whose process the other one is and talks to its own user only.
"""

from __future__ import annotations

import fcntl
import functools
import os
import secrets
import select
import socket
import struct

ALIGNMENT = 64
"""Alignment of arrays in shared memory, in bytes: a line of the cache."""


@functools.cache
def available() -> bool:
    """True if this system has what it takes."""
    try:
        os.close(new_memory(1))
        select.epoll().close()
        os.close(os.eventfd(0))
    except (AttributeError, OSError):
        return False
    return True


def new_memory(size: int) -> int:
    """Memory of so many bytes, as a file descriptor.

    Its size is sealed: taking pages away under the feet of who maps them would end that process.
    """
    file = os.memfd_create("accerl", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(file, size)
        fcntl.fcntl(file, fcntl.F_ADD_SEALS, _seals())
    except BaseException:
        os.close(file)
        raise
    return file


def is_sealed(file: int) -> bool:
    """True if the size of this memory cannot change any more."""
    return fcntl.fcntl(file, fcntl.F_GET_SEALS) & _seals() == _seals()


def _seals() -> int:
    return fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL


def new_name() -> str:
    """A name for a socket that nobody can guess."""
    return f"accerl-{secrets.token_hex(16)}"


def new_socket() -> socket.socket:
    """Its messages stay whole and in order, and take file descriptors along."""
    return socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)


def listening(name: str, waiting: int) -> socket.socket:
    """A socket that others connect to by this name; so many may be waiting to be let in."""
    listener = new_socket()
    listener.bind(f"\0{name}")
    listener.listen(waiting)
    return listener


def same_user(connection: socket.socket) -> bool:
    """True if the process at the other end is of this user."""
    size = struct.calcsize("3i")
    _, user, _ = struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size))
    return bool(user == os.getuid())


def aligned(offset: int) -> int:
    """The next place at which an array may begin."""
    return -(-offset // ALIGNMENT) * ALIGNMENT
