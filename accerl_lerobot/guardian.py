# SPDX-License-Identifier: Apache-2.0
"""A child process that ends and removes whatever its parent leaves behind, however the parent ended.

Every process that a guarded process starts, directly or through Ray, multiprocessing or another library,
inherits a mark in its environment. When the parent has ended (SIGKILL included), the guardian kills all
processes with this mark and what is below them, and removes registered folders. It runs in a session of its
own, so neither Ctrl-C nor the end of a terminal reaches it. Python's resource trackers are left alone: they
unlink semaphores and end by themselves once the processes that use these are gone. So do Ray's agents, which
wipe their environment, once their raylet is gone.
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
from pathlib import Path

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
    """Start this process's guardian, unless it has one."""
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
    """Have a folder removed when this process has ended, if it is still there."""
    _tell(str(folder.absolute()))


def _tell(folder: str | None) -> None:
    """Hand over a folder to remove; None: this process ends."""
    start()
    assert _process is not None and _process.stdin is not None
    with contextlib.suppress(OSError, ValueError):  # somebody has killed it; nothing here depends on it
        _process.stdin.write(json.dumps(folder).encode() + b"\n")
        _process.stdin.flush()


def _dismiss(owner: int) -> None:
    if os.getpid() != owner or _process is None:
        return
    _tell(None)
    with contextlib.suppress(subprocess.TimeoutExpired):
        _process.wait(END_S + LOOK_S)


def left_behind(identity: str) -> list[psutil.Process]:
    """Living processes with this mark and all below them, but those that end by themselves."""
    left: set[psutil.Process] = set()
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):  # it has ended meanwhile, or is of another user
            if identity in process.environ().get(MARK, "").split():
                left |= {process, *process.children(recursive=True)}
    return [process for process in left if not _ends_by_itself(process)]


def _ends_by_itself(process: psutil.Process) -> bool:
    try:
        if process.status() == psutil.STATUS_ZOMBIE:
            return True
        return any(end in word for end in SELF_ENDING for word in process.cmdline()[:5])
    except psutil.Error:
        return True


def _listen(parent: int) -> list[Path]:
    """Waits until the parent has ended; the folders to remove."""
    folders: list[Path] = []
    text = b""
    while True:
        if not select.select([0], [], [], LOOK_S)[0]:
            if os.getppid() != parent:
                return folders
            continue
        more = os.read(0, 65536)
        if not more:
            return folders
        *lines, text = (text + more).split(b"\n")
        for folder in map(json.loads, lines):
            if folder is None:
                return folders
            folders.append(Path(folder))


def main(identity: str) -> None:
    """Wait for the end of the parent, then end and remove what it has left."""
    folders = _listen(os.getppid())
    deadline = time.monotonic() + END_S
    while time.monotonic() < deadline:
        left = left_behind(identity)
        if not left:
            break
        for process in left:
            with contextlib.suppress(psutil.Error):
                process.kill()
        psutil.wait_procs(left, timeout=0.5)
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main(sys.argv[1])
