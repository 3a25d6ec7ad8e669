# SPDX-License-Identifier: Apache-2.0
"""Stopping a run by SIGTERM, as schedulers send it, or Ctrl-C; and resuming one, also after a loss."""

from __future__ import annotations

import fcntl
import json
import os
import shlex
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple

from accerl_lerobot.errors import InputError, is_full, make_folder

if TYPE_CHECKING:
    from accerl_lerobot.console import Console
    from accerl_lerobot.engine.config import RunConfig

SIGNALS = (signal.SIGTERM, signal.SIGINT)
LOCK = ".lock"
CHANGEABLE = (
    "resume", "output_dir", "evaluation", "launch", "wandb", "save_every_updates", "save_every_s",
    "trainer.updates", "trainer.num_threads", "trainer.ranks", "trainer.sharding",
    "trainer.activation_checkpointing", "trainer.rank_timeout_s", "inference",
    "imagination.discover_packages_path",
)  # fmt: skip
"""Fields and sections that may change when a run is resumed: what is learned, and from what, stays."""
LONGEST_PAUSE_S = 8.0
WARM_START = "warm_start.json"
"""File with the path of the policy that came of a run's own demonstrations and SFT."""
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
    """Notes the first signal; a second one interrupts at once."""

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
    """End a run that was asked to stop."""
    if (number := stop.asked) is not None:
        how = resume_command(directory)
        raise StoppedError(number, f"stopped by {signal.Signals(number).name}; to resume: {how}")


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


class Recovery:
    """Chooses the checkpoint to resume from after a loss, unless that happens again and again."""

    def __init__(self, most: int) -> None:
        self._most, self._times, self._begun, self._furthest = most, 0, "", -1

    def next(self, checkpoints: Path, console: Console, error: WorkerError, furthest: int) -> Path:
        """The checkpoint to resume from; waits longer each time without progress in between.

        Args:
            furthest: the latest update so far. A run that gets further each time is not stuck, though it may
                be hit again before its next checkpoint.
        """
        from accerl_lerobot.checkpoint.layout import newest_whole

        try:
            path, passed = newest_whole(checkpoints)
        except InputError:
            raise error from None
        stuck = path.name == self._begun and furthest <= self._furthest
        self._times = self._times + 1 if stuck else 1
        self._begun, self._furthest = path.name, max(furthest, self._furthest)
        if self._times > self._most:
            raise error
        for why in passed:
            console.say(f"passed over checkpoint {why}")
        pause = pause_s(self._times - 1)
        when = f" in {pause:.0f} s" if pause else ""
        reason = f"the disk of {checkpoints.parent} is full" if is_full(error) else error
        console.say(f"{reason}\ngoing on from {path}{when} ({self._times} of {self._most} times)")
        time.sleep(pause)
        return path


def checkpoint_of(directory: Path, wanted: str, console: Console) -> Path | None:
    """The checkpoint to resume from; None if there is none yet."""
    from accerl_lerobot.checkpoint.layout import CHECKPOINTS, has_checkpoint, newest_whole
    from accerl_lerobot.metrics import METRICS
    from accerl_lerobot.replay.journal import EPISODES

    if not has_checkpoint(directory / CHECKPOINTS):
        console.say("there is no checkpoint yet: the run begins again after its warm start")
        for name in (METRICS, EPISODES):
            (directory / name).unlink(missing_ok=True)
        shutil.rmtree(directory / "tensorboard", ignore_errors=True)
        return None
    path, passed = newest_whole(directory / CHECKPOINTS, wanted)
    for why in passed:
        console.say(f"passed over checkpoint {why}")
    return path


def continued(config: RunConfig, directory: Path, checkpoint: Path) -> RunConfig:
    """The run from its checkpoint on."""
    from accerl_lerobot.checkpoint.layout import PRETRAINED

    if config.policy.tuning.mode != "lora":
        return improving(config, checkpoint / PRETRAINED)
    # A checkpoint has low-rank adapters merged; apart from what they adapt they are in the training state.
    path, note = config.policy.path, directory / WARM_START
    if path is None and note.is_file():
        path = str(directory / json.loads(note.read_text())["policy"])
    if path is None or not _is_here(path):
        remedy = "the policy that this run began from is gone, and its low-rank adapters are of no other; "
        remedy += f"put it back, or begin a new run with --policy.path={checkpoint / PRETRAINED}"
        raise InputError("policy.path", path, remedy)
    return improving(config, path)


def _is_here(path: str) -> bool:
    """True for a folder of this machine that exists, and for a Hub id."""
    from accerl_lerobot.checkpoint.layout import AWAY

    on_the_hub = not path.startswith((".", "/", "~", f"{AWAY}/")) and path.count("/") <= 1
    return on_the_hub or Path(path).expanduser().is_dir()


def improving(config: RunConfig, path: Path | str) -> RunConfig:
    """The run as one that improves a checkpoint."""
    return replace(config, policy=replace(config.policy, path=str(path)), sft=replace(config.sft, steps=0))


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
    """
    make_folder(directory, field, again=True)
    with (directory / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(field, str(directory), in_use) from error
        yield file.fileno()
