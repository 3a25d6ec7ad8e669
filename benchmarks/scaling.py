# SPDX-License-Identifier: Apache-2.0
"""How collecting grows with the number of environments: R(N) decisions a second of N environments, through
all workers.

    E(N) = R(N) / (N · R(1))

Each environment is a process, each observation 301 KB, and all of them go to the service, into the replay
and to the trainer. What is slept costs no processor, so that many environments can be measured on few cores;
where these were busy for more than `MOST_BUSY` of the time, they may be what was measured, and the row says
so.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any

from rich.table import Table

from accerl_lerobot.config.ranges import NonNegative, Positive, Range, Repeats
from accerl_lerobot.console import Console
from accerl_lerobot.errors import InputError
from accerl_lerobot.replay.buffer import ASYNCHRONOUS
from benchmarks.machinery import MOST_BUSY, MachineryConfig
from benchmarks.simulated_environment import read_trace
from benchmarks.tables import as_markdown, as_table, host, output_folder, ranged, spread, write
from benchmarks.throughput import Block


@dataclass(frozen=True, kw_only=True)
class BenchScalingConfig(MachineryConfig):
    """How many environments, for how long."""

    counts: tuple[Annotated[int, Range("[1, 1000]")], ...] = (1, 2, 4, 8, 16, 32, 64)
    """Environments; takes the place of `environments`. The first is what the others are compared with."""
    image_size: Annotated[int, Range("[8, 480]")] = 317
    latency_ms: Positive = 200.0
    latency_cv: Annotated[float, Range("[0, 10]")] = 0.0
    update_ms: NonNegative = 10.0
    """Short, so that the trainer is not what is measured."""
    seconds: Positive = 6.0
    """Shortest duration of a block."""
    blocks: Repeats = 5
    """At each count."""
    output_dir: str = "outputs/scaling"
    """Folder for scaling.json and .md."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.counts or len(set(self.counts)) < len(self.counts):
            raise InputError("counts", self.counts, "name numbers of environments, none of them twice")


def bench_scaling(config: BenchScalingConfig) -> dict[str, Any]:
    """Measures all counts, forth and back, half of the blocks each.

    Returns:
        ``counts``: for each, decisions per second, E(N), the bound, their share of it, and whether the
        processors were busy; ``config`` and ``host``.
    """
    if config.latency_trace is not None:
        read_trace(config.latency_trace)
    console, root = Console(), output_folder(config.output_dir)
    result: dict[str, Any] = {"config": asdict(config), "host": host()}
    blocks: dict[int, list[Block]] = {n: [] for n in config.counts}
    back = config.blocks // 2
    forth = config.blocks - back
    legs = [(n, forth) for n in config.counts] + [(n, back) for n in reversed(config.counts) if back]
    with console.stage("counts", total=len(legs)) as stage:
        for done, (n, repeats) in enumerate(legs, start=1):
            with replace(config, environments=n).open() as engine:
                blocks[n] += [engine.block(ASYNCHRONOUS, config.seconds) for _ in range(repeats)]
            stage.update(done, f"{n} environments: {blocks[n][-1].decisions_per_s:.0f} decisions/s")
    result |= {"counts": compare(config, blocks), "host_after": host()}
    write(root, "scaling", result, as_markdown(_COLUMNS, _rows(result)))
    console.say(f"wrote scaling.json and .md into {root}")
    return result


def compare(config: BenchScalingConfig, blocks: dict[int, list[Block]]) -> list[dict[str, Any]]:
    """Compares the blocks of each count: `bench_scaling`'s ``counts``."""
    rates = {n: spread([b.decisions_per_s for b in of]) for n, of in blocks.items()}
    first = config.counts[0]
    one = rates[first]["median"] / first
    return [
        {
            "environments": n,
            "decisions_per_s": rates[n],
            "efficiency": spread([rate / (n * one) for rate in rates[n]["blocks"]]),
            "bound": (bound := replace(config, environments=n).bound),
            "share_of_bound": rates[n]["median"] / bound,
            "processors": max(b.processors for b in of),
            "processor_bound": max(b.processors for b in of) > MOST_BUSY,
            "batch_size": sum(b.batch_size for b in of) / len(of),
            "blocks": [asdict(block) for block in of],
        }
        for n, of in blocks.items()
    ]


def table(result: dict[str, Any]) -> Table:
    """`result` for people."""
    return as_table("decisions per second by number of environments", _COLUMNS, _rows(result))


_COLUMNS = ("environments", "decisions/s", "E(N)", "of the bound", "batch", "processors", "")


def _rows(result: dict[str, Any]) -> list[list[str]]:
    return [
        [
            str(row["environments"]),
            ranged(row["decisions_per_s"], ".1f"),
            f"{row['efficiency']['median']:.2f}",
            f"{row['share_of_bound']:.2f}",
            f"{row['batch_size']:.1f}",
            f"{row['processors']:.0%}",
            "processors busy" if row["processor_bound"] else "",
        ]
        for row in result["counts"]
    ]
