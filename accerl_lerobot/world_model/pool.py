# SPDX-License-Identifier: Apache-2.0
"""Several processes that dream beside each other: what each does, and what they say together.

Each has its part of the dreams, its own draws, and all real segments to begin at; each watches its own dreams
succeed, and stops by itself where they do so too often. All take over the same world models.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from accerl_lerobot.errors import InputError
from accerl_lerobot.inference.pool import dealt
from accerl_lerobot.world_model.imagination_config import ImaginationConfig

DREAMS = "dreams"
"""Name of the first one's state; the others' have a number behind it."""
COUNTS = ("dreams", "decisions", "successes", "doubted")


def part(config: ImaginationConfig, index: int) -> ImaginationConfig:
    """Part of one of several dreaming workers."""
    return replace(config, workers=1, dreams=dealt(config.dreams, config.workers)[index])


def together(metrics: Sequence[dict[str, float]]) -> dict[str, float]:
    """Reports of those who dream, as one: sums of counts, the oldest version, if any dreams, and means
    of the shares that are compared; nothing of none, and nothing before all have said something."""
    if len(metrics) < 2 or not all(metrics):
        return dict(metrics[0]) if len(metrics) == 1 else {}
    found = {name: sum(m[name] for m in metrics) for name in metrics[0]}
    found |= {name: total / len(metrics) for name, total in found.items() if name not in COUNTS}
    return found | {"version": min(m["version"] for m in metrics), "on": max(m["on"] for m in metrics)}


def check_workers(state: Path, workers: int) -> None:
    """Refuses to go on with more or fewer of them than a run had.

    Args:
        state: the ``training_state``.
        workers: as they are now.

    Raises:
        InputError: says how many it had.
    """
    had = 1
    while (state / f"{DREAMS}{had}.json").is_file():
        had += 1
    if had != workers:
        raise InputError("imagination.workers", workers, f"this run has {had}; leave the field out")
