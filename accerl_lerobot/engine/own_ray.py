# SPDX-License-Identifier: Apache-2.0
"""A run's own Ray: it stays while workers come and go, and is started again when it has been lost.

Ray itself takes a minute to notice that its GCS is gone, then ends this process from C++; a raylet that has
been stopped blocks every call for ever. So a thread watches Ray's own processes. When one has died, or has
been stopped for too long, it kills the rest, which ends the calls that wait for them. The run then resumes
from its last checkpoint with a new Ray. If the main thread does not get that far, the thread ends this
process.
"""

from __future__ import annotations

import logging
import os
import threading
import time

import psutil
import ray
from ray.exceptions import GetTimeoutError, RayError

from accerl_lerobot import guardian
from accerl_lerobot.engine.cluster import kill_ray, ray_processes, start_ray
from accerl_lerobot.engine.config import LaunchConfig
from accerl_lerobot.engine.ray_environment import NEEDED
from accerl_lerobot.engine.stopping import arrived

logger = logging.getLogger(__name__)

RESPONDS_S = 20.0
"""How long Ray may take to start a process, or it is taken for broken."""
LOOK_S = 0.5
"""Between two looks at Ray's processes."""
HURRY_S = 2.0
"""How long one of them may be stopped while the run has been asked to stop."""
GIVE_UP_S = 30.0
"""How long the main thread may take to end a lost Ray, or this process is ended."""


class OwnRay:
    """Ray, for as long as it is not closed; one that was there before is used and left running, and so is a
    cluster.

    Example:
        >>> own = OwnRay(config.launch)
        >>> own.start()     # for the first workers
        >>> own.start()     # for their successors: looks whether it still does what it is asked to
        >>> own.close()

    Args:
        launch: whether a cluster is to be joined, and how long a process may be stopped.
    """

    def __init__(self, launch: LaunchConfig) -> None:
        self._launch, self._started = launch, False
        self._watch: RayWatch | None = None
        self._lost = ""

    @property
    def lost(self) -> str:
        """Which process of Ray has been lost since it was started, and how; empty: none."""
        return self._lost if self._watch is None else self._watch.look()

    def start(self) -> None:
        """Starts it unless it is there, or if it does not respond any more.

        Raises:
            InputError: there is no such cluster, see `cluster.start_ray`.
            WorkerError: it does not start.
        """
        if ray.is_initialized():
            if not self._started or (not self.lost and _responds()):
                return
            logger.warning("Ray does not respond any more and is started again")
            self.close()
        self._started, self._lost = True, ""
        start_ray(self._launch)
        if self._launch.address is None:
            self._watch = RayWatch(self._launch.stall_s)

    def close(self) -> None:
        """Ends it, if it was started here. Safe to call twice."""
        self._lost = self.lost
        if self._started and ray.is_initialized():
            if self._watch is not None and self._lost:
                kill_ray(self._watch.processes)
            ray.shutdown()
        if self._watch is not None:
            self._watch.close()
            self._watch = None
        self._started = False


class RayWatch(threading.Thread):
    """Watches Ray's own processes below this one until it is closed.

    Args:
        stall_s: how long one of them may be stopped; after SIGTERM or Ctrl-C, `HURRY_S` at most.
    """

    def __init__(self, stall_s: float) -> None:
        super().__init__(name="ray watch", daemon=True)
        self.lost = ""
        """See `OwnRay.lost`."""
        self._stall_s = stall_s
        self.processes: dict[psutil.Process, str] = {}
        """Ray's own processes, and which of them each is."""
        self._stopped: dict[psutil.Process, float] = {}
        """Since when they have been stopped, on `time.monotonic`."""
        self._closed, self._lock = threading.Event(), threading.Lock()
        self.look()
        self.start()

    def run(self) -> None:
        """Looks until something is lost, then sees to it that this process goes on or ends."""
        while not self.look():
            if self._closed.wait(LOOK_S):
                return
        kill_ray(self.processes)
        if self._closed.wait(GIVE_UP_S):
            return
        guardian.explain(cause=self.lost)
        os._exit(1)

    def look(self) -> str:
        """Looks at every process once; what has been lost, or empty."""
        with self._lock:
            if len(self.processes) < len(NEEDED):
                self.processes |= {p: kind for p, kind in ray_processes().items() if kind in NEEDED}
            for process, kind in self.processes.items() if not self.lost else ():
                if how := self._fate(process):
                    self.lost = f"Ray's {kind} (process {process.pid}) {how}"
                    break
            return self.lost

    def close(self) -> None:
        """Ends the watch."""
        self._closed.set()
        self.join()

    def _fate(self, process: psutil.Process) -> str:
        """Fate of a process; empty: nothing happened."""
        try:
            status = process.status()
        except psutil.NoSuchProcess:
            status = psutil.STATUS_ZOMBIE
        if status == psutil.STATUS_ZOMBIE:
            return "has died"
        if status not in (psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP):
            self._stopped.pop(process, None)
            return ""
        stopped_s = time.monotonic() - self._stopped.setdefault(process, time.monotonic())
        limit = min(HURRY_S, self._stall_s) if arrived() else self._stall_s
        return f"has been stopped for {stopped_s:.0f} s" if stopped_s > limit else ""


def _responds() -> bool:
    """True if a process can still be had."""
    try:
        return bool(ray.get(ray.remote(_there).options(num_cpus=0).remote(), timeout=RESPONDS_S))
    except (RayError, GetTimeoutError):
        return False


def _there() -> bool:
    return True
