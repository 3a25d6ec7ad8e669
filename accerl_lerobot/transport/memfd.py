# SPDX-License-Identifier: Apache-2.0
"""Memory that two processes of one user share, the sockets it is sent through, and message slots in it.

Memory is a memfd and a socket's name is in Linux's abstract namespace, so a process that is killed leaves
neither behind. Other users could see a socket's name and connect; each end asks the kernel whose process the
other one is and talks to its own user only.
"""

from __future__ import annotations

import fcntl
import functools
import mmap
import os
import secrets
import select
import socket
import struct
from typing import NamedTuple

ALIGNMENT = 64
"""Alignment of arrays in shared memory, in bytes: a cache line."""
LARGEST = 2**40
"""Bytes of a slot at most."""
LEAST = 2**16
"""Bytes of a slot at least; the reply is written behind the message."""
SLOTS = 64
"""Slots of one client at most, and so messages that it may have under way. Their tokens fit into the buffers
of the two sockets, so no end ever waits for the other one to read."""
_TOKEN = struct.Struct("<BIQQQd")
ASK, ANSWER, FAIL = range(3)
"""Purpose of a token."""


@functools.cache
def available() -> bool:
    """True if this system has memfd, epoll and eventfd."""
    try:
        os.close(new_memory(1))
        select.epoll().close()
        os.close(os.eventfd(0))
    except (AttributeError, OSError):
        return False
    return True


def new_memory(size: int) -> int:
    """Shared memory, as a file descriptor.

    Its size is sealed: truncating it would end every process that has it mapped.
    """
    file = os.memfd_create("accerl", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(file, size)
        fcntl.fcntl(file, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
    except BaseException:
        os.close(file)
        raise
    return file


def new_name() -> str:
    """A socket name that nobody can guess."""
    return f"accerl-{secrets.token_hex(16)}"


def new_socket() -> socket.socket:
    """A socket whose messages keep their borders and order, and can carry file descriptors."""
    return socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)


def listening(name: str, backlog: int) -> socket.socket:
    """A socket that others connect to by this name."""
    listener = new_socket()
    listener.bind(f"\0{name}")
    listener.listen(backlog)
    return listener


def same_user(connection: socket.socket) -> bool:
    """True if the process at the other end belongs to this user."""
    size = struct.calcsize("3i")
    _, user, _ = struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size))
    return bool(user == os.getuid())


def aligned(offset: int) -> int:
    """The next offset at which an array may begin."""
    return -(-offset // ALIGNMENT) * ALIGNMENT


class Token(NamedTuple):
    """Message on the socket. A file descriptor goes with it where the slot is new or has been replaced."""

    purpose: int
    slot: int
    ticket: int
    start: int
    """First byte of the message in the slot."""
    size: int
    """Bytes of the message."""
    sent: float
    """On `time.monotonic`."""


class Slot:
    """Mapped shared memory of a fixed size, which lasts as long as something refers to it or a view of it.

    Args:
        file: descriptor, which can be closed afterwards.
    """

    def __init__(self, file: int) -> None:
        self.size = os.fstat(file).st_size
        self.memory = mmap.mmap(file, self.size)


def new_slot(size: int) -> int:
    """Shared memory for at least `size` bytes, as a file descriptor."""
    room = max(LEAST, 1 << (size - 1).bit_length())
    if room > LARGEST:
        raise TypeError(f"a message of {size} bytes cannot be sent; there is room for {LARGEST}")
    return new_memory(room)


def send_token(connection: socket.socket, token: Token, file: int | None = None) -> None:
    """Send a token; a file descriptor goes with it and is closed here."""
    if file is None:
        connection.send(_TOKEN.pack(*token))
        return
    try:
        socket.send_fds(connection, [_TOKEN.pack(*token)], [file])
    finally:
        os.close(file)


def receive_token(connection: socket.socket) -> tuple[Token, Slot | None] | None:
    """The next token, and the slot that came with it; None if the other end is gone."""
    packet, files, _, _ = socket.recv_fds(connection, _TOKEN.size, 1, socket.MSG_CMSG_CLOEXEC)
    if not packet:
        return None
    slot = None
    if files:
        slot = Slot(files[0])
        os.close(files[0])
    return Token._make(_TOKEN.unpack(packet)), slot
