# SPDX-License-Identifier: Apache-2.0
"""Cost of recording the timeline.

    python -m benchmarks timeline --run=RUN

Three arms, in turns, forth and back (A B C C B A): ``on`` enters states of a clock that writes to disk,
``off`` of one that records nothing, and ``floor`` only asks for the time, which no recorder can do without.
With a run, the cost of an entry times the entries a second of each of its workers is the share of its time
that recording takes.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rich.table import Table

from accerl_lerobot.config.ranges import Range, Repeats, Section
from accerl_lerobot.errors import InputError
from accerl_lerobot.timeline import COMPUTE, WAIT_IN, Clock, NoClock
from benchmarks.measure import host, spread

ON, OFF, FLOOR = "on", "off", "floor"


@dataclass(frozen=True, kw_only=True)
class BenchTimelineConfig(Section):
    """Fields of ``python -m benchmarks timeline``."""

    entries: Annotated[int, Range("[2, 100000000]")] = 100_000
    """Entries of one block, 2 or more."""
    repeats: Repeats = 5
    """Times each arm is measured twice."""
    folder: str | None = None
    """Where the clock that is on writes, in a folder of its own that is removed; None: the system's for
    temporary files."""
    run: str | None = None
    """A run whose workers' entries are counted; None: the cost of an entry is all that is said."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.folder is not None and not Path(self.folder).expanduser().is_dir():
            raise InputError("folder", self.folder, "no such folder; make it first")


def bench_timeline(config: BenchTimelineConfig) -> dict[str, Any]:
    """Measures all three arms.

    Returns:
        ``arms[name]``: nanoseconds per entry, median, min, max and blocks. ``times_floor``: of ``on``, median
        of the pairs and their range. ``workers``, with a run: by name, ``entries_per_s`` and ``share``, what
        recording takes of the worker's time. ``config``; ``host`` and
        ``host_after``.
    """
    workers = {} if config.run is None else entries_per_s(Path(config.run).expanduser())
    before = host()
    blocks: dict[str, list[float]] = {ON: [], OFF: [], FLOOR: []}
    with tempfile.TemporaryDirectory(dir=config.folder) as folder:
        clock, none = Clock(Path(folder), "bench"), NoClock()
        for name in (*blocks, *config.repeats * (*blocks, *reversed(blocks))):
            if name == FLOOR:
                seconds = _ask(config.entries)
            else:
                seconds = _enter(clock if name == ON else none, config.entries)
            blocks[name].append(1e9 * seconds / config.entries)
        clock.close()
    blocks = {name: values[1:] for name, values in blocks.items()}  # the first round warmed everything
    arms = {name: spread(values) for name, values in blocks.items()}
    cost = arms[ON]["median"] / 1e9
    return {
        "config": asdict(config),
        "arms": arms,
        "times_floor": spread([on / floor for on, floor in zip(blocks[ON], blocks[FLOOR], strict=True)]),
        "workers": {name: {"entries_per_s": rate, "share": rate * cost} for name, rate in workers.items()},
        "host": before,
        "host_after": host(),
    }


def entries_per_s(run: Path) -> dict[str, float]:
    """Changes of state a second of each worker, since the last start of the training.

    Raises:
        InputError: the run has no timeline.
    """
    from accerl_lerobot.timeline.read import read_timeline

    timeline = read_timeline(run)
    first, last = timeline.training()[-1]
    found = {}
    for row in timeline.rows:
        first_kept = max(1e9 * first, row.kept_from)
        count = int(np.sum((row.times >= first_kept) & (row.times < 1e9 * last)))
        found[row.worker] = count / max(1e-9, last - first_kept / 1e9)
    return found


def table(result: dict[str, Any]) -> Table:
    """`result` for people."""
    times = result["times_floor"]
    shown = Table(
        title=f"an entry is {times['median']:.1f} times asking for the time "
        f"({times['min']:.1f} to {times['max']:.1f})"
    )
    for heading in ("arm or worker", "ns per entry", "range", "entries/s", "share of its time"):
        shown.add_column(heading, justify="left" if heading == "arm or worker" else "right")
    for name, arm in result["arms"].items():
        shown.add_row(name, f"{arm['median']:,.0f}", f"{arm['min']:,.0f} to {arm['max']:,.0f}", "", "")
    for name, worker in result["workers"].items():
        shown.add_row(name, "", "", f"{worker['entries_per_s']:,.0f}", f"{100 * worker['share']:.3f} %")
    return shown


def _enter(clock: Clock, entries: int) -> float:
    started = time.perf_counter()
    for _ in range(entries // 2):
        clock.enter(COMPUTE)
        clock.enter(WAIT_IN)
    return time.perf_counter() - started


def _ask(entries: int) -> float:
    now = time.monotonic_ns
    started = time.perf_counter()
    for _ in range(entries // 2):
        now()
        now()
    return time.perf_counter() - started
