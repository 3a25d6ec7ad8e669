# SPDX-License-Identifier: Apache-2.0
"""The machine of a measurement, and timing, memory and tables of measurements."""

from __future__ import annotations

import os
import platform
import resource
import statistics
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Any

import psutil
from rich.table import Table

PACKAGES = ("accerl-lerobot", "lerobot", "torch", "ray", "numpy")


def host() -> dict[str, Any]:
    """Cores, versions and load, of now."""
    return {
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in PACKAGES},
        "load_1min": os.getloadavg()[0],
    }


class Processors:
    """Busy share of all cores since the last question, whoever uses them."""

    def __init__(self) -> None:
        self._last = psutil.cpu_times()

    def share(self) -> float:
        """In [0, 1]."""
        now = psutil.cpu_times()
        passed = sum(now) - sum(self._last)
        idle = now.idle - self._last.idle + getattr(now, "iowait", 0.0) - getattr(self._last, "iowait", 0.0)
        self._last = now
        return float(1 - idle / passed) if passed > 0 else 0.0


def spread(values: list[float]) -> dict[str, Any]:
    """Median, range and all of them."""
    return {"median": statistics.median(values), "min": min(values), "max": max(values), "blocks": values}


def ranged(values: dict[str, Any], form: str) -> str:
    """Formats the outcome of `spread`: median and range in this form."""
    return f"{values['median']:{form}} ({values['min']:{form}} to {values['max']:{form}})"


def timed(work: Callable[[], Any], repeats: int, device: Any) -> dict[str, Any]:
    """Seconds that some work takes on a torch device, after a first time that does not count."""
    import torch

    seconds = []
    for _ in range(repeats + 1):
        started = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - started)
    counted = seconds[1:]
    return {"median": statistics.median(counted), "min": min(counted), "max": max(counted), "all": counted}


class Memory:
    """Peak memory of a torch device, in GB, at moments that have a name."""

    def __init__(self, device: Any) -> None:
        self.device = device
        self.notes: dict[str, float] = {}

    def note(self, stage: str) -> None:
        """The peak since the last moment; on a CPU, of the whole process since it began."""
        import torch

        if self.device.type == "cuda":
            self.notes[stage] = torch.cuda.max_memory_allocated() / 1e9
            torch.cuda.reset_peak_memory_stats()
        else:
            self.notes[stage] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def device_name(device: Any) -> str:
    """Name of the GPU, or cpu."""
    import torch

    return torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"


def as_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Rows for people."""
    shown = Table(*columns, title=title)
    for row in rows:
        shown.add_row(*row)
    return shown
