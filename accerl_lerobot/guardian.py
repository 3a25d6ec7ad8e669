# SPDX-License-Identifier: Apache-2.0
"""A child process that ends and removes whatever its parent leaves behind, however the parent ended.

Every process that a guarded process starts, directly or through Ray, multiprocessing or another library,
inherits a mark in its environment. When the parent has ended (SIGKILL included), the guardian kills all
processes with this mark, or with open files in a registered folder, and removes these folders. It runs in a
session of its own, so neither Ctrl-C nor the end of a terminal reaches it. Python's resource trackers are
left alone: they unlink semaphores and end by themselves once the processes that use these are gone.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import secrets
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import psutil

MARK = "ACCERL_GUARDED_BY"
"""Environment variable of guarded processes: the identities of their guardians, outermost first."""
LOOK_S = 1.0
"""Seconds between two looks at whether the parent is still there, where a fork of it keeps the pipe open."""
END_S = 10.0  # longest time for ending all processes
SELF_ENDING = ("multiprocessing.resource_tracker", "accerl_lerobot/guardian.py")
"""Words of the command lines of processes that clean up and then end by themselves."""

_process: subprocess.Popen[bytes] | None = None
_owner = 0


def start() -> None:
    """Starts this process's guardian, unless it has one."""
    global _process, _owner
    if _owner == os.getpid():
        return
    identity = f"{os.getpid()}-{secrets.token_hex(8)}"
    # -P: the modules beside this file must not hide those of the standard library.
    command = [sys.executable, "-P", __file__, identity]
    # It inherits that these are blocked: a scheduler sends them to all processes of a job.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGTERM, signal.SIGINT, signal.SIGHUP))
    try:
        _process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, start_new_session=True
        )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    _owner = os.getpid()
    os.environ[MARK] = " ".join([*os.environ.get(MARK, "").split(), identity])
    atexit.register(_dismiss, _owner)


def remove(folder: Path) -> None:
    """Has a folder removed when this process has ended, if it is still there."""
    _tell(folder=str(folder.absolute()))


def explain(cause: str = "", hint: str = "") -> None:
    """Sets the line that is printed if this process ends abruptly; empty: as it was. Without a hint there
    is none, and without a cause it was killed.
    """
    _tell(**{key: text for key, text in (("cause", cause), ("hint", hint)) if text})


def _tell(**message: Any) -> None:
    start()
    assert _process is not None and _process.stdin is not None
    with contextlib.suppress(OSError, ValueError):  # somebody has killed it; nothing here depends on it
        _process.stdin.write(json.dumps(message).encode() + b"\n")
        _process.stdin.flush()


def _dismiss(owner: int) -> None:
    if os.getpid() != owner or _process is None:
        return
    _tell(bye=True)
    with contextlib.suppress(subprocess.TimeoutExpired):
        _process.wait(END_S + LOOK_S)


def left_behind(identity: str, folders: Sequence[str]) -> list[psutil.Process]:
    """Living processes with this mark, or of those folders, but those that end by themselves."""

    def is_ours(process: psutil.Process) -> bool:
        if variables := process.environ():
            return identity in variables.get(MARK, "").split()
        # Ray's agents wipe their environment when they change their title; they keep their logs open.
        return any(file.path.startswith(f"{folder}/") for file in process.open_files() for folder in folders)

    left = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):  # it has ended meanwhile, or is of another user
            ends = any(end in word for end in SELF_ENDING for word in process.cmdline()[:5])
            if is_ours(process) and process.status() != psutil.STATUS_ZOMBIE and not ends:
                left.append(process)
    return left


def _listen(parent: int) -> dict[str, Any]:
    told: dict[str, Any] = {"folders": [], "cause": "", "hint": "", "bye": False}
    text = b""
    while not told["bye"]:
        if not select.select([0], [], [], LOOK_S)[0]:
            if os.getppid() != parent:
                break
            continue
        if not (more := os.read(0, 65536)):
            break
        *lines, text = (text + more).split(b"\n")
        for message in map(json.loads, lines):
            told["folders"] += [folder] if (folder := message.pop("folder", None)) else []
            told |= message
    return told


def main(identity: str) -> None:
    """Waits for the end of the parent, then ends and removes what it has left."""
    told = _listen(os.getppid())
    if told["hint"] and not told["bye"]:
        cause = told["cause"] or "the process was killed"
        sys.stderr.write(f"accerl: {cause}; {told['hint']}\n")
        sys.stderr.flush()
    deadline = time.monotonic() + END_S
    while time.monotonic() < deadline and (left := left_behind(identity, told["folders"])):
        for process in left:
            with contextlib.suppress(psutil.Error):
                process.kill()
        psutil.wait_procs(left, timeout=0.5)
    for folder in told["folders"]:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main(sys.argv[1])
