# SPDX-License-Identifier: Apache-2.0
"""The effect of staleness on each algorithm: one recipe, with published weights held back on purpose.

    python -m benchmarks lag --recipe=recipes/gipo.yaml --updates=200

Lag is what `trainer.hold_back` and replay make it; see `study.py`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from accerl_lerobot.config.ranges import Steps
from accerl_lerobot.console import Console
from benchmarks.records import as_markdown, write
from benchmarks.study import (
    INTERVALS,
    Cell,
    Results,
    Study,
    StudyConfig,
    draw_lines,
    named,
    rated,
    tabled,
    together,
)


@dataclass(frozen=True, kw_only=True)
class BenchLagConfig(StudyConfig):
    """Fields of ``python -m benchmarks lag``."""

    output_dir: str = "outputs/lag"
    """Folder of the runs and of lag.json, lag.md and lag.png; finished cells in it are kept."""
    algorithms: tuple[str, ...] = ("gipo", "ppo")
    """Values of ``algorithm.type``; the algorithm's other fields are the recipe's where it has them."""
    lags: tuple[Steps, ...] = (0, 4, 16, 64)
    """Values of ``trainer.hold_back``, in updates; what replay adds is reported."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("algorithms", "lags"):
            named(self, name)


def cells(config: BenchLagConfig) -> list[Cell]:
    """Cells of all algorithms, lags and seeds; seeds outermost, so that what is stopped has compared
    everything on the first ones.
    """
    return [
        Cell(
            name=f"{algorithm}-lag{lag}-seed{seed}",
            seed=seed,
            of={"algorithm": algorithm, "lag": lag},
            chosen=(f"--algorithm.type={algorithm}", f"--trainer.hold_back={lag}"),
        )
        for seed in config.seeds
        for lag in config.lags
        for algorithm in config.algorithms
    ]


def bench_lag(config: BenchLagConfig) -> dict[str, Any]:
    """Runs the cells that are missing, and compares all of them.

    Returns:
        ``starts`` (success of each seed's warm start), ``cells`` (success, n, env steps and measured lag of
        each run) and ``groups``: algorithm, lag, successes and episodes over the seeds.
    """
    study, console = Study(config, cells(config)), Console()
    result = compare(config, study.run(console))
    write(study.root, "lag", result, markdown(result), draw)
    console.say(f"wrote lag.json, lag.md and lag.png into {study.root}")
    return result


def compare(config: BenchLagConfig, results: Results) -> dict[str, Any]:
    """The study's numbers from the summaries of its runs; see `bench_lag`."""
    shown = ("env_steps", "decisions", "updates", "lag_mean", "lag_max", "rl_s")
    cells = results.table(shown)
    groups = []
    for algorithm in config.algorithms:
        for lag in config.lags:
            of = [c for c in cells if (c["algorithm"], c["lag"]) == (algorithm, lag)]
            groups.append(
                {
                    "algorithm": algorithm,
                    "lag": lag,
                    **together(of),
                    "env_steps": sum(c["env_steps"] for c in of) / len(of),
                    "lag_mean": sum(c["lag_mean"] for c in of) / len(of),
                }
            )
    return {"config": asdict(config), "starts": results.before, "groups": groups, "cells": cells}


def table(result: dict[str, Any]) -> Table:
    """`result` for people: one row per algorithm, one column per lag."""
    return tabled("success after training at forced lag; before it", result, _columns(result), _rows(result))


def markdown(result: dict[str, Any]) -> str:
    """`table` for the docs."""
    return as_markdown(_columns(result), _rows(result)) + f"\n{INTERVALS.capitalize()}.\n"


def draw(path: Path, result: dict[str, Any]) -> None:
    """Success over lag: one line per algorithm with its 95 % interval, one dot per seed."""
    lags = result["config"]["lags"]

    def dress(axes: Any) -> None:
        axes.set_xticks(range(len(lags)), [str(lag) for lag in lags])
        axes.set(xlabel="weights held back, in updates")
        axes.legend(loc="lower left")

    def places(i: float) -> list[float]:
        return [place + 0.08 * i for place in range(len(lags))]

    draw_lines(path, result, "algorithm", result["config"]["algorithms"], places, dress)


def _columns(result: dict[str, Any]) -> list[str]:
    columns = ["algorithm"]
    for lag in result["config"]["lags"]:
        means = [f"{g['lag_mean']:.0f}" for g in result["groups"] if g["lag"] == lag]
        measured = "–".join(dict.fromkeys((min(means, key=int), max(means, key=int))))
        columns.append(f"held back {lag} (lag {measured})")
    return columns


def _rows(result: dict[str, Any]) -> list[list[str]]:
    rows = []
    for name in result["config"]["algorithms"]:
        row = [name]
        for g in (g for g in result["groups"] if g["algorithm"] == name):
            row.append(rated(g))
        rows.append(row)
    return rows
