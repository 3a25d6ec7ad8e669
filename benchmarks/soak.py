# SPDX-License-Identifier: Apache-2.0
"""How a run bears up: a fault in every other minute, and what of its throughput is left in that minute.

    python -m benchmarks soak --minutes=10

Blocks without a fault and blocks with one take turns, forth and back, in one run, so that whatever else
changes befalls both alike. What counts is what counts in the end: an update that is lost with a worker and
made again is one.
"""

from __future__ import annotations

import random
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from rich.table import Table

from accerl_lerobot.config.ranges import Positive, Range, Section, Seed
from accerl_lerobot.console import Console
from accerl_lerobot.errors import InputError, check_absent, make_folder
from benchmarks.audit import audit_segments, audit_updates
from benchmarks.faults import BenchFaultsConfig, Start, end_run, recipe_of
from benchmarks.hits import START_S, strike
from benchmarks.records import as_markdown, write
from benchmarks.tables import as_table, host, ranged, spread
from benchmarks.victims import DRIVER, EVERYTHING, Victim

QUIET, STRUCK = "quiet", "struck"
ORDER = (QUIET, STRUCK, STRUCK, QUIET)
"""Order of blocks, again and again."""


@dataclass(frozen=True, kw_only=True)
class BenchSoakConfig(Section):
    """How long, how often, and what."""

    recipe: str | None = None
    """See ``python -m benchmarks faults``."""
    output_dir: str = "outputs/soak"
    """Folder of the run and of soak.json and .md; must not exist."""
    minutes: Positive = 8.0
    """In all, beside the start; at least four blocks."""
    block_s: Annotated[float, Range("[20, inf)")] = 60.0
    """Seconds of a block; in every other one there is one fault. At least 20."""
    targets: tuple[str, ...] = ("rollout", "inference", "replay", "trainer")
    """See ``python -m benchmarks faults``; not of the run's own process, which does not resume by itself."""
    faults: tuple[str, ...] = ("kill", "exception", "exit")
    """See ``python -m benchmarks faults``."""
    stall_s: Annotated[float, Range("[5, inf)")] = 10.0
    """See ``python -m benchmarks faults``."""
    seed: Seed = 0
    """Seed of faults, places and moments."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.blocks >= len(ORDER):
            least = len(ORDER) * self.block_s / 60
            raise InputError("minutes", self.minutes, f"use at least {least:g}: both kinds, forth and back")
        if {DRIVER, EVERYTHING} & set(self.targets):
            raise InputError("targets", self.targets, "leave out driver and everything")
        if not all(self.of.of(target) for target in self.targets):
            raise InputError("faults", self.faults, "add kill, which can befall any target")

    @property
    def blocks(self) -> int:
        """Number of blocks, in whole turns."""
        whole = int(self.minutes * 60 / self.block_s)
        return whole // len(ORDER) * len(ORDER)

    @property
    def of(self) -> BenchFaultsConfig:
        """The same of ``python -m benchmarks faults``."""
        return BenchFaultsConfig(
            recipe=self.recipe, targets=self.targets, faults=self.faults, stall_s=self.stall_s, seed=self.seed
        )


def bench_soak(config: BenchSoakConfig) -> dict[str, Any]:
    """Measures one run.

    Returns:
        ``blocks``, of each ``kind``, ``seconds``, ``updates`` and ``decisions`` learned from a second, and
        the ``hit``; ``rates`` of either kind; ``left``, the share of them that was left, pair by pair; what
        `audit` finds; ``config``, ``host``.
    """
    root, console = Path(config.output_dir).expanduser().resolve(), Console()
    recipe = recipe_of(config.of)
    check_absent(root)
    make_folder(root, "output_dir")
    start = Start(config.recipe, recipe, config.stall_s, root, console)
    rng, orders = random.Random(config.seed), root / "run.orders"
    result: dict[str, Any] = {"config": asdict(config), "host": host(), "blocks": []}
    victim = start.run("run", orders=orders)
    try:
        victim.await_update(20, START_S)
        with console.stage("blocks", total=config.blocks) as stage:
            for number in range(config.blocks):
                kind = ORDER[number % len(ORDER)]
                block = _block(config, victim, orders, str(number), kind, rng)
                result["blocks"].append(block)
                stage.update(number + 1, f"{kind}: {block['updates']:.1f} updates/s")
        result |= compare(result["blocks"])
        result |= end_run(victim)
    finally:
        victim.kill()
    result |= audit_updates(victim.records()) | audit_segments(victim.folder)
    result["host_after"] = host()
    write(root, "soak", result, as_markdown(_COLUMNS, _rows(result)))
    return result


def _block(
    config: BenchSoakConfig, victim: Victim, orders: Path, name: str, kind: str, rng: random.Random
) -> dict[str, Any]:
    """Some seconds of the run; the fault, if any, is early enough that the block bears all of it."""
    before, began, struck = _made(victim), time.monotonic(), None
    if kind == STRUCK:
        target = rng.choice(config.targets)
        fault = rng.choice(config.of.of(target))
        time.sleep(rng.uniform(0.0, config.block_s / 10))
        struck = asdict(strike(victim, orders, name, target, fault, rng))
        if struck["outcome"] == "lost":
            raise RuntimeError(f"{fault} of {target}: {struck['said']}")
    time.sleep(max(0.0, began + config.block_s - time.monotonic()))
    seconds, after = time.monotonic() - began, _made(victim)
    return {
        "kind": kind,
        "seconds": seconds,
        "updates": (after[0] - before[0]) / seconds,
        "decisions": (after[1] - before[1]) / seconds,
        "hit": struck,
    }


def _made(victim: Victim) -> tuple[int, float]:
    """Updates, and decisions learned from, that are in the log."""
    train = [record for record in victim.records() if record["kind"] == "train"]
    return len(train), sum(record["decisions"] for record in train)


def compare(blocks: list[dict[str, Any]]) -> dict[str, Any]:
    """Compares the blocks in `ORDER`: ``rates`` of either kind, and the share ``left`` of them, pair by
    pair."""
    rates, left = {}, {}
    for name in ("updates", "decisions"):
        of = {kind: [b[name] for b in blocks if b["kind"] == kind] for kind in (QUIET, STRUCK)}
        rates[name] = {kind: spread(values) for kind, values in of.items()}
        left[name] = spread([b / a for a, b in zip(of[QUIET], of[STRUCK], strict=True)])
    return {"rates": rates, "left": left}


def table(result: dict[str, Any]) -> Table:
    """`result` for people."""
    return as_table("a fault in every other block", _COLUMNS, _rows(result))


_COLUMNS = ("a second", "without a fault", "with one", "left")


def _rows(result: dict[str, Any]) -> list[list[str]]:
    rows = []
    for name in ("updates", "decisions"):
        rates = result["rates"][name]
        cells = [ranged(rates[kind], ".1f") for kind in (QUIET, STRUCK)]
        rows.append([name, *cells, ranged(result["left"][name], ".0%")])
    return rows
