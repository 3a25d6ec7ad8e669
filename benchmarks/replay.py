# SPDX-License-Identifier: Apache-2.0
"""Cost of the replay: storing, drawing, the journal and a checkpoint, in one process and without waiting.

Per decision, as that is what everything else is counted in. With and without the journal by turns; the share
of a run that the journal and checkpoints take follows from the decisions a second that it makes.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rich.table import Table

from accerl_lerobot.bench import as_table, host, ranged, spread
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import save_checkpoint
from accerl_lerobot.config.ranges import Range, Repeats, Section
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Origin, Segment
from accerl_lerobot.replay.buffer import MixedReplay
from accerl_lerobot.replay.journal import EPISODES, Journal
from accerl_lerobot.replay.pacing import ReplayConfig
from benchmarks.records import floors

CAMERA = "observation.images.front"
PLAIN, JOURNALLED, DRAWN = "insert", "insert with journal", "draw a batch"
SAVED = "checkpoint"


@dataclass(frozen=True, kw_only=True)
class BenchReplayConfig(Section):
    """Sizes."""

    image_size: Annotated[int, Range("[1, 4096]")] = 64
    """Height and width of an observation's one image; 317 makes it 301 KB."""
    segment_length: Annotated[int, Range("[1, 10000]")] = 16
    """Decisions of a segment."""
    chunk: Annotated[int, Range("[1, 100000]")] = 10
    """Actions of a decision."""
    capacity: Annotated[int, Range("[1, 10000000]")] = 2048
    """Decisions that the replay holds, as many as a batch at least."""
    batch: Annotated[int, Range("[1, 1000000]")] = 256
    """Decisions of a batch, as many as a segment at least."""
    repeats: Repeats = 5
    """Times that everything is measured."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.batch < self.segment_length:
            raise InputError("batch", self.batch, f"use at least segment_length, {self.segment_length}")
        if self.capacity < self.batch + self.segment_length:
            remedy = f"use at least batch and segment_length, {self.batch + self.segment_length}"
            raise InputError("capacity", self.capacity, remedy)


def bench_replay(config: BenchReplayConfig) -> dict[str, Any]:
    """Measures all of it.

    Returns:
        ``us``: microseconds a decision of each thing that is done; ``bytes``: of a decision in the replay;
        ``checkpoint_mb``; ``config``, ``host`` and ``floors``.
    """
    found: dict[str, list[float]] = {name: [] for name in (PLAIN, JOURNALLED, DRAWN, SAVED)}
    segments = _segments(config)
    size = 0
    with tempfile.TemporaryDirectory() as scratch:
        for turn in range(config.repeats):
            folder = Path(scratch) / str(turn)
            folder.mkdir()
            arms = [(PLAIN, None), (JOURNALLED, Journal(folder / EPISODES))]
            for name, journal in arms if turn % 2 else reversed(arms):
                replay = _replay(config, journal)
                found[name].append(_filled(replay, segments, config))
            found[DRAWN].append(_drawn(replay, config))
            seconds, size = _saved(replay, folder)
            found[SAVED].append(1e6 * seconds / config.capacity)
    return {
        "config": asdict(config),
        "us": {name: spread(values) for name, values in found.items()},
        "bytes": _bytes(next(segments)) / config.segment_length,
        "checkpoint_mb": size / 1e6,
        "host": host(),
        "floors": floors(),
    }


def table(result: dict[str, Any]) -> Table:
    """`result` for people."""
    rows = [[name, ranged(us, ".1f")] for name, us in result["us"].items()]
    title = f"a decision of {result['bytes'] / 1000:.0f} kB; a checkpoint of {result['checkpoint_mb']:.0f} MB"
    return as_table(title, ("", "µs a decision"), rows)


def _segments(config: BenchReplayConfig) -> Iterator[Segment]:
    """Ever new ones; pictures of noise, which nothing compresses."""
    rng, t = np.random.default_rng(0), config.segment_length
    side = config.image_size
    images = rng.integers(0, 256, (t + 1, side, side, 3), dtype=np.uint8)
    for number in itertools.count():
        chunks = rng.standard_normal((t, config.chunk, 4)).astype(np.float32)
        yield Segment(
            observations={CAMERA: images.copy(), "observation.state": np.zeros((t + 1, 4), np.float32)},
            task="push",
            latent={"x": chunks},
            log_prob=np.zeros((t, config.chunk), np.float32),
            reward=np.zeros(t, np.float32),
            version=np.zeros(t, np.int64),
            actions=chunks,
            steps=np.full(t, config.chunk, np.int64),
            terminated=False,
            success=False,
            key=f"bench.{number}",
            origin=Origin("push", seed=number, decision=0),
        )


def _replay(config: BenchReplayConfig, journal: Journal | None) -> MixedReplay:
    sizes = ReplayConfig(
        capacity=config.capacity, min_decisions=config.batch, ahead=config.batch, samples_per_insert=8.0
    )
    return MixedReplay(sizes, ReplayConfig(), 0.0, journal=journal)


def _filled(replay: MixedReplay, segments: Iterator[Segment], config: BenchReplayConfig) -> float:
    """Microseconds a decision, of filling it, and of as much again, for which others must leave."""
    ready = list(itertools.islice(segments, 2 * config.capacity // config.segment_length))
    return _us(lambda: [replay.insert(s) for s in ready], len(ready) * config.segment_length)


def _drawn(replay: MixedReplay, config: BenchReplayConfig) -> float:
    rng, drawn = np.random.default_rng(0), 0
    started = time.perf_counter()
    for _ in range(config.capacity // config.batch):
        drawn += sum(map(len, replay.sample(config.batch, 1, rng)))
    return 1e6 * (time.perf_counter() - started) / drawn


def _saved(replay: MixedReplay, folder: Path) -> tuple[float, int]:
    """Seconds and bytes of a whole checkpoint with nothing else in it."""

    def write(path: Path) -> int:
        snapshot.save(path / "training_state" / "replay", replay.state(None))
        return 1

    started = time.perf_counter()
    path = save_checkpoint(folder / "checkpoints", write)
    return time.perf_counter() - started, sum(f.stat().st_size for f in path.rglob("*") if f.is_file())


def _bytes(segment: Segment) -> int:
    arrays = [*segment.observations.values(), *segment.latent.values(), segment.actions, segment.log_prob]
    return sum(array.nbytes for array in arrays)


def _us(work: Callable[[], Any], decisions: int) -> float:
    started = time.perf_counter()
    work()
    return 1e6 * (time.perf_counter() - started) / decisions
