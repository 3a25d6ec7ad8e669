# SPDX-License-Identifier: Apache-2.0
"""Stopping a run by SIGTERM, as schedulers send it, or Ctrl-C; and resuming it."""

from __future__ import annotations

import fcntl
import os
import shlex
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple

from accerl_lerobot.errors import InputError, make_folder

if TYPE_CHECKING:
    from accerl_lerobot.engine.config import RunConfig

SIGNALS = (signal.SIGTERM, signal.SIGINT)
LOCK = ".lock"
CHANGEABLE = (
    "resume", "output_dir", "evaluation", "launch", "wandb", "save_every_updates", "save_every_s",
    "save_keep", "trainer.updates", "trainer.num_threads", "trainer.ranks", "trainer.sharding",
    "trainer.activation_checkpointing", "trainer.rank_timeout_s",
    "rollout.max_restarts", "inference",
    "imagination.discover_packages_path",
)  # fmt: skip
"""Fields and sections that may change when a run is resumed: what is learned, and from what, stays."""
_pipe: tuple[int, int] | None = None
"""Where C code notes signals, also while the main thread hangs and Python handles none."""
_arrived = False


def arrived() -> bool:
    """True if one of `SIGNALS` has come since a context of this module was entered."""
    global _arrived
    with suppress(OSError):  # none has come
        numbers = b"" if _pipe is None else os.read(_pipe[0], 64)
        _arrived = _arrived or any(number in numbers for number in SIGNALS)
    return _arrived


def _listen() -> None:
    """Have signals noted from now on."""
    global _pipe, _arrived
    if _pipe is None:
        _pipe = os.pipe()
        for end in _pipe:
            os.set_blocking(end, False)
    signal.set_wakeup_fd(_pipe[1], warn_on_full_buffer=False)
    arrived()
    _arrived = False


class StoppedError(Exception):
    """A run was asked to stop, and can be resumed.

    Args:
        number: of the signal.
        words: for people: how to resume.
    """

    def __init__(self, number: int, words: str) -> None:
        self.number = number
        super().__init__(words)


class TerminatedError(KeyboardInterrupt):
    """SIGTERM came; handled like Ctrl-C."""


@contextmanager
def interrupted() -> Iterator[None]:
    """Handle SIGTERM like Ctrl-C: what has been started is ended on the way out.

    Raises:
        TerminatedError: it came.
    """

    def end(number: int, frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_IGN)  # a second one would interrupt what ends the rest
        raise TerminatedError

    if threading.current_thread() is not threading.main_thread():  # Python allows it nowhere else
        yield
        return
    before = signal.signal(signal.SIGTERM, end)
    _listen()
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
    """Cancel the alarm that follows a signal, until and when the context is left."""
    while not left.wait(1.0):
        if arrived():
            signal.alarm(0)
    if arrived():
        signal.alarm(0)


