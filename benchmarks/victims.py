# SPDX-License-Identifier: Apache-2.0
"""A run in a process of its own, to be done harm to and watched: its workers, its updates, its books.

Everything is seen from outside: workers are found among the run's descendants by the names that Ray gives
them, updates in ``metrics.jsonl``. So nothing in the run knows that it is being tried.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from accerl_lerobot.checkpoint.layout import CONFIG
from accerl_lerobot.metrics import METRICS
from benchmarks.fault_injection import environment
from benchmarks.tables import last_words

CLASSES = {
    "rollout": "RolloutWorker",
    "inference": "InferenceWorker",
    "replay": "ReplayWorker",
    "trainer": "TrainerWorker",
    "trainer rank": "TrainerRank",
    "world-model learning": "OnlineLearningWorker",
}
"""Target → how Ray calls its processes."""
DRIVER, EVERYTHING = "driver", "everything"
"""The run's own process; it and all below it."""
TRAIN = ("accerl_lerobot.cli", "train")
LIGHT = ("benchmarks.light_run",)
"""Modules that run, and their first arguments."""
LOOK_S = 0.05
GONE = (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)


class Victim:
    """One run."""

    def __init__(
        self,
        folder: Path,
        arguments: list[str],
        log: Path,
        module: tuple[str, ...] = TRAIN,
        orders: Path | None = None,
    ) -> None:
        self.folder = folder
        self.log = log
        self._module = module
        self._environment = dict(os.environ) if orders is None else os.environ | environment(orders)
        self._start([*arguments, f"--output_dir={folder}"])

    def go_on(self, *changes: str) -> None:
        """Starts it again, after its process has ended, with these changes of its command line."""
        self._start(["--resume=true", f"--config_path={self.folder / CONFIG}", *changes])

    def _start(self, arguments: list[str]) -> None:
        command = [sys.executable, "-m", *self._module, *arguments]
        with self.log.open("ab") as out:
            # Of a session of its own: what it leaves behind is found by that.
            self.process = subprocess.Popen(
                command, stdout=out, stderr=out, env=self._environment, start_new_session=True
            )

    def pids(self, target: str) -> list[int]:
        """Processes of a target, as they are now."""
        if target in (DRIVER, EVERYTHING):
            return [self.process.pid] if self.process.poll() is None else []
        name = f"ray::{CLASSES[target]}"
        found = [pid for pid in descendants(self.process.pid) if title(pid).startswith(name)]
        # What a worker forks has its name, too, until it becomes something else.
        forked = {child for pid in found for child in descendants(pid)}
        return [pid for pid in found if pid not in forked]

    def records(self) -> list[dict[str, Any]]:
        """Records that it has logged; a last line that is being written is left out."""
        path = self.folder / METRICS
        lines = path.read_text().splitlines(keepends=True) if path.is_file() else []
        return [json.loads(line) for line in lines if line.endswith("\n")]

    def updates(self) -> list[int]:
        """Numbers of the updates that it has logged, in order."""
        return [int(record["update"]) for record in self.records() if record["kind"] == "train"]

    def decisions(self) -> list[float]:
        """How many had been made, each time that it has logged that; 0 at first."""
        return [0.0, *(record["decisions"] for record in self.records() if record["kind"] == "rollout")]

    def await_update(self, number: int, timeout: float, every: float = LOOK_S) -> None:
        """Waits until it has logged this update; looks `every` so many seconds."""
        self.wait(lambda: self.updates()[-1:] >= [number], timeout, f"update {number} was not reached", every)

    def await_successors(self, target: str, gone: int, count: int, timeout: float) -> None:
        """Waits until a target has as many processes as before, none of them `gone`."""

        def there() -> bool:
            pids = self.pids(target)
            return len(pids) >= count and gone not in pids

        self.wait(there, timeout, f"no successor of {target} {gone}")

    def end(self, grace: float) -> tuple[int, list[int]]:
        """Asks it to stop; its exit code, and the processes that were below it."""
        below = descendants(self.process.pid)
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(grace), below

    def kill(self) -> list[int]:
        """Ends it and all below it, whatever they do; who they were."""
        everyone = [self.process.pid, *descendants(self.process.pid)]
        for pid in everyone:
            hit(pid, signal.SIGKILL)
        self.process.wait()
        return everyone

    def wait(self, there: Callable[[], bool], timeout: float, otherwise: str, every: float = LOOK_S) -> None:
        """Looks again and again, until what is waited for is there."""
        deadline = time.monotonic() + timeout
        while not there():
            code = self.process.poll()
            if code is None and time.monotonic() <= deadline:
                time.sleep(every)
                continue
            ended = f"it ended with code {code}" if code is not None else f"in {timeout:.0f} s"
            raise RuntimeError(f"{otherwise}: {ended}; {self.log}:\n{last_words(self.log)}")


def hit(pid: int, number: int) -> bool:
    """Sends a signal; False if there is no such process any more."""
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return False
    return True


def alive(pid: int) -> bool:
    """True if there is such a process, which is no zombie."""
    return _status(pid) not in GONE


def await_hit(pid: int, number: int, timeout: float = 10.0) -> bool:
    """True if a signal that was sent has done what it should: the process has stopped, or is gone."""
    expected = (psutil.STATUS_STOPPED,) if number == signal.SIGSTOP else GONE
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        if _status(pid) in expected:
            return True
        time.sleep(0.005)
    return False


def descendants(pid: int) -> list[int]:
    """All processes below one that are no zombies."""
    try:
        below = psutil.Process(pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []
    return sorted(process.pid for process in below if alive(process.pid))


def title(pid: int) -> str:
    """How a process is called; empty if there is none."""
    try:
        return " ".join(psutil.Process(pid).cmdline())
    except psutil.Error:
        return ""


def _status(pid: int) -> str:
    try:
        return psutil.Process(pid).status()
    except psutil.NoSuchProcess:
        return psutil.STATUS_DEAD
