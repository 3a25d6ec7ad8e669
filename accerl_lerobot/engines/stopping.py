# SPDX-License-Identifier: Apache-2.0
"""Stopping a run by SIGTERM, as schedulers send it, or Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGTERM, signal.SIGINT)


class WorkerError(RuntimeError):
    """A worker is lost for good, and the engine with it; another engine can resume from a checkpoint."""


class StoppedError(Exception):
    """A run was asked to stop, and can be resumed."""

    def __init__(self, number: int, words: str) -> None:
        self.number = number
        super().__init__(words)


class TerminatedError(KeyboardInterrupt):
    """SIGTERM came; handled like Ctrl-C."""


@contextmanager
def handled(
    handler: Callable[[int, FrameType | None], None] | None = None, numbers: Sequence[int] = SIGNALS
) -> Iterator[None]:
    """Handle signals in this context by `handler`, if there is one, and as before afterwards.

    Libraries such as Ray install handlers of their own when they start.
    """
    if threading.current_thread() is not threading.main_thread():  # Python allows it nowhere else
        yield
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}
    if handler is not None:
        for number in numbers:
            signal.signal(number, handler)
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


@contextmanager
def left_to_this_process() -> Iterator[None]:
    """Processes that are started in this context, and theirs, do not notice SIGTERM.

    Schedulers send it to all processes of a job. The run then still needs its workers, to save what they
    have.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def interrupted() -> Iterator[None]:
    """Handle SIGTERM like Ctrl-C: what has been started is ended on the way out."""

    def end(number: int, frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_IGN)  # a second one would interrupt what ends the rest
        raise TerminatedError

    with handled(end, [signal.SIGTERM]):
        yield


class Stopping:
    """Notes the first signal (`note` is the handler). A second one interrupts at once.

    `how` is the command that resumes the run.
    """

    def __init__(self, how: str = "") -> None:
        self.asked: int | None = None  # the signal's number
        self._how = how
        self._waits = True

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

    def note(self, number: int, frame: FrameType | None) -> None:
        again = self.asked is not None
        self.asked = self.asked or number
        if again or not self._waits:
            raise KeyboardInterrupt