class Stopping:
    """Notes the first signal; a second one interrupts at once.

    Example:
        >>> with Stopping() as stop:
        ...     while stop.asked is None:
        ...         do_a_little()
    """

    def __init__(self) -> None:
        self.asked: int | None = None
        """The signal's number."""
        self._waits = True
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Stopping:
        if threading.current_thread() is threading.main_thread():  # Python allows it nowhere else
            self._before = {number: signal.signal(number, self._note) for number in SIGNALS}
            _listen()
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Have the first signal interrupt this context, in which there is nothing new to be saved."""
        self._waits = False
        try:
            if self.asked is not None:
                raise KeyboardInterrupt
            yield
        finally:
            self._waits = True

    def _note(self, number: int, frame: FrameType | None) -> None:
        again, self.asked = self.asked is not None, self.asked or number
        if again or not self._waits:
            raise KeyboardInterrupt


def raise_if_stopped(stop: Stopping, directory: Path) -> None:
    """End a run that was asked to stop.

    Raises:
        StoppedError: it was.
    """
    if stop.asked is not None:
        words = f"stopped by {signal.Signals(stop.asked).name}; to resume: {resume_command(directory)}"
        raise StoppedError(stop.asked, words)


def resume_command(directory: Path) -> str:
    """The command that resumes a run."""
    from accerl_lerobot.checkpoint.layout import CONFIG

    return f"accerl train --resume=true --config_path={shlex.quote(str(directory / CONFIG))}"


class ResumedRun(NamedTuple):
    """A run that was begun before."""

    directory: Path
    checkpoint: str
    """Name of the checkpoint to resume from: ``last``, or a number."""


def resumed_run(path: Path | None, config: RunConfig) -> ResumedRun:
    """The run that a config file belongs to.

    Args:
        path: ``--config_path``: ``RUN/config.yaml`` or ``RUN/checkpoints/NNNNNN/config.yaml``.
        config: the run as it is to be resumed.

    Raises:
        InputError: the file is of no run, a setting differs that must not, or there is nothing left to do.
    """
    from accerl_lerobot.checkpoint.layout import CHECKPOINTS, CONFIG, LAST, SUMMARY
    from accerl_lerobot.checkpoint.safety import Origin, check_folder, check_number, read_json
    from accerl_lerobot.config.parsing import CONSENT, decode, encode, read_recipe

    how = "name RUN/config.yaml or RUN/checkpoints/last/config.yaml"
    if path is None:
        raise InputError("resume", True, f"add --config_path: {how}")
    folders = path.absolute().parents
    directory, checkpoint = folders[0], LAST
    if len(folders) > 2 and folders[1].name == CHECKPOINTS:
        directory, checkpoint = folders[2], folders[0].name
    if not (directory / CONFIG).is_file() or not (directory / LOCK).is_file():
        raise InputError("config_path", str(path), f"no run has been begun there; {how}")
    origin = Origin("config_path", str(path))
    check_folder(directory, origin)
    before = decode(type(config), read_recipe(directory / CONFIG))
    for name, (was, now) in _differences(encode(before), encode(config), "").items():
        if not was and name.rpartition(".")[2] in CONSENT:
            continue  # a pull has dropped it, and the command line allows it anew
        if not any(name == free or name.startswith(f"{free}.") for free in CHANGEABLE):
            remedy = f"the run was begun with {was!r}; leave it so, or begin a new run with --policy.path"
            raise InputError(name, now, remedy)
    summary, checkpoints = directory / SUMMARY, directory / CHECKPOINTS
    newest = (checkpoints / checkpoint).resolve() == (checkpoints / LAST).resolve()
    # From an earlier checkpoint there are updates left to make.
    if newest and summary.is_file():
        made: Any = read_json(summary, origin).get("updates")
        check_number(made, 0, 1e9, f"{SUMMARY}: updates", origin)
        if made >= config.trainer.updates:
            remedy = f"the run {directory} has made them, and has ended; ask for more"
            raise InputError("trainer.updates", config.trainer.updates, remedy)
    return ResumedRun(directory, checkpoint)


def _differences(before: Any, now: Any, name: str) -> dict[str, tuple[Any, Any]]:
    """Dotted field → old and new value, where they differ."""
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return {} if before == now else {name: (before, now)}
    differences: dict[str, tuple[Any, Any]] = {}
    for key in before.keys() | now.keys():
        differences |= _differences(before.get(key), now.get(key), f"{name}.{key}" if name else str(key))
    return differences


@contextmanager
def locked(directory: Path, field: str, in_use: str) -> Iterator[int]:
    """Keep other processes out of a folder, which is made if need be.

    Args:
        field: that the folder was given by.
        in_use: remedy of the error if another process has locked it.

    Returns:
        A file descriptor to hand to child processes that are to keep it locked.

    Raises:
        InputError: it is in use.
    """
    make_folder(directory, field, again=True)
    with (directory / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(field, str(directory), in_use) from error
        yield file.fileno()
