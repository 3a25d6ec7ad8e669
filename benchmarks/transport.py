# SPDX-License-Identifier: Apache-2.0
"""Cost of asking inference for a decision: Ray, shared memory, and the lower bound of any transport.

    python -m benchmarks transport --output_dir=outputs/transport

A call is timed where a rollout worker would wait: from the request, through the contract, to the decision.
The service answers at once, so what is measured is the way there and back. Arms:

    ray, ray_put             the message by value, and put into the object store first
    shared_memory            through `transport/shared_memory.py`
    pipe, slot, memcpy       floors, for one caller: raw bytes through a pipe and back; a bare copy into
                             shared memory, with a token of one byte there and back; the copy alone

Blocks go forth and back (A B C C B A) in one run, so that a machine that slows down slows every arm.
"""

from __future__ import annotations

import itertools
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rich.table import Table

from accerl_lerobot.bench import host, spread
from accerl_lerobot.config.ranges import Pattern, Range, Repeats, Section, Seed
from accerl_lerobot.console import Console
from accerl_lerobot.engine import ray_session
from accerl_lerobot.errors import InputError, check_absent, make_folder
from accerl_lerobot.evaluation import drawing
from accerl_lerobot.experience import Decision, Request

RAY, RAY_PUT, SHARED_MEMORY = "ray", "ray_put", "shared_memory"
PIPE, SLOT, MEMCPY = "pipe", "slot", "memcpy"
FLOORS = PIPE, SLOT, MEMCPY
ARMS = RAY, RAY_PUT, SHARED_MEMORY
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
    """Folder to create, for transport.json and transport.png; None prints only."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("sizes", "callers"):
            if not getattr(self, name):
                raise InputError(name, (), "name at least one")


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


def arrays_of(request: Request) -> list[np.ndarray]:
    """The large arrays of a request."""
    return [value for value in request.observation.values() if isinstance(value, np.ndarray)]


def bench_transport(config: BenchTransportConfig) -> dict[str, Any]:
    """Measures every arm at every size, by one caller and by several.

    Returns:
        ``results``, a list: ``size``, ``bytes``, ``callers``, ``arm``; over the blocks, median and range of
        their ``p50_us``, ``p99_us`` and ``calls_per_s`` (of all callers together), and, of one caller,
        ``of_floor``: the bare slot's p50 over the arm's, block by block. ``config``, ``host``,
        ``load_after``.

    Raises:
        InputError: `output_dir` exists, or this system has no shared memory.
    """
    ray_session.prepare()
    from benchmarks.transport_ends import Crowd

    folder = None if config.output_dir is None else Path(config.output_dir).expanduser()
    if folder is not None:
        check_absent(folder)
    console, before = Console(), host()
    results = []
    with Crowd(max(config.callers), config.seed) as crowd:
        cases = list(itertools.product(config.sizes, config.callers))
        for size, callers in cases:
            with console.stage(f"{size}, {callers} at a time", total=config.rounds) as stage:
                results += measure(crowd, config, size, callers, stage.update)
    load = os.getloadavg()[0]
    result = {"config": asdict(config), "host": before, "load_after": load, "results": results}
    if folder is not None:
        make_folder(folder, "output_dir")
        (folder / "transport.json").write_text(json.dumps(result, indent=2) + "\n")
        draw(folder / "transport.png", result)
        console.say(f"wrote transport.json and transport.png into {folder}")
    return result


def measure(crowd: Any, config: BenchTransportConfig, size: str, callers: int, tell: Any) -> list[Any]:
    """All arms of one size and number of callers, forth and back; see `bench_transport`."""
    arms = (*ARMS, *FLOORS) if callers == 1 else ARMS
    blocks: dict[str, list[tuple[float, float, float]]] = {arm: [] for arm in arms}
    for arm in arms:
        crowd.measure(arm, size, callers, max(10, config.calls // 4))  # everything is warm after that
    for number in range(config.rounds):
        for arm in (*arms, *reversed(arms)):
            seconds, wall = crowd.measure(arm, size, callers, config.calls)
            low, high = np.percentile(np.concatenate(seconds), (50, 99)) * 1e6
            blocks[arm].append((float(low), float(high), callers * config.calls / wall))
        tell(number + 1, "")
    nbytes = sum(array.nbytes for array in arrays_of(request_of(size, config.seed)))
    found = []
    for arm, values in blocks.items():
        p50, p99, rate = (spread(list(column)) for column in zip(*values, strict=True))
        row = {"size": size, "callers": callers, "arm": arm, "bytes": nbytes}
        row |= {"p50_us": p50, "p99_us": p99, "calls_per_s": rate}
        if callers == 1:
            pairs = zip(blocks[SLOT], values, strict=True)
            row["of_floor"] = spread([floor[0] / own[0] for floor, own in pairs])
        found.append(row)
    return found


def table(result: dict[str, Any]) -> Table:
    """`result` for people."""
    shown = Table(title="microseconds from a request to its decision; medians and ranges of blocks")
    for heading in (
        "observation",
        "callers",
        "arm",
        "p50",
        "range",
        "p99",
        "range",
        "calls/s",
        "of the floor",
    ):
        shown.add_column(heading, justify="left" if heading in ("observation", "arm") else "right")
    for row in result["results"]:
        cells = [row["size"], str(row["callers"]), row["arm"]]
        for kind in ("p50_us", "p99_us"):
            found = row[kind]
            cells += [f"{found['median']:,.0f}", f"{found['min']:,.0f} to {found['max']:,.0f}"]
        cells.append(f"{row['calls_per_s']['median']:,.0f}")
        cells.append(f"{row['of_floor']['median']:.2f}" if "of_floor" in row else "")
        shown.add_row(*cells)
    return shown


def draw(path: Path, result: dict[str, Any]) -> None:
    """p50 with the range of its blocks, a group of bars per size and number of callers."""
    rows = result["results"]
    cases = list(dict.fromkeys((row["size"], row["callers"]) for row in rows))
    arms = [arm for arm in (*ARMS, *FLOORS) if any(row["arm"] == arm for row in rows)]
    with drawing(path) as axes:
        for i, arm in enumerate(arms):
            of = {(row["size"], row["callers"]): row["p50_us"] for row in rows if row["arm"] == arm}
            x = [place + (i - (len(arms) - 1) / 2) * 0.13 for place, case in enumerate(cases) if case in of]
            y = [of[case]["median"] for case in cases if case in of]
            ends = [
                [abs(of[case][end] - of[case]["median"]) for case in cases if case in of]
                for end in ("min", "max")
            ]
            axes.bar(x, y, 0.12, yerr=ends, capsize=2, label=arm, color=f"C{i}", error_kw={"lw": 0.8})
        axes.set(yscale="log", ylabel="µs, p50")
        axes.set_xticks(range(len(cases)), [f"{size}, {n} caller{'s' * (n > 1)}" for size, n in cases])
        axes.grid(visible=False, axis="x")
        axes.legend(fontsize=8, ncols=2)
