# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""What staleness does to each algorithm: one recipe, with published weights held back on purpose.

    accerl bench lag --recipe=recipes/quickstart.yaml --updates=200

Every seed is warm-started once, and each cell (algorithm, lag, seed) is a run of its own from there, in the
single-process engine, where lag is what `trainer.hold_back` and replay make it and not what else the machine
is doing. Cells that are finished are kept: the same command goes on where it was stopped.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from accerl_lerobot.checkpoint import PRETRAINED
from accerl_lerobot.config import RunConfig, parse
from accerl_lerobot.console import Console
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation.stats import Rate

CONFIG, SUMMARY = "config.yaml", "summary.json"
LOG_LINES = 12
"""Of a run that failed, shown in the error."""


@dataclass(frozen=True, kw_only=True)
class BenchLagConfig:
    """What is compared."""

    recipe: str = "recipes/quickstart.yaml"
    """The run that every cell is a variation of."""
    output_dir: str = "outputs/lag"
    """Folder of the runs and of lag.json, lag.md and lag.png; finished cells in it are kept."""
    algorithms: tuple[str, ...] = ("gipo", "ppo", "decoupled", "sapo")
    """Values of ``algorithm.type``; the algorithm's other fields are the recipe's where it has them."""
    lags: tuple[int, ...] = (0, 4, 16, 64)
    """Values of ``trainer.hold_back``, in updates; what replay adds is reported."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Each a warm start of its own."""
    updates: int | None = None
    """Of each cell; None: the recipe's."""
    episodes: int = 100
    """Of the evaluation after each cell."""
    jobs: int = 2
    """Cells that run at the same time, each on one thread."""

    def __post_init__(self) -> None:
        for name in ("algorithms", "lags", "seeds"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise InputError(f"bench.{name}", values, "name at least one, none of them twice")
        for name in ("episodes", "jobs"):
            if getattr(self, name) < 1:
                raise InputError(f"bench.{name}", getattr(self, name), "use at least 1")


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One run of the study."""

    algorithm: str
    lag: int
    seed: int

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.algorithm}-lag{self.lag}-seed{self.seed}"

    def arguments(self, config: BenchLagConfig, checkpoint: Path | None) -> list[str]:
        """Of ``accerl train``; without a checkpoint, as they are before the warm start, to be checked."""
        chosen = [f"--algorithm.type={self.algorithm}", f"--trainer.hold_back={self.lag}"]
        if config.updates is not None:
            chosen.append(f"--trainer.updates={config.updates}")
        start = [] if checkpoint is None else ["--sft.steps=0", f"--policy.path={checkpoint}"]
        return _common(config, self.seed) + start + chosen


def bench_lag(config: BenchLagConfig) -> dict[str, Any]:
    """Runs the cells that are missing, and compares all of them.

    Returns:
        ``starts`` (success of each seed's warm start), ``cells`` (success, n, env steps and measured lag of
        each run) and ``groups``: algorithm, lag, successes and episodes over the seeds.

    Raises:
        InputError: a cell's settings are wrong; all are checked before the first run.
        RuntimeError: a run failed; the others that were under way have ended, and what is finished is kept.
    """
    # Seeds outermost: a study that is stopped has compared everything on the first ones.
    cells = [
        Cell(algorithm=a, lag=lag, seed=seed)
        for seed in config.seeds
        for lag in config.lags
        for a in config.algorithms
    ]
    recipes = [parse(RunConfig, cell.arguments(config, None)) for cell in cells]
    given = recipes[0].policy.path
    root = Path(config.output_dir).expanduser()
    root.mkdir(parents=True, exist_ok=True)
    console = Console()
    starts = {f"start-seed{seed}": [*_common(config, seed), "--trainer.updates=0"] for seed in config.seeds}
    _run_all(root, starts, config.jobs, "warm starts", console)
    checkpoints = {seed: _checkpoint(root / f"start-seed{seed}", given) for seed in config.seeds}
    runs = {cell.name: cell.arguments(config, checkpoints[cell.seed]) for cell in cells}
    _run_all(root, runs, config.jobs, "cells", console)
    result = compare(
        config, {s: _summary(root / f"start-seed{s}") for s in config.seeds},
        [(cell, _summary(root / cell.name)) for cell in cells],
    )  # fmt: skip
    (root / "lag.json").write_text(json.dumps(result, indent=2) + "\n")
    (root / "lag.md").write_text(markdown(result))
    draw(root / "lag.png", result)
    console.say(f"wrote {root}/lag.json, lag.md and lag.png")
    return result


def compare(
    config: BenchLagConfig, starts: dict[int, dict[str, Any]], runs: Sequence[tuple[Cell, dict[str, Any]]]
) -> dict[str, Any]:
    """The study's numbers from the summaries of its runs; see `bench_lag`."""
    cells = [
        asdict(cell)
        | {"success": s["success_after"], "n": s["n_after"]}
        | {k: s[k] for k in ("env_steps", "decisions", "updates", "lag_mean", "lag_max", "rl_s")}
        for cell, s in runs
    ]
    groups = []
    for algorithm in config.algorithms:
        for lag in config.lags:
            of = [c for c in cells if (c["algorithm"], c["lag"]) == (algorithm, lag)]
            groups.append(
                {
                    "algorithm": algorithm,
                    "lag": lag,
                    "successes": sum(round(c["success"] * c["n"]) for c in of),
                    "n": sum(c["n"] for c in of),
                    "by_seed": [c["success"] for c in of],
                    "env_steps": sum(c["env_steps"] for c in of) / len(of),
                    "lag_mean": sum(c["lag_mean"] for c in of) / len(of),
                }
            )
    return {
        "config": asdict(config),
        "starts": {str(seed): s["success_after"] for seed, s in starts.items()},
        "groups": groups,
        "cells": cells,
    }


def table(result: dict[str, Any]) -> Table:
    """`result` for people: one row per algorithm, one column per lag."""
    starts = ", ".join(f"{s:.0%}" for s in result["starts"].values())
    shown = Table(title=f"success after training at forced lag; before it {starts}")
    for column in _columns(result):
        shown.add_column(column)
    for row in _rows(result):
        shown.add_row(*row)
    return shown


def markdown(result: dict[str, Any]) -> str:
    """`table` for the docs."""
    columns = _columns(result)
    lines = [columns, ["---"] * len(columns), *_rows(result)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def draw(path: Path, result: dict[str, Any]) -> None:
    """Success over lag: one line per algorithm with its 95 % Wilson interval, one dot per seed."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    lags, names = result["config"]["lags"], result["config"]["algorithms"]
    figure, axes = plt.subplots(figsize=(7, 4), dpi=120)
    for i, name in enumerate(names):
        groups = [g for g in result["groups"] if g["algorithm"] == name]
        rates = [Rate(successes=g["successes"], n=g["n"]) for g in groups]
        x = [place + 0.08 * (i - (len(names) - 1) / 2) for place in range(len(lags))]
        y = [r.value for r in rates]
        low = [max(0.0, r.value - r.interval().low) for r in rates]
        high = [max(0.0, r.interval().high - r.value) for r in rates]
        axes.errorbar(x, y, yerr=[low, high], marker="o", capsize=3, color=f"C{i}", label=name)
        for place, group in zip(x, groups, strict=True):
            seeds = group["by_seed"]
            axes.scatter([place] * len(seeds), seeds, s=12, color=f"C{i}", alpha=0.4, linewidths=0)
    start = sum(result["starts"].values()) / len(result["starts"])
    axes.axhline(start, color="0.6", ls="--", lw=1, label="before")
    axes.set_xticks(range(len(lags)), [str(lag) for lag in lags])
    axes.set(xlabel="weights held back, in updates", ylabel="success", ylim=(-0.02, 1.02))
    axes.grid(alpha=0.3)
    axes.legend(loc="lower left")
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def _columns(result: dict[str, Any]) -> list[str]:
    of = result["config"]["algorithms"][0]
    lags = [(g["lag"], g["lag_mean"]) for g in result["groups"] if g["algorithm"] == of]
    return ["algorithm", *(f"held back {lag} (lag {mean:.0f})" for lag, mean in lags)]


def _rows(result: dict[str, Any]) -> list[list[str]]:
    rows = []
    for name in result["config"]["algorithms"]:
        row = [name]
        for g in (g for g in result["groups"] if g["algorithm"] == name):
            seeds = " ".join(f"{100 * s:.0f}" for s in g["by_seed"])
            row.append(f"{Rate(successes=g['successes'], n=g['n'])} ({seeds})")
        rows.append(row)
    return rows


def _common(config: BenchLagConfig, seed: int) -> list[str]:
    return [
        f"--config_path={config.recipe}",
        f"--seed={seed}",
        "--launch.engine=local",
        "--evaluation.before=false",
        f"--evaluation.episodes={config.episodes}",
        "--evaluation.every_updates=0",
        "--evaluation.videos=0",
    ]


def _run_all(root: Path, runs: dict[str, list[str]], jobs: int, name: str, console: Console) -> None:
    """Runs ``accerl train`` for each folder that has no summary yet, `jobs` at a time."""
    missing = {folder: a for folder, a in runs.items() if not (root / folder / SUMMARY).is_file()}
    for folder in runs:
        if folder not in missing:
            _check_same(root / folder, runs[folder])
    with console.stage(name, total=len(runs)) as stage, ThreadPoolExecutor(jobs) as pool:
        done = len(runs) - len(missing)
        stage.update(done)
        under_way = [pool.submit(_run, root, folder, arguments) for folder, arguments in missing.items()]
        try:
            for future in as_completed(under_way):
                future.result()
                done += 1
                stage.update(done)
        except BaseException:
            for future in under_way:
                future.cancel()
            raise


def _run(root: Path, folder: str, arguments: list[str]) -> None:
    directory, log = root / folder, root / f"{folder}.log"
    if directory.exists():  # a run that was stopped on its way
        shutil.rmtree(directory)
    command = [sys.executable, "-m", "accerl_lerobot.cli", "train", *arguments, f"--output_dir={directory}"]
    threads = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
    with log.open("w") as out:
        ended = subprocess.run(command, stdout=out, stderr=out, env=os.environ | threads, check=False)
    if ended.returncode:
        tail = "\n".join(log.read_text().splitlines()[-LOG_LINES:])
        raise RuntimeError(f"the run {folder} failed, see {log}:\n{tail}")


def _check_same(directory: Path, arguments: list[str]) -> None:
    """Refuses to count a finished run of other settings."""
    then = parse(RunConfig, [f"--config_path={directory / CONFIG}"])
    now = parse(RunConfig, [*arguments, f"--output_dir={then.output_dir}"])
    if then != now:
        remedy = f"{directory.name} in it was run with other settings; choose another folder or remove it"
        raise InputError("bench.output_dir", str(directory.parent), remedy)


def _summary(directory: Path) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads((directory / SUMMARY).read_text())
    return summary


def _checkpoint(start: Path, given: str | None) -> Path:
    """Where a seed's cells begin."""
    return start / "checkpoints" / "last" / PRETRAINED if given is None else Path(given)
