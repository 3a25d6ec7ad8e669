# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks weights``: from an optimiser step to the weights that act, against copying memory.

    python -m benchmarks weights --output_dir=outputs/weights

    stall     how long `publish` keeps the trainer; at best, one copy
    applied   from the call of `publish` until the slowest reader has the weights in its parameters; at best,
              two copies, one in and one out of what both share
    pause     how long a reader does nothing else; at best, one copy

The copy is measured beside each publication. Arms go forth and back (A B C D D C B A), all with the same
reader processes; of each block the last publication counts, when all memory has been touched.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import monotonic, perf_counter
from typing import Annotated, Any

import numpy as np
from rich.table import Table

from accerl_lerobot.config.ranges import Range, Repeats, Section, Seed
from accerl_lerobot.console import Console
from accerl_lerobot.engine import ray_session
from accerl_lerobot.errors import check_absent, make_folder
from accerl_lerobot.transport.endpoint import Endpoint
from accerl_lerobot.transport.weights import Tensors, WeightPublisher
from benchmarks.records import as_markdown, write
from benchmarks.study import named
from benchmarks.tables import as_table, host, ranged, spread

ARMS = ("shared memory", "Ray")
MB = 1 << 20
WARM = 4
"""Publications of a block that do not count: until all slabs have been written to and mapped."""


@dataclass(frozen=True, kw_only=True)
class BenchWeightsConfig(Section):
    """Fields of ``python -m benchmarks weights``."""

    sizes_mb: tuple[Annotated[int, Range("[1, 1048576]")], ...] = (1, 16, 256, 1024)
    """Sizes of a set of float32 weights, in MiB. With two readers the largest needs about 15 times
    its size in memory."""
    readers: tuple[Annotated[int, Range("[1, 1000]")], ...] = (1, 2)
    """How many processes read; each at least 1."""
    tensors: Annotated[int, Range("[1, 1000000]")] = 64
    """Into how many equal tensors a set falls."""
    repeats: Repeats = 5
    """Publications of each arm that count, each in a block of its own."""
    seed: Seed = 0
    """Seed of the values."""
    output_dir: str | None = None
    """Folder for weights.json and weights.md; must not exist. None: nothing is written."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("sizes_mb", "readers"):
            named(self, name)


def bench_weights(config: BenchWeightsConfig) -> dict[str, Any]:
    """Measures every arm at every size with every number of readers.

    Returns:
        ``cells``: ``size_mb``, ``readers``, ``arm``; ``stall_ms``, ``applied_ms``, ``pause_ms`` and
        ``memcpy_ms``; ``mb`` that each reader read; and ``stall``, ``applied`` and ``pause`` as shares of
        what memcpy allows, 1 the best: each median, min, max and all; ``config``; ``host`` before and after.
    """
    root = None if config.output_dir is None else Path(config.output_dir).expanduser()
    if root is not None:
        check_absent(root)
    ray_session.prepare()
    before, console, cells = host(), Console(), []
    for size in config.sizes_mb:
        for readers in config.readers:
            with console.stage(f"{size} MB, {readers} readers"):
                cells += _measure(config, size, readers)
    result = {"config": asdict(config), "cells": cells, "host": [before, host()]}
    if root is not None:
        make_folder(root, "output_dir")
        write(root, "weights", result, as_markdown(_COLUMNS, _rows(result)))
    return result


def table(result: dict[str, Any]) -> Table:
    """`result` for people."""
    return as_table("milliseconds, and share of what memcpy allows", _COLUMNS, _rows(result))


def _measure(config: BenchWeightsConfig, size_mb: int, readers: int) -> list[dict[str, Any]]:
    """One row per arm."""
    from benchmarks.weights_readers import reading

    rng = np.random.default_rng(config.seed)
    elements = max(1, size_mb * MB // 4 // config.tensors)
    tensors = {f"t{i}": rng.random(elements, np.float32) for i in range(config.tensors)}
    copy = {name: np.zeros_like(tensor) for name, tensor in tensors.items()}
    blocks: dict[str, list[dict[str, float]]] = {arm: [] for arm in ARMS}
    with reading(readers, config.tensors, elements) as endpoints:
        for repeat in range(config.repeats):
            for arm in ARMS[:: -1 if repeat % 2 else 1]:
                blocks[arm].append(_block(arm, endpoints, tensors, copy))
    return [_cell(size_mb, readers, arm, notes) for arm, notes in blocks.items()]


def _block(arm: str, endpoints: list[Endpoint], tensors: Tensors, copy: Tensors) -> dict[str, float]:
    """Publishes a few times, each after an update, and notes the last."""
    from benchmarks.weights_readers import ask

    near = arm != "Ray"
    publisher = WeightPublisher([e if near else replace(e, address=None) for e in endpoints])
    handles = [endpoint.actor for endpoint in endpoints]
    try:
        for version in range(WARM + 1):
            _update(tensors, 0.0)
            started = perf_counter()
            for name, tensor in tensors.items():
                np.copyto(copy[name], tensor)
            memcpy = perf_counter() - started
            _update(tensors, 1.0)
            published = monotonic()
            publisher.publish(version, tensors)
            stall = monotonic() - published
            publisher.flush()
    finally:
        publisher.close()
    notes = [ask(handle, "note", WARM) for handle in handles]
    expected = np.stack([tensor[:: max(1, len(tensor) // 100)] for tensor in tensors.values()])
    for handle in handles:
        if not np.array_equal(ask(handle, "some"), expected):
            raise RuntimeError(f"{arm}: a reader has other weights than were published")
    worst = {key: max(note[key] for note in notes) for key in ("applied_at", "pause_s", "bytes")}
    applied = worst.pop("applied_at") - published
    return {"stall_s": stall, "applied_s": applied, "memcpy_s": memcpy, **worst}


def _update(tensors: Tensors, step: float) -> None:
    """Writes all values, as an optimiser does, so that caches are as after one."""
    for tensor in tensors.values():
        tensor += np.float32(step)


def _cell(size_mb: int, readers: int, arm: str, notes: list[dict[str, float]]) -> dict[str, Any]:
    copies = {"stall": 1, "applied": 2, "pause": 1}
    times = {f"{key}_ms": spread([1000 * n[f"{key}_s"] for n in notes]) for key in (*copies, "memcpy")}
    shares = {
        key: spread([count * n["memcpy_s"] / n[f"{key}_s"] for n in notes]) for key, count in copies.items()
    }
    mb = spread([n["bytes"] / MB for n in notes])
    return {"size_mb": size_mb, "readers": readers, "arm": arm, "mb": mb, **times, **shares}


_COLUMNS = [
    "MiB",
    "readers",
    "arm",
    "read, MiB",
    "memcpy",
    "stall",
    "of it",
    "applied",
    "of it",
    "pause",
    "of it",
]


def _rows(result: dict[str, Any]) -> list[list[str]]:
    rows = []
    for cell in result["cells"]:
        row = [str(cell["size_mb"]), str(cell["readers"]), cell["arm"], f"{cell['mb']['median']:.3g}"]
        row.append(ranged(cell["memcpy_ms"], ".3g"))
        for kind in ("stall", "applied", "pause"):
            row += [ranged(cell[f"{kind}_ms"], ".3g"), f"{cell[kind]['median']:.0%}"]
        rows.append(row)
    return rows
