# SPDX-License-Identifier: Apache-2.0
"""Messages as bytes: nothing is lost, and what cannot be sent is refused."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.transport.shared_memory import pack, unpack
from tests.transport.contract import messages, same


def written(message: Any, start: int = 0, room: int = 0) -> bytearray:
    packed = pack(message)
    buffer = bytearray(start + packed.size + room)
    packed.write(buffer, start)
    return buffer


@pytest.mark.parametrize("start", [0, 128])
@pytest.mark.parametrize("copy", [False, True])
def test_what_is_written_is_read(start: int, copy: bool):
    for message in messages():
        buffer = written(message, start, room=100)
        assert same(unpack(buffer, start, copy=copy), message)


def test_views_are_of_the_buffer_and_copies_are_not():
    message = {"image": np.zeros(100, np.uint8)}
    buffer = written(message)
    view, copy = (unpack(buffer, copy=own)["image"] for own in (False, True))
    buffer[:] = b"\xff" * len(buffer)
    assert (view == 255).all() and (copy == 0).all()


@dataclass
class Stranger:
    """An object of no registered kind."""

    a: int = 1


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (Stranger(), "message: a Stranger cannot be"),
        ([{1, 2}], "message.0: a set cannot be"),
        (np.array([object()]), "an array of object cannot be"),
        (np.array(["text"]), "an array of <U4 cannot be"),
    ],
)
def test_what_cannot_be_sent_is_refused(message: Any, said: str):
    with pytest.raises(TypeError, match=said):
        pack(message)
