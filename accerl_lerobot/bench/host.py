# SPDX-License-Identifier: Apache-2.0
"""The machine of a measurement: its parts, how busy it was, and the best they can do."""

from __future__ import annotations

import os
import platform
import statistics
import time
from importlib.metadata import version
from typing import Any

import numpy as np
import psutil

PACKAGES = ("accerl-lerobot", "lerobot", "torch", "ray", "numpy")
MEMCPY_BYTES = 64 << 20


def host() -> dict[str, Any]:
    """Cores, versions and load, of now."""
    return {
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in PACKAGES},
        "load_1min": os.getloadavg()[0],
    }


def floors() -> dict[str, float]:
    """Lower bounds of all measurements here: copying memory, waking up, a byte through a pipe and back in
    one thread."""
    source = np.ones(MEMCPY_BYTES, np.uint8)
    target = np.empty_like(source)
    copies = [_seconds(lambda: np.copyto(target, source)) for _ in range(9)][1:]
    sleeps = [_seconds(lambda: time.sleep(0.005)) - 0.005 for _ in range(40)]
    read, write = os.pipe()
    try:
        tokens = [_seconds(lambda: (os.write(write, b"x"), os.read(read, 1))) for _ in range(200)]
    finally:
        os.close(read)
        os.close(write)
    return {
        "memcpy_gb_per_s": MEMCPY_BYTES / statistics.median(copies) / 1e9,
        "sleep_overshoot_us": 1e6 * statistics.median(sleeps),
        "pipe_us": 1e6 * statistics.median(tokens),
    }


class Processors:
    """How busy all cores are, whoever uses them, since the last question."""

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


def _seconds(work: Any) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started
