# SPDX-License-Identifier: Apache-2.0
"""Cost of asking inference for a decision: by Ray, and by the package's sockets.

    python -m benchmarks transport --output_dir=outputs/transport

A call is timed where a rollout worker would wait, from the request to the decision. The service answers at
once. All arms are measured in the same processes, since Ray gives its workers a lower priority than others
have. Blocks go forth and back (A B B A), so that a machine that slows down slows every arm.
"""

from __future__ import annotations

import itertools
import os
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rich.table import Table

from accerl_lerobot.config.ranges import Pattern, Range, Repeats, Section, Seed
from accerl_lerobot.console import Console
from accerl_lerobot.engines import ray_session
from accerl_lerobot.errors import check_absent
from accerl_lerobot.experience import Decision, Request
from accerl_lerobot.transport import Client, Server
from benchmarks.tables import as_markdown, as_table, host, named, ranged, spread, write

RAY, SOCKET = "ray", "socket"
IMAGES = {"12 KB": (1, 64, 4), "301 KB": (2, 224, 8)}
"""Observation → cameras, their height and width, numbers of the state: our MetaWorld's, and a VLA's."""
CHUNK, ACTIONS, LATENT = 50, 7, 32
LONG_S = 120.0  # seconds after which an end counts as hung
BEGIN_S = 0.05  # how long before the first call callers are told when it is


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
        named(self, "sizes", "callers")


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
    folder = None if config.output_dir is None else Path(config.output_dir).expanduser()
    if folder is not None:
        check_absent(folder)
    import ray

    console = Console()
    before = host()
    results = []
    joined = ray.is_initialized()
    if not joined:
        ray_session.start_ray()
    try:
        service = ray.remote(Answering).options(num_cpus=0, max_concurrency=1000).remote()
        address = ray.get(service.listen.remote(), timeout=LONG_S)
        actor = ray.remote(Calling).options(num_cpus=0)
        crowd = [actor.remote(service, address) for _ in range(max(config.callers))]
        for size, callers in itertools.product(config.sizes, config.callers):
            with console.stage(f"{size}, {callers} at a time", total=config.rounds) as stage:
                results += _measure(crowd[:callers], config, size, stage.update)
        for actor in (*crowd, service):
            ray.kill(actor)
    finally:
        if not joined:
            ray.shutdown()
    load = os.getloadavg()[0]
    result = {"config": asdict(config), "host": before, "load_after": load, "results": results}
    if folder is not None:
        folder.mkdir(parents=True)
        write(folder, "transport", result, as_markdown(_COLUMNS, _rows(result)))
        console.say(f"wrote transport.json and .md into {folder}")
    return result


def _measure(callers: list[Any], config: BenchTransportConfig, size: str, tell: Any) -> list[dict[str, Any]]:
    """All arms of one size and these callers, forth and back; see `bench_transport`."""
    blocks: dict[str, list[tuple[float, float, float]]] = {RAY: [], SOCKET: []}
    for arm in blocks:
        _block(callers, config, arm, size, max(10, config.calls // 4))  # everything is warm after that
    for number in range(config.rounds):
        for arm in (RAY, SOCKET, SOCKET, RAY):
            blocks[arm].append(_block(callers, config, arm, size, config.calls))
        tell(number + 1)
    found = []
    for arm, values in blocks.items():
        p50, p99, rate = (spread(list(column)) for column in zip(*values, strict=True))
        row = {"size": size, "callers": len(callers), "arm": arm}
        found.append(row | {"p50_us": p50, "p99_us": p99, "calls_per_s": rate})
    return found


def _block(
    callers: list[Any], config: BenchTransportConfig, arm: str, size: str, calls: int
) -> tuple[float, float, float]:
    """Two quantiles of the microseconds of a call, and the calls per second of all callers."""
    import ray

    begin = time.monotonic() + BEGIN_S
    asked = [caller.measure.remote(arm, size, config.seed, calls, begin) for caller in callers]
    found = ray.get(asked, timeout=LONG_S)
    p50, p99 = np.percentile(np.concatenate([seconds for seconds, _ in found]), (50, 99)) * 1e6
    wall = max(end for _, end in found) - begin
    return float(p50), float(p99), len(callers) * calls / wall


class Answering:
    """The service: answers at once, always the same; becomes an asynchronous Ray actor."""

    def __init__(self) -> None:
        self._decision = decision()

    async def listen(self) -> Any:
        """Serves sockets on a thread, as inference does; returns the address."""
        server = Server(lambda asked: asked.answer([self._decision] * len(asked.message)))

        def serve() -> None:
            while True:
                server.poll(1.0)

        threading.Thread(target=serve, daemon=True).start()
        return server.address

    async def decide(self, requests: list[Request]) -> list[Decision]:
        """Ray's way in."""
        return [self._decision] * len(requests)


class Calling:
    """One caller, which becomes a Ray actor."""

    def __init__(self, service: Any, address: Any) -> None:
        self._service = service
        self._client = Client("answering", address)

    def measure(self, arm: str, size: str, seed: int, calls: int, begin: float) -> tuple[list[float], float]:
        """Seconds of each call, and the moment of the last one's end, on `time.monotonic`."""
        message = [request_of(size, seed)]
        call = self._by_ray if arm == RAY else self._by_socket
        seconds = []
        time.sleep(max(0.0, begin - time.monotonic()))
        for _ in range(calls):
            started = time.perf_counter()
            call(message)
            seconds.append(time.perf_counter() - started)
        return seconds, time.monotonic()

    def _by_ray(self, message: list[Request]) -> None:
        import ray

        ray.get(self._service.decide.remote(message), timeout=LONG_S)

    def _by_socket(self, message: list[Request]) -> None:
        self._client.send(message)
        if not self._client.done(LONG_S):
            raise TimeoutError(f"no decision within {LONG_S:g} s")


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
