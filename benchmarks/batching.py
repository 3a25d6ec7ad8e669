# SPDX-License-Identifier: Apache-2.0
"""The effect of waiting for other requests on batches, waits and decisions a second, by batching rule.

*one at a time* does not batch. *as they come* takes whatever waits when the service is free. The others have
the oldest request wait so long for more to come. Each rule is an engine of its own, all of them forth and
back in one run.
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
from benchmarks.records import as_markdown, output_folder, write
from benchmarks.simulated_environment import read_trace
from benchmarks.tables import as_table, host, ranged, spread
from benchmarks.throughput import Measured


@dataclass(frozen=True, kw_only=True)
class BenchBatchingConfig(MachineryConfig):
    """Which rules, for how long."""

    environments: Annotated[int, Range("[1, 1000]")] = 32
    latency_ms: Positive = 50.0
    update_ms: NonNegative = 10.0
    """Short, so that the trainer is not what is measured."""
    waits_ms: tuple[Annotated[float, Range("[0, 10000)")], ...] = (0.0, 2.0, 10.0, 40.0)
    """Waits of the oldest request, in milliseconds; 0: as they come. Take the place of `max_wait_ms`."""
    seconds: Positive = 5.0
    """Shortest duration of a block."""
    blocks: Repeats = 3
    """Blocks of each rule, one each time it has its turn."""
    output_dir: str = "outputs/batching"
    """Folder for batching.json and .md."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.waits_ms:
            raise InputError("waits_ms", self.waits_ms, "name at least one")


def bench_batching(config: BenchBatchingConfig) -> dict[str, Any]:
    """Measures all rules.

    Returns:
        ``rules``: for each, decisions per second, mean wait in milliseconds, mean batch size and how busy the
        service was; ``config`` and ``host``.
    """
    if config.latency_trace is not None:
        read_trace(config.latency_trace)
    console, root = Console(), output_folder(config.output_dir)
    result: dict[str, Any] = {"config": asdict(config), "host": host()}
    rules = {"one at a time": replace(config, max_batch=1, max_wait_ms=0.0)}
    rules |= {_name(wait): replace(config, max_wait_ms=wait) for wait in config.waits_ms}
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in rules}
    order = [*rules, *reversed(rules)]
    with console.stage("rules", total=len(order)) as stage:
        for done, name in enumerate(order, start=1):
            found[name].append(_measure(rules[name], config.seconds, config.blocks))
            stage.update(done, f"{name}: {found[name][-1]['decisions_per_s'][-1]:.0f} decisions/s")
    result["rules"] = {name: summed(turns) for name, turns in found.items()}
    result["host_after"] = host()
    write(root, "batching", result, as_markdown(_COLUMNS, _rows(result)))
    console.say(f"wrote batching.json and .md into {root}")
    return result


def summed(turns: list[dict[str, Any]]) -> dict[str, Any]:
    """Sums the turns of one rule: see `bench_batching`."""
    batches = sum(turn["batches"] for turn in turns)
    observations = sum(turn["observations"] for turn in turns)
    return {
        "decisions_per_s": spread([rate for turn in turns for rate in turn["decisions_per_s"]]),
        "wait_mean_ms": 1000 * sum(turn["waited_s"] for turn in turns) / observations,
        "batch_size": observations / batches,
        "inference_busy": sum(turn["inference_busy"] for turn in turns) / len(turns),
        "processor_bound": max(turn["processors"] for turn in turns) > MOST_BUSY,
    }


def table(result: dict[str, Any]) -> Table:
    """`result` for people."""
    return as_table(
        f"{result['config']['environments']} environments, by rule of batching", _COLUMNS, _rows(result)
    )


def _measure(rule: BenchBatchingConfig, seconds: float, count: int) -> dict[str, Any]:
    with rule.open() as engine:
        engine.block(ASYNCHRONOUS, 0.0)  # what begins is not counted
        before = _totals(engine)
        blocks = [engine.block(ASYNCHRONOUS, seconds) for _ in range(count)]
        after = _totals(engine)
    return {
        "decisions_per_s": [block.decisions_per_s for block in blocks],
        **{name: after[name] - before[name] for name in after},
        "inference_busy": sum(block.inference_busy for block in blocks) / count,
        "processors": max(block.processors for block in blocks),
    }


def _totals(engine: Measured) -> dict[str, float]:
    """Batches so far, observations in them, and how long these had waited; a request has one of them."""
    metrics = engine.engine.poll().inference
    observations = metrics["batches"] * metrics["batch_size_mean"]
    waited_s = observations * metrics["wait_mean_s"]
    return {"batches": metrics["batches"], "observations": observations, "waited_s": waited_s}


def _name(wait_ms: float) -> str:
    return f"at most {wait_ms:g} ms" if wait_ms else "as they come"


_COLUMNS = ("rule", "decisions/s", "batch", "mean wait", "service busy", "")


def _rows(result: dict[str, Any]) -> list[list[str]]:
    return [
        [
            name,
            ranged(found["decisions_per_s"], ".0f"),
            f"{found['batch_size']:.1f}",
            f"{found['wait_mean_ms']:.1f} ms",
            f"{found['inference_busy']:.0%}",
            "processors busy" if found["processor_bound"] else "",
        ]
        for name, found in result["rules"].items()
    ]
