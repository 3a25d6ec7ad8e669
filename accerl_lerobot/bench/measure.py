# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
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
