# SPDX-License-Identifier: Apache-2.0
"""Injects faults at the points of `accerl_lerobot.fault_points`, to see what becomes of the run.

    run = start(environment=os.environ | environment(FOLDER))    # nothing happens yet
    inject(FOLDER, "7", "trainer.backward", "exception", at=3)   # the third time from now that it is reached

An order is a file. The process that reaches the point takes it by renaming it, which only one process can do,
so a fault happens once in a run however often processes are restarted. The renamed file says which process
took it and when.
"""

from __future__ import annotations

import errno
import json
import os
import signal
import time
from pathlib import Path
from typing import Any

from accerl_lerobot.errors import InputError
from accerl_lerobot.fault_points import HANDLER

VARIABLE = "ACCERL_FAULTS"
"""Environment variable that names the folder of orders."""
ROOT = Path(__file__).parents[1]
CRASHES = ("exception", "exit", "kill", "stop", "hang")
"""exception: one is raised. exit: the process ends with code 0. kill: by SIGKILL. stop: SIGSTOP, so that the
process hangs. hang: one thread does, and the others of the process answer as if nothing were wrong."""
SAVING = ("exception", "exit", "kill", "stop")
"""Faults among these for a worker that saves: how long a thread needs for that, nobody knows."""
UNWATCHED = ("exception", "exit", "kill")
"""Faults of the run's own process, which nobody watches."""
NAN, FULL, TORN = "nan", "full", "torn"
"""nan: what is computed there is not finite. full: the disk is. torn: a file that was just written loses its
end, and the process is killed, as by a loss of power."""
POINTS: dict[str, tuple[str, ...]] = {
    "rollout.step": CRASHES,
    "rollout.decided": CRASHES,
    "rollout.send": (*CRASHES, NAN),
    "inference.batch": (*CRASHES, NAN),
    "inference.swapped": CRASHES,
    "replay.insert": CRASHES,
    "replay.journal": (FULL,),
    "replay.sample": CRASHES,
    "replay.save": (*SAVING, FULL),
    "trainer.update": CRASHES,
    "trainer.loss": (NAN,),
    "trainer.backward": CRASHES,
    "trainer.publish": CRASHES,
    "trainer.write": (*SAVING, FULL),
    "rank.step": CRASHES,
    "learning.step": CRASHES,
    "driver.metrics": (*UNWATCHED, FULL),
    "driver.save": (*UNWATCHED, FULL),
    "driver.files": UNWATCHED,
    "driver.renamed": (*UNWATCHED, TORN),
} | {f"{role}.timeline": (FULL,) for role in ("rollout", "inference", "replay", "trainer", "driver")}
"""Point → what can be made to happen there. What stands before the dot is whose it is; ``trainer.loss`` and
``trainer.backward`` are reached by all of its ranks."""
_ARMED, _TAKEN = ".armed", ".taken"


class FaultError(RuntimeError):
    """Made to happen at a point."""


def environment(folder: Path) -> dict[str, str]:
    """Variables with which a process and its children look for orders in a folder."""
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    return {VARIABLE: str(folder), HANDLER: __name__, "PYTHONPATH": path}


def inject(folder: Path, name: str, point: str, fault: str, *, at: int = 1, times: int = 1) -> Path:
    """Order a fault at a point.

    Args:
        folder: that `VARIABLE` names; made if it is not there.
        name: of the order, unique in the folder.
        point: one of `POINTS`.
        fault: one of those that can happen there.
        at: how often the process comes by until it does, from now on or from its own beginning, at least 1.
        times: with ``nan``, in how many visits one after the other it does, at least 1.

    Returns:
        The file that will be there once it has happened; see `proof`.

    Raises:
        InputError: there is no such point, or nothing of the kind can happen there.
    """
    if point not in POINTS:
        raise InputError("point", point, f"use one of {', '.join(POINTS)}")
    if fault not in POINTS[point]:
        raise InputError("fault", fault, f"at {point}, use one of {', '.join(POINTS[point])}")
    if at < 1 or times < 1:
        raise InputError("at", (at, times), "use at least 1, and as many times")
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"name": name, "point": point, "fault": fault, "at": at, "times": times})
    new = folder / f".{name}.new"
    new.write_text(text)
    new.rename(folder / f"{point}{_ARMED}")
    return folder / f"{name}{_TAKEN}"


def withdraw(folder: Path, point: str) -> bool:
    """Takes an order back; False if there is none, because it was taken."""
    try:
        (folder / f"{point}{_ARMED}").unlink()
    except FileNotFoundError:
        return False
    return True


def proof(taken: Path) -> dict[str, Any] | None:
    """The order that `inject` was given, and the ``pid`` and ``monotonic`` moment of who took it; None:
    nobody has."""
    try:
        said = json.loads(taken.read_text())
    except (FileNotFoundError, ValueError):  # not taken, or being written
        return None
    return said if "pid" in said else None


def handle(point: str, path: Path | None = None) -> bool:
    """Take the order for this point, if there is one and its visit has come; see `fault_point`."""
    return _orders is not None and _orders.take(point, path)


class _Orders:
    """Orders that this process looks for."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._visits: dict[str, int] = {}
        """By name of an order, how often its point was reached."""
        self._left: dict[str, int] = {}
        """By point, how many of its next visits are not finite either."""

    def take(self, point: str, path: Path | None) -> bool:
        if self._left.get(point):
            self._left[point] -= 1
            return True
        armed = self._folder / f"{point}{_ARMED}"
        try:
            said = json.loads(armed.read_text())
        except FileNotFoundError:
            return False
        name, fault = said["name"], said["fault"]
        self._visits[name] = self._visits.get(name, 0) + 1
        if self._visits[name] < said["at"]:
            return False
        taken = self._folder / f"{name}{_TAKEN}"
        try:
            armed.rename(taken)
        except FileNotFoundError:  # another process was first
            return False
        new = self._folder / f".{name}.new"
        new.write_text(json.dumps(said | {"pid": os.getpid(), "monotonic": time.monotonic()}))
        new.rename(taken)
        self._left[point] = said["times"] - 1
        return _happen(point, fault, path)


def _happen(point: str, fault: str, path: Path | None) -> bool:
    if fault == "exception":
        raise FaultError(f"made to happen at {point}")
    if fault == FULL:
        raise OSError(errno.ENOSPC, f"{os.strerror(errno.ENOSPC)} (made to happen at {point})")
    if fault == "exit":
        os._exit(0)
    if fault == TORN:
        assert path is not None
        _tear(path)
    if fault in ("kill", TORN):
        os.kill(os.getpid(), signal.SIGKILL)
    if fault == "stop":
        os.kill(os.getpid(), signal.SIGSTOP)
    while fault == "hang":
        time.sleep(3600.0)
    return fault == NAN


def _tear(path: Path) -> None:
    """Cuts the largest file off in its middle."""
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
    largest = max(files, key=lambda file: file.stat().st_size)
    os.truncate(largest, largest.stat().st_size // 2)


_folder = os.environ.get(VARIABLE)
_orders = None if not _folder else _Orders(Path(_folder))
