# SPDX-License-Identifier: Apache-2.0
"""Messages as bytes: nothing is lost, and nothing that is read is trusted."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.transport.codec import SIZE, DamagedMessageError, decode, encode
from tests.transport.contract import messages, same


def written(message: Any, start: int = 0, room: int = 0) -> bytearray:
    encoded = encode(message)
    buffer = bytearray(start + encoded.size + room)
    encoded.write(buffer, start)
    return buffer


@pytest.mark.parametrize("start", [0, 128])
@pytest.mark.parametrize("copy", [False, True])
def test_what_is_written_is_read(start: int, copy: bool):
    for message in messages():
        buffer = written(message, start, room=100)
        assert same(decode(buffer, start, len(buffer) - start - 100, copy=copy), message)


def test_views_are_of_the_buffer_and_copies_are_not():
    message = {"image": np.zeros(100, np.uint8)}
    buffer = written(message)
    view, copy = (decode(buffer, 0, len(buffer), copy=own)["image"] for own in (False, True))
    buffer[:] = b"\xff" * len(buffer)
    assert (view == 255).all() and (copy == 0).all()


@dataclass
class Stranger:
    """An object of no registered kind."""

    a: int = 1


ITSELF: list[Any] = []
ITSELF.append(ITSELF)


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (Stranger(), "a Stranger cannot be sent"),
        ([{1, 2}], "a set cannot be sent"),
        ({1: "a"}, "whose keys are not texts"),
        (np.array([object()]), "an array of object cannot be sent"),
        (np.array(["text"]), "an array of <U4 cannot be sent"),
        (ITSELF, "what holds itself cannot be sent"),
    ],
)
def test_what_cannot_be_sent_is_refused(message: Any, said: str):
    with pytest.raises(TypeError, match=said):
        encode(message)


def test_part_of_a_message_is_refused():
    buffer = written(messages()[1])
    for size in (0, 3, 4, 100, len(buffer) - 1, len(buffer) + 1, -1):
        with pytest.raises(DamagedMessageError):
            decode(buffer, 0, size)
    with pytest.raises(DamagedMessageError):
        decode(buffer, -64, len(buffer))


def forged(header: str, arrays: int = 0) -> bytes:
    return SIZE.pack(len(header)) + header.encode() + bytes(arrays)


@pytest.mark.parametrize(
    "message",
    [
        forged('[0,"<f4",1000000]'),
        forged('[0,"<f4",-1]'),
        forged('[0,"<f4",4611686018427387904,4]'),
        forged('[0,"|O",1]', arrays=64),
        forged('[0,"<U4",1]', arrays=64),
        forged('[0,"<f4",1.5]', arrays=64),
        forged('[0,"<f4"]', arrays=3),
        forged("[0,{},1]", arrays=64),
        forged('[1,"<f4",1]', arrays=64),
        forged('[4,"Popen",1]'),
        forged('[4,"Decision",1]'),
        forged('[4,["Decision"],1]'),
        forged("[4]"),
        forged("[9,1]"),
        forged('["a",1]'),
        forged("[]"),
        forged("3 4"),
        forged("3", arrays=1),
        forged("[" * 100_000),
        SIZE.pack(2**32 - 1) + bytes(100),
        b"\xff" * 64,
    ],
)
def test_what_nobody_has_written_is_refused(message: bytes):
    with pytest.raises(DamagedMessageError, match="a message that cannot be read: "):
        decode(bytearray(message), 0, len(message))


def test_damaged_messages_are_read_or_refused_and_nothing_else():
    draw, refused = random.Random(0), 0
    for message in messages():
        buffer = written(message)
        head = SIZE.unpack_from(buffer)[0] + SIZE.size
        for _ in range(2000):
            damaged = bytearray(buffer)
            for _ in range(draw.choice((1, 1, 2, 5))):
                damaged[draw.randrange(head)] = draw.randrange(256)
            try:
                decode(damaged, 0, len(damaged))
            except DamagedMessageError:
                refused += 1
    assert refused > 2000
