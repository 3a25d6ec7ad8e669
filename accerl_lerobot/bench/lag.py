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

import fcntl
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml
from rich.table import Table

from accerl_lerobot.checkpoint import PRETRAINED
from accerl_lerobot.config import RunConfig, encode, parse
from accerl_lerobot.console import Console
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation.stats import Rate

CONFIG, SUMMARY, LOCK = "config.yaml", "summary.json", ".lock"
LOG_LINES = 12
"""Of a run that failed, shown in the error."""


@dataclass(frozen=True, kw_only=True)
class BenchLagConfig:
    """What is compared."""

    recipe: str = "recipes/quickstart.yaml"
    """The run that every cell is a variation of; read once, when the study starts."""
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
                raise InputError(name, values, "name at least one, none of them twice")
        for name in ("episodes", "jobs"):
            if getattr(self, name) < 1:
                raise InputError(name, getattr(self, name), "use at least 1")


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


class Study:
    """The runs of a study, all of them settled before the first one starts.

    Raises:
        InputError: the recipe, or a cell's settings, are wrong.
    """

    def __init__(self, config: BenchLagConfig) -> None:
        self.config, self.root = config, Path(config.output_dir).expanduser().resolve()
        # Seeds outermost: a study that is stopped has compared everything on the first ones.
        self.cells = [
            Cell(algorithm=algorithm, lag=lag, seed=seed)
            for seed in config.seeds
            for lag in config.lags
            for algorithm in config.algorithms
        ]
        self.starts = {
            seed: self._parse(seed, ["--trainer.updates=0"], self.start(seed)) for seed in config.seeds
        }
        self.runs = {cell: self._of(cell) for cell in self.cells}

    def start(self, seed: int) -> Path:
        """The folder of a seed's warm start."""
        return self.root / f"start-seed{seed}"

    def folder(self, cell: Cell) -> Path:
        """The folder of a cell's run."""
        return self.root / cell.name

    def _of(self, cell: Cell) -> RunConfig:
        chosen = [f"--algorithm.type={cell.algorithm}", f"--trainer.hold_back={cell.lag}"]
        if self.config.updates is not None:
            chosen.append(f"--trainer.updates={self.config.updates}")
        if self.starts[cell.seed].policy.path is None:
            checkpoint = self.start(cell.seed) / "checkpoints" / "last" / PRETRAINED
            chosen += ["--sft.steps=0", f"--policy.path={checkpoint}"]
        return self._parse(cell.seed, chosen, self.folder(cell))

    def _parse(self, seed: int, chosen: list[str], folder: Path) -> RunConfig:
        config: RunConfig = parse(
            RunConfig,
            [
                f"--config_path={self.config.recipe}",
                f"--seed={seed}",
                "--launch.engine=local",
                "--trainer.num_threads=1",
                "--sft.num_threads=1",
                "--evaluation.before=false",
                f"--evaluation.episodes={self.config.episodes}",
                "--evaluation.every_updates=0",
                "--evaluation.videos=0",
                f"--output_dir={folder}",
                *chosen,
            ],
        )
        return config


def bench_lag(config: BenchLagConfig) -> dict[str, Any]:
    """Runs the cells that are missing, and compares all of them.

    Returns:
        ``starts`` (success of each seed's warm start), ``cells`` (success, n, env steps and measured lag of
        each run) and ``groups``: algorithm, lag, successes and episodes over the seeds.

    Raises:
        InputError: the settings of a cell are wrong, which is found before the first run as far as a run
            itself finds it before it begins; the folder holds runs of other settings, or is in use.
        RuntimeError: a run failed; those that were under way have ended, and what is finished is kept.
    """
    from accerl_lerobot.preflight import check_start

    study = Study(config)
    for start in study.starts.values():
        check_start(start)
    console = Console()
    with _locked(study.root) as lock:
        runner = _Runner(config.jobs, lock, console)
        runner.run("warm starts", {study.start(seed): start for seed, start in study.starts.items()})
        for cell in study.cells:
            _check_newer(study.folder(cell), study.start(cell.seed))
        runner.run("cells", {study.folder(cell): run for cell, run in study.runs.items()})
    result = compare(
        config,
        {seed: _summary(study.start(seed)) for seed in config.seeds},
        [(cell, _summary(study.folder(cell))) for cell in study.cells],
    )
    (study.root / "lag.json").write_text(json.dumps(result, indent=2) + "\n")
    (study.root / "lag.md").write_text(markdown(result))
    draw(study.root / "lag.png", result)
    console.say(f"wrote lag.json, lag.md and lag.png into {study.root}")
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
            seeds = " ".join(f"{100 * s:.0f}" for s in g["by_seed"])
            row.append(f"{Rate(successes=g['successes'], n=g['n'])} ({seeds})")
        rows.append(row)
    return rows


