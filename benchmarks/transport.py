# SPDX-License-Identifier: Apache-2.0
"""Cost of asking inference for a decision: Ray, the package's sockets, and the lower bound of any transport.

    python -m benchmarks transport --output_dir=outputs/transport

A call is timed where a rollout worker would wait: from the request, through the contract, to the decision.
The service answers at once, so what is measured is the way there and back. *slot* is the floor, for one
caller: a bare copy into shared memory, with a token of one byte there and back. Blocks go forth and back
(A B C C B A) in one run, so that a machine that slows down slows every arm.
"""

from __future__ import annotations

import itertools
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rich.table import Table

from accerl_lerobot.config.ranges import Pattern, Range, Repeats, Section, Seed
from accerl_lerobot.console import Console
from accerl_lerobot.engines import ray_session
from accerl_lerobot.errors import check_absent, make_folder
from accerl_lerobot.experience import Decision, Request
from benchmarks.records import as_markdown, write
from benchmarks.study import named
from benchmarks.tables import as_table, host, ranged, spread

RAY, SOCKET, SLOT = "ray", "socket", "slot"
IMAGES = {"12 KB": (1, 64, 4), "301 KB": (2, 224, 8)}
"""Observation → cameras, their height and width, numbers of the state: our MetaWorld's, and a VLA's."""
CHUNK, ACTIONS, LATENT = 50, 7, 32


@dataclass(frozen=True, kw_only=True)
class BenchTransportConfig(Section):
    """Fields of ``python -m benchmarks transport``."""

    sizes: tuple[Annotated[str, Pattern("|".join(IMAGES), " or ".join(IMAGES))], ...] = tuple(IMAGES)
    """Observations: ``12 KB`` (64 pixels, one camera) and ``301 KB`` (224 pixels, two cameras)."""
    callers: tuple[Annotated[int, Range("[1, 1000]")], ...] = (1, 8)
    """Processes that ask at a time."""
    calls: Annotated[int, Range("[10, 100000000]")] = 400
    """Calls of each caller in a block."""
    rounds: Repeats = 3
    """Times each arm is measured twice."""
    seed: Seed = 0
    """Seed of the images' contents."""
    output_dir: str | None = None
    """Folder to create, for transport.json and .md; None prints only."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("sizes", "callers"):
            named(self, name)


def request_of(size: str, seed: int) -> Request:
    """A request with an observation of this size."""
    cameras, side, numbers = IMAGES[size]
    draw = np.random.default_rng(seed)
    observation: dict[str, np.ndarray | str] = {
        f"observation.images.{i}": draw.integers(0, 256, (side, side, 3), np.uint8) for i in range(cameras)
    }
    observation["observation.state"] = draw.normal(size=numbers).astype(np.float32)
    observation["task"] = "open the drawer"
    return Request(observation=observation, noise_seed=seed)


def decision() -> Decision:
    """A decision as large as a flow policy's."""
    return Decision(
        chunk=np.zeros((CHUNK, ACTIONS), np.float32),
        latent={"noise": np.zeros((CHUNK, LATENT), np.float32)},
        log_prob=np.zeros(CHUNK, np.float32),
        version=7,
    )


def bench_transport(config: BenchTransportConfig) -> dict[str, Any]:
    """Measures every arm at every size, by one caller and by several.

    Returns:
        ``results``, a list: ``size``, ``callers``, ``arm``; over the blocks, median and range of their
        ``p50_us``, ``p99_us`` and ``calls_per_s`` (of all callers together); ``config``, ``host``,
        ``load_after``.
    """
    ray_session.prepare()
    from benchmarks.transport_ends import Crowd

    folder = None if config.output_dir is None else Path(config.output_dir).expanduser()
    if folder is not None:
        check_absent(folder)
    console, before, results = Console(), host(), []
    with Crowd(max(config.callers), config.seed) as crowd:
        for size, callers in itertools.product(config.sizes, config.callers):
            with console.stage(f"{size}, {callers} at a time", total=config.rounds) as stage:
                results += _measure(crowd, config, size, callers, stage.update)
    load = os.getloadavg()[0]
    result = {"config": asdict(config), "host": before, "load_after": load, "results": results}
    if folder is not None:
        make_folder(folder, "output_dir")
        write(folder, "transport", result, as_markdown(_COLUMNS, _rows(result)))
        console.say(f"wrote transport.json and .md into {folder}")
    return result


def _measure(crowd: Any, config: BenchTransportConfig, size: str, callers: int, tell: Any) -> list[Any]:
    """All arms of one size and number of callers, forth and back; see `bench_transport`."""
    arms = (RAY, SOCKET, SLOT)[: 3 if callers == 1 else 2]
    blocks: dict[str, list[tuple[float, float, float]]] = {arm: [] for arm in arms}
    for arm in arms:
        crowd.measure(arm, size, callers, max(10, config.calls // 4))  # everything is warm after that
    for number in range(config.rounds):
        for arm in (*arms, *reversed(arms)):
            seconds, wall = crowd.measure(arm, size, callers, config.calls)
            low, high = np.percentile(np.concatenate(seconds), (50, 99)) * 1e6
            blocks[arm].append((float(low), float(high), callers * config.calls / wall))
        tell(number + 1)
    found = []
    for arm, values in blocks.items():
        p50, p99, rate = (spread(list(column)) for column in zip(*values, strict=True))
        row = {"size": size, "callers": callers, "arm": arm}
        found.append(row | {"p50_us": p50, "p99_us": p99, "calls_per_s": rate})
    return found


def table(result: dict[str, Any]) -> Table:
    """`result` for people."""
    return as_table("microseconds from a request to its decision", _COLUMNS, _rows(result))


_COLUMNS = ("observation", "callers", "arm", "p50", "p99", "calls/s")


def _rows(result: dict[str, Any]) -> list[list[str]]:
    return [
        [
            row["size"],
            str(row["callers"]),
            row["arm"],
            *(ranged(row[kind], ",.0f") for kind in ("p50_us", "p99_us", "calls_per_s")),
        ]
        for row in result["results"]
    ]
