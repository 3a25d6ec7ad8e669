# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Being asked to stop: SIGTERM, as schedulers send it, or Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGTERM, signal.SIGINT)


class StoppedError(Exception):
    """A run was asked to stop, and what it takes to go on is on disk.

    Args:
        number: of the signal.
        words: for people: what was saved and how to go on.
    """

    def __init__(self, number: int, words: str) -> None:
        self.number = number
        super().__init__(words)


@contextmanager
def unwound() -> Iterator[None]:
    """SIGTERM ends what is inside as an error would, so that what it has started is ended, too.

    Raises:
        SystemExit: it came.
    """

    def end(number: int, frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_IGN)  # a second one would interrupt what ends the rest
        raise SystemExit(128 + number)

    if threading.current_thread() is not threading.main_thread():  # Python allows it nowhere else
        yield
        return
    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


class Stopping:
    """Notes the first such signal; a second one interrupts at once.

    Example:
        >>> with Stopping() as stop:
        ...     while stop.asked is None:
        ...         do_a_little()
    """

    def __init__(self) -> None:
        self.asked: int | None = None
        """The signal's number."""
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Stopping:
        if threading.current_thread() is threading.main_thread():  # Python allows it nowhere else
            self._before = {number: signal.signal(number, self._note) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    @staticmethod
    @contextmanager
    def kept() -> Iterator[None]:
        """Puts handlers back that a library replaces by its own inside, as Ray does when it starts."""
        before = {number: signal.getsignal(number) for number in SIGNALS}
        yield
        if threading.current_thread() is threading.main_thread():
            for number, handler in before.items():
                signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.asked is not None:
            raise KeyboardInterrupt
        self.asked = number
