# SPDX-License-Identifier: Apache-2.0
"""Messages as bytes: nothing is lost, and nothing that is read is trusted."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.transport import codec
from accerl_lerobot.transport.codec import SIZES, DamagedMessageError, decode, encode
from tests.transport.contract import messages, same


def written(message: Any, start: int = 0, room: int = 0) -> bytearray:
    encoded = encode(message)
    buffer = bytearray(start + encoded.size + room)
    encoded.write(buffer, start)
    return buffer


@pytest.mark.parametrize("start", [0, 128])
@pytest.mark.parametrize("copy", [False, True])
def test_what_is_written_is_read(start: int, copy: bool):
    for message in messages() * 2:  # the second time from memory
        buffer = written(message, start, room=100)
        assert same(decode(buffer, start, len(buffer) - start - 100, copy=copy), message)


def test_views_are_of_the_buffer_and_copies_are_not():
    message = {"image": np.zeros(100, np.uint8)}
    buffer = written(message)
    view, copy = (decode(buffer, 0, len(buffer), copy=own)["image"] for own in (False, True))
    buffer[:] = b"\xff" * len(buffer)
    assert (view == 255).all() and (copy == 0).all()


def test_arrays_begin_at_lines_of_the_cache():
    message = [np.zeros(3, np.uint8), "text", np.zeros(5, np.float64)]
    assert all(offset % 64 == 0 for offset in encode(message).layout.offsets)


def test_equal_structures_are_remembered_and_different_ones_are_not_mixed_up(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(codec, "_layouts", layouts := {})
    monkeypatch.setattr(codec, "_plans", plans := {})
    zeros = np.zeros((2, 3), np.float32)
    alike = [{"a": zeros, "n": 1}, {"a": zeros + 1, "n": 2.5}]
    others = [{"n": 1, "a": zeros}, {"a": zeros.T, "n": 1}, {"a": zeros.astype(np.int32), "n": 1}]
    others += [[zeros, 1], (zeros, 1), {"a": zeros}, {"a": [zeros], "n": 1}, {"a": {"n": zeros}}]
    for message in [*alike, *others]:
        buffer = written(message)
        assert same(decode(buffer, 0, len(buffer)), message)
    assert len(layouts) == len(plans) == 1 + len(others)


def test_what_is_remembered_is_bounded(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(codec, "_layouts", layouts := {})
    monkeypatch.setattr(codec, "_plans", plans := {})
    monkeypatch.setattr(codec, "REMEMBERED", 4)
    for n in range(11):
        buffer = written(np.zeros(n))
        assert decode(buffer, 0, len(buffer)).shape == (n,)
        assert 1 <= len(layouts) <= 4 and 1 <= len(plans) <= 4


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
    for size in (0, 7, 8, 100, len(buffer) - 1, len(buffer) + 1, -1):
        with pytest.raises(DamagedMessageError):
            decode(buffer, 0, size)
    with pytest.raises(DamagedMessageError):
        decode(buffer, -64, len(buffer))


def forged(skeleton: str, values: str = "[]", arrays: int = 0) -> bytes:
    return SIZES.pack(len(skeleton), len(values)) + skeleton.encode() + bytes(arrays) + values.encode()


@pytest.mark.parametrize(
    "message",
    [
        forged('[1,"<f4",[1000000]]'),
        forged('[1,"<f4",[-1]]'),
        forged('[1,"<f4",[4611686018427387904,4]]'),
        forged('[1,"|O",[1]]', arrays=64),
        forged('[1,"<U4",[1]]', arrays=64),
        forged('[1,"<f4",[true]]', arrays=64),
        forged("[1,{},[1]]", arrays=64),
        forged('[6,"Popen",[0]]', "[1]"),
        forged('[6,"Decision",[0]]', "[1]"),
        forged('[6,["Decision"],[0]]', "[1]"),
        forged('[5,["a","b"],[0]]', "[1]"),
        forged("[5,[1],[0]]", "[1]"),
        forged("[3,[0,0]]", "[1]"),
        forged("[3,[0]]", "[1,2]"),
        forged("[3,[0]]", "[[1]]"),
        forged("[3,[0]]", "[1]x"),
        forged("[3,[0]]", '{"a":1}'),
        forged("[9,[0]]", "[1]"),
        forged("[]"),
        forged("{}"),
        forged("3"),
        forged("[" * 100_000),
        SIZES.pack(2**32 - 1, 0) + bytes(100),
        SIZES.pack(0, 2**32 - 1) + bytes(100),
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
        head = SIZES.unpack_from(buffer)[0] + SIZES.size
        for _ in range(2000):
            damaged = bytearray(buffer)
            for _ in range(draw.choice((1, 1, 2, 5))):
                # The header, and the values behind the arrays: any other byte is as good as another.
                place = draw.choice((draw.randrange(head), len(buffer) - 1 - draw.randrange(16)))
                damaged[place] = draw.randrange(256)
            try:
                decode(damaged, 0, len(damaged))
            except DamagedMessageError:
                refused += 1
    assert refused > 2000
