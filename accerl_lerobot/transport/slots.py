# SPDX-License-Identifier: Apache-2.0
"""Memory that two processes share, and the tokens that say what is in it.

A slot is memory without a name, see `nameless`.
"""

from __future__ import annotations

import mmap
import os
import socket
import struct
from typing import NamedTuple

from accerl_lerobot.transport.codec import DamagedMessageError
from accerl_lerobot.transport.nameless import is_sealed, new_memory

LARGEST = 2**31
"""Bytes of a slot at most."""
LEAST = 2**16
"""Bytes of a slot at least; what a message leaves of it is room for the reply."""
SLOTS = 64
"""Slots of one caller at most, and so messages that it may have under way. Their tokens fit into the buffers
of the two sockets, so no end ever waits for the other one to read."""
_TOKEN = struct.Struct("<BIQQQd")
_ROOM_FOR_A_FILE = socket.CMSG_LEN(struct.calcsize("i"))

ASK, ANSWER, FAIL = range(3)
"""Purpose of a token."""


class Token(NamedTuple):
    """Message on the socket; a file goes with it where the slot is new or has been replaced."""

    what: int
    slot: int
    ticket: int
    start: int
    """First byte of the message in the slot."""
    size: int
    """Bytes of the message."""
    sent: float
    """On `time.monotonic`."""


class Slot:
    """Shared memory of a fixed size, which lasts as long as somebody refers to it or to a view of it.

    Args:
        file: of it; not needed any more, as the mapping keeps one of its own.

    Raises:
        DamagedMessageError: it is not one that `new_file` makes.
    """

    def __init__(self, file: int) -> None:
        try:
            self.size = os.fstat(file).st_size
            if not LEAST <= self.size <= LARGEST or not is_sealed(file):
                raise DamagedMessageError(f"no slot, but a file of {self.size} bytes whose size may change")
            self.memory = mmap.mmap(file, self.size)
        except OSError as error:
            raise DamagedMessageError(f"a slot that cannot be mapped: {error}") from error


def new_file(room: int) -> int:
    """Shared memory for at least so many bytes, as a file descriptor.

    Raises:
        TypeError: nothing that large is sent.
    """
    size = max(LEAST, 1 << (room - 1).bit_length())
    if size > LARGEST:
        raise TypeError(f"a message of {room} bytes cannot be sent; there is room for {LARGEST}")
    return new_memory(size)


def send(connection: socket.socket, token: Token, file: int | None = None) -> None:
    """Sends a token; a file goes along and is closed here."""
    if file is None:
        connection.send(_TOKEN.pack(*token))
        return
    try:
        socket.send_fds(connection, [_TOKEN.pack(*token)], [file])
    finally:
        os.close(file)


def receive(connection: socket.socket) -> tuple[Token, Slot | None] | None:
    """The next token, and the slot that came with it; None if the other end is gone.

    Raises:
        DamagedMessageError: that was none.
    """
    packet, ancillary, _, _ = connection.recvmsg(_TOKEN.size + 1, _ROOM_FOR_A_FILE)
    file = None
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:
            (file,) = struct.unpack("i", data)  # the kernel keeps what there is no room for
    try:
        if not packet:
            return None
        if len(packet) != _TOKEN.size:
            raise DamagedMessageError(f"a token of {len(packet)} bytes")
        return Token._make(_TOKEN.unpack(packet)), None if file is None else Slot(file)
    finally:
        if file is not None:
            os.close(file)
