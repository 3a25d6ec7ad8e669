# SPDX-License-Identifier: Apache-2.0
"""Memory, disk space and arithmetic of this machine."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import psutil

from accerl_lerobot.errors import InputError, expanded

if TYPE_CHECKING:
    import torch

GIB = 2**30
SIMULATOR_GIB = {"metaworld": 0.17, "libero": 0.17}
"""Memory of the simulator of one task with its renderers, by type of environment."""
DISK_BYTES = 2**29  # disk space that demonstrations, checkpoints and videos take at least


def free_memory_gib() -> float:
    """Free memory of this machine within its container's limit."""
    free = int(psutil.virtual_memory().available)
    group = Path("/sys/fs/cgroup")
    with contextlib.suppress(OSError, ValueError):  # no such file, or no limit
        limit = int((group / "memory.max").read_text())
        used = int((group / "memory.current").read_text())
        free = min(free, limit - used)
    return free / GIB


def check_disk(folder: str | None, field: str = "output_dir") -> None:
    """Refuse a folder on a disk with less free space than any run takes; blames `field`."""
    path = expanded(folder or ".", field).absolute()
    while not path.exists():
        path = path.parent
    free = shutil.disk_usage(path).free
    if free < DISK_BYTES:
        hint = f"{free / GIB:.2f} GiB are free on this disk; make room or choose another"
        raise InputError(field, folder, hint)


def computes_bf16(device: torch.device) -> bool:
    """True if this device multiplies bf16 numbers itself, which is faster than float32 there."""
    import torch

    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return device.type == "cpu" and torch.cpu._is_avx512_bf16_supported()
