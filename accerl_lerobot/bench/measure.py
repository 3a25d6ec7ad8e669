# SPDX-License-Identifier: Apache-2.0
"""Timing and memory, as measurements of models need them."""

from __future__ import annotations

import resource
import statistics
import time
from collections.abc import Callable
from typing import Any


def timed(work: Callable[[], Any], repeats: int, device: Any) -> dict[str, Any]:
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
    """Peak memory of the device, in GB, at moments that have a name."""

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
    import torch

    return torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"