@contextmanager
def _locked(root: Path) -> Iterator[int]:
    """Creates the study's folder and keeps others out, for as long as one of its runs is alive."""
    root.mkdir(parents=True, exist_ok=True)
    with (root / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            remedy = "a study, or a run of one that was killed, still writes there; wait for it or end it"
            raise InputError("output_dir", str(root), remedy) from error
        yield file.fileno()


class _Runner:
    """Runs ``accerl train`` in processes of their own.

    Args:
        jobs: how many at a time.
        lock: a file descriptor that they inherit.
        console: progress for people.
    """

    def __init__(self, jobs: int, lock: int, console: Console) -> None:
        self._jobs, self._lock, self._console = jobs, lock, console
        self._processes: set[subprocess.Popen[bytes]] = set()
        self._stopped = False

    def run(self, name: str, runs: dict[Path, RunConfig]) -> None:
        """Does those that have no summary yet."""
        missing = {folder: config for folder, config in runs.items() if not (folder / SUMMARY).is_file()}
        for folder, config in runs.items():
            if folder not in missing:
                _check_same(folder, config)
        done = len(runs) - len(missing)
        with self._console.stage(name, total=len(runs)) as stage, ThreadPoolExecutor(self._jobs) as pool:
            stage.update(done)
            under_way = [pool.submit(self._one, folder, config) for folder, config in missing.items()]
            try:
                for future in as_completed(under_way):
                    future.result()
                    done += 1
                    stage.update(done)
            except BaseException as error:
                for future in under_way:
                    future.cancel()
                if not isinstance(error, Exception):  # asked to stop: nothing must train on alone
                    self._stopped = True
                    for process in list(self._processes):
                        process.terminate()
                raise

    def _one(self, folder: Path, config: RunConfig) -> None:
        if folder.exists():  # a run that was stopped on its way
            shutil.rmtree(folder)
        recipe, log = folder.with_suffix(".yaml"), folder.with_suffix(".log")
        recipe.write_text(yaml.safe_dump(encode(config), sort_keys=False))
        command = [sys.executable, "-m", "accerl_lerobot.cli", "train", f"--config_path={recipe}"]
        threads = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
        with log.open("wb") as out:
            process = subprocess.Popen(
                command, stdout=out, stderr=out, env=os.environ | threads, pass_fds=(self._lock,)
            )
        self._processes.add(process)
        if self._stopped:
            process.terminate()
        code = process.wait()
        self._processes.discard(process)
        if code:
            tail = "\n".join(log.read_text().splitlines()[-LOG_LINES:])
            raise RuntimeError(f"the run {folder.name} failed, see {log}:\n{tail}")


def _check_same(folder: Path, config: RunConfig) -> None:
    """Refuses to count a finished run of other settings."""
    if parse(RunConfig, [f"--config_path={folder / CONFIG}"]) != config:
        remedy = f"{folder.name} in it was run with other settings; choose another folder or remove it"
        raise InputError("output_dir", str(folder.parent), remedy)


def _check_newer(folder: Path, start: Path) -> None:
    """Refuses to count a run from a warm start that has been replaced."""
    summary = folder / SUMMARY
    if summary.is_file() and summary.stat().st_mtime < (start / SUMMARY).stat().st_mtime:
        remedy = f"{folder.name} in it is older than {start.name}, where it would have begun; remove it"
        raise InputError("output_dir", str(folder.parent), remedy)


def _summary(folder: Path) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads((folder / SUMMARY).read_text())
    return summary
