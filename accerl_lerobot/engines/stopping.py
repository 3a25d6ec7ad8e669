# SPDX-License-Identifier: Apache-2.0
"""Stopping a run by SIGTERM, as schedulers send it, or Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGTERM, signal.SIGINT)
LONGEST_PAUSE_S = 8.0


def pause_s(restarts: int) -> float:
    """Seconds to wait before another restart; twice as long each time, up to `LONGEST_PAUSE_S`."""
    return min(2.0 ** (restarts - 1), LONGEST_PAUSE_S) if restarts else 0.0


class WorkerError(RuntimeError):
    """A worker is lost for good, and the engine with it; another engine can resume from a checkpoint."""

    @property
    def brief(self) -> bool:
        """True if it has no traceback of a worker."""
        return "\n" not in str(self)


class StoppedError(Exception):
    """A run was asked to stop, and can be resumed."""

    def __init__(self, number: int, words: str) -> None:
        self.number = number
        super().__init__(words)


class TerminatedError(KeyboardInterrupt):
    """SIGTERM came; handled like Ctrl-C."""


@contextmanager
def interrupted() -> Iterator[None]:
    """Handle SIGTERM like Ctrl-C: what has been started is ended on the way out."""

    def end(number: int, frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_IGN)  # a second one would interrupt what ends the rest
        raise TerminatedError

    if threading.current_thread() is not threading.main_thread():  # Python allows it nowhere else
        yield
        return
    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def deferred() -> Iterator[None]:
    """Handle signals when the context is left, for the start of a library with handlers of its own.

    Ray's handler in Python exits; its handler in C++ prints a trace and sets an alarm that aborts after 3 s,
    which can be cancelled only if its C++ code releases the interpreter's lock by then.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before = {number: signal.signal(number, lambda number, _: came.append(number)) for number in SIGNALS}
    real, left = signal.signal, threading.Event()
    signal.signal = lambda number, handler: None if number in SIGNALS else real(number, handler)  # type: ignore[assignment]
    thread = threading.Thread(target=_cancel_alarms, args=(left,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        signal.signal = real
        for number, handler in before.items():
            signal.signal(number, handler)
        left.set()
        thread.join()
        if came:
            signal.raise_signal(came[0])


def _cancel_alarms(left: threading.Event) -> None:
    while not left.wait(1.0):
        signal.alarm(0)
    signal.alarm(0)


class Stopping:
    """Notes the first signal; a second one interrupts at once. `how`: the command that resumes the run."""

    def __init__(self, how: str = "") -> None:
        self.asked: int | None = None  # the signal's number
        self._how, self._waits = how, True
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Stopping:
        if threading.current_thread() is threading.main_thread():  # Python allows it nowhere else
            self._before = {number: signal.signal(number, self._note) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def check(self) -> None:
        """End the run if a signal has come."""
        if self.asked is not None:
            name = signal.Signals(self.asked).name
            raise StoppedError(self.asked, f"stopped by {name}; to resume: {self._how}")

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Have the first signal end the run in this context, in which there is nothing new to be saved."""
        self._waits = False
        try:
            self.check()
            yield
        except KeyboardInterrupt:
            self.check()
            raise
        finally:
            self._waits = True

    def _note(self, number: int, frame: FrameType | None) -> None:
        again, self.asked = self.asked is not None, self.asked or number
        if again or not self._waits:
            raise KeyboardInterrupt
