# SPDX-License-Identifier: Apache-2.0
"""Many runs of one recipe, to be compared: every seed is warm-started once, and each cell begins there.

Runs are in the single-process engine, each on one thread, where lag is what settings make it and not what
else the machine is doing. Finished runs are kept: the same command continues a study that was stopped. Other
settings need another folder.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import yaml
from rich.table import Table

from accerl_lerobot.checkpoint.layout import CHECKPOINTS, CONFIG, DEMOS, LAST, PRETRAINED, SUMMARY
from accerl_lerobot.config.ranges import Range, Section, Seed, Steps
from accerl_lerobot.console import Console
from accerl_lerobot.demos.record import REPO_ID
from accerl_lerobot.engines.config import RunConfig, encode, parse
from accerl_lerobot.errors import InputError, expanded
from accerl_lerobot.evaluation import Rate, drawing
from benchmarks.records import mean_interval
from benchmarks.tables import as_table

INTERVALS = "intervals are 95 %, over seeds where there are several"
"""For people, see `together`."""
LOG_LINES = 12
"""Log lines of a failed run that its error shows."""


@dataclass(frozen=True, kw_only=True)
class StudyConfig(Section):
    """Fields that all studies have."""

    recipe: str = "recipes/gipo.yaml"
    """The run that every cell is a variation of; read once, when the study starts."""
    output_dir: str = "outputs/study"
    """Folder of the runs and of what they say together; finished runs in it are kept."""
    seeds: tuple[Seed, ...] = (0, 1, 2)
    """Each a warm start of its own."""
    updates: Steps | None = None
    """Updates of each cell; None: the recipe's."""
    episodes: Annotated[int, Range("[1, 1000000]")] = 100
    """Episodes of the evaluation after each cell."""
    jobs: Annotated[int, Range("[1, 1024]")] = 2
    """Cells that run at the same time, each on one thread."""

    def __post_init__(self) -> None:
        super().__post_init__()
        named(self, "seeds")


def named(config: Any, name: str) -> None:
    """Refuses a list that is empty, or names something twice."""
    values = getattr(config, name)
    if not values or len(set(values)) < len(values):
        raise InputError(name, values, "name at least one, none of them twice")


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One run of a study."""

    name: str
    """Name of its folder."""
    seed: int
    of: dict[str, Any]
    """Values that distinguish it from the others of its seed, for people."""
    chosen: tuple[str, ...]
    """Arguments that it adds to the command line."""


class Results(NamedTuple):
    """Summaries of the runs of a study."""

    starts: dict[int, dict[str, Any]]
    """Summary of each seed's warm start."""
    cells: list[tuple[Cell, dict[str, Any]]]
    """Each with its summary."""

    @property
    def before(self) -> dict[str, float]:
        """Success of each seed's warm start."""
        return {str(seed): summary["success_after"] for seed, summary in self.starts.items()}

    def table(self, shown: Sequence[str]) -> list[dict[str, Any]]:
        """Table of the cells: their values, seed, success and n, and these fields of the summary."""
        return [
            cell.of
            | {"seed": cell.seed, "success": summary["success_after"], "n": summary["n_after"]}
            | {key: summary[key] for key in shown}
            for cell, summary in self.cells
        ]


def pooled(rows: Sequence[dict[str, Any]]) -> Rate:
    """All episodes of some rows of `Results.table`, as if one policy had played them."""
    successes = sum(round(row["success"] * row["n"]) for row in rows)
    return Rate(successes=successes, n=sum(row["n"] for row in rows))


def together(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Successes and episodes of some rows of `Results.table`, one per seed.

    Returns:
        ``successes`` and ``n`` of all, ``by_seed``, the success of each, and ``ci95`` of their mean. That is
        `mean_interval` over seeds, where there are several, and never narrower than if one policy had played
        all episodes: seeds may be alike by chance.
    """
    rate, by_seed = pooled(rows), [row["success"] for row in rows]
    of = [rate.interval()] + ([mean_interval(by_seed)] if len(rows) > 1 else [])
    ci95 = (max(0.0, min(i.low for i in of)), min(1.0, max(i.high for i in of)))
    return {"successes": rate.successes, "n": rate.n, "by_seed": by_seed, "ci95": ci95}


def rated(group: dict[str, Any]) -> str:
    """Rate, interval and n of what `together` gives, and each seed's success."""
    seeds = " ".join(f"{100 * s:.0f}" for s in group["by_seed"])
    low, high = (100 * end for end in group["ci95"])
    rate = 100 * group["successes"] / group["n"]
    return f"{rate:.1f} % [{low:.1f}, {high:.1f}] n={group['n']} ({seeds})"


def tabled(
    title: str, result: dict[str, Any], columns: Sequence[str], rows: Sequence[Sequence[str]]
) -> Table:
    """Rows for people; the title ends with the success of each warm start, and what intervals are."""
    starts = ", ".join(f"{s:.0%}" for s in result["starts"].values())
    return as_table(f"{title} {starts}; {INTERVALS}", columns, rows)


def draw_lines(
    path: Path,
    result: dict[str, Any],
    key: str,
    names: Sequence[str],
    places: Callable[[float], list[float]],
    dress: Callable[[Any], object],
) -> None:
    """Success, one line per name with its 95 % interval, one dot per seed.

    `places` gives x of a line that lies so many lines from the middle one; `dress` labels the axes.
    """
    with drawing(path) as axes:
        for i, name in enumerate(names):
            groups = [g for g in result["groups"] if g[key] == name]
            x = places(i - (len(names) - 1) / 2)
            y = [g["successes"] / g["n"] for g in groups]
            low = [max(0.0, rate - g["ci95"][0]) for rate, g in zip(y, groups, strict=True)]
            high = [max(0.0, g["ci95"][1] - rate) for rate, g in zip(y, groups, strict=True)]
            axes.errorbar(x, y, yerr=[low, high], marker="o", capsize=3, color=f"C{i}", label=name)
            for place, group in zip(x, groups, strict=True):
                seeds = group["by_seed"]
                axes.scatter([place] * len(seeds), seeds, s=12, color=f"C{i}", alpha=0.4, linewidths=0)
        start = sum(result["starts"].values()) / len(result["starts"])
        axes.axhline(start, color="0.6", ls="--", lw=1, label="before")
        axes.set(ylabel="success", ylim=(-0.02, 1.02))
        dress(axes)


class Study:
    """The runs of a study, all of them settled before the first one starts."""

    def __init__(self, config: StudyConfig, cells: Sequence[Cell], common: Sequence[str] = ()) -> None:
        self.config, self.root = config, expanded(config.output_dir, "output_dir").resolve()
        self.common = list(common)
        self.cells = list(cells)
        policy = self._parse(config.seeds[0], [], self.root).policy
        if policy.path is not None:
            from accerl_lerobot.policies.loading import pinned

            if revision := pinned(policy).revision:
                self.common.append(f"--policy.revision={revision}")
        self.starts = {
            seed: self._parse(seed, ["--trainer.updates=0", "--imagination.environments=0"], self.start(seed))
            for seed in config.seeds
        }
        self.runs = [self._of(cell) for cell in self.cells]

    def start(self, seed: int) -> Path:
        """The folder of a seed's warm start."""
        return self.root / f"start-seed{seed}"

    def folder(self, cell: Cell) -> Path:
        """The folder of a cell's run."""
        return self.root / cell.name

    def run(self, console: Console) -> Results:
        """Does the runs that are missing."""
        from accerl_lerobot.run.preflight import check_start

        for seed, start in self.starts.items():
            check_start(replace(start, resume=self.start(seed).exists()))  # a run that is there is resumed
        self._do("warm starts", {self.start(seed): start for seed, start in self.starts.items()}, console)
        folders = [self.folder(cell) for cell in self.cells]
        self._do("cells", dict(zip(folders, self.runs, strict=True)), console)
        return Results(
            {seed: _summary(self.start(seed)) for seed in self.config.seeds},
            [(cell, _summary(folder)) for cell, folder in zip(self.cells, folders, strict=True)],
        )

    def _do(self, name: str, runs: dict[Path, RunConfig], console: Console) -> None:
        """Does the runs that have no summary yet, some at a time."""
        missing = [(folder, run) for folder, run in runs.items() if not (folder / SUMMARY).is_file()]
        with console.stage(name, total=len(runs)) as stage, ThreadPoolExecutor(self.config.jobs) as pool:
            done = len(runs) - len(missing)
            stage.update(done)
            for _ in pool.map(lambda run: _train(*run), missing):
                done += 1
                stage.update(done)

    def _of(self, cell: Cell) -> RunConfig:
        chosen = list(cell.chosen)
        if self.config.updates is not None:
            chosen.append(f"--trainer.updates={self.config.updates}")
        if self.starts[cell.seed].policy.path is None:
            checkpoint = self.start(cell.seed) / CHECKPOINTS / LAST / PRETRAINED
            chosen += ["--sft.steps=0", f"--policy.path={checkpoint}"]
            if self.starts[cell.seed].dataset.repo_id is None:
                root = self.start(cell.seed) / DEMOS
                chosen += [f"--dataset.repo_id={REPO_ID}", f"--dataset.root={root}"]
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
                *self.common,
                *chosen,
            ],
        )
        return config


def _train(folder: Path, config: RunConfig) -> None:
    """Runs ``accerl train``; resumes a run that was stopped."""
    command = [sys.executable, "-m", "accerl_lerobot.cli", "train"]
    if (folder / CHECKPOINTS).is_dir():
        command += ["--resume=true", f"--config_path={folder / CONFIG}"]
    else:
        shutil.rmtree(folder, ignore_errors=True)
        recipe = folder.with_suffix(".yaml")
        recipe.parent.mkdir(parents=True, exist_ok=True)
        recipe.write_text(yaml.safe_dump(encode(config), sort_keys=False))
        command.append(f"--config_path={recipe}")
    log = folder.with_suffix(".log")
    with log.open("ab") as out:
        threads = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
        code = subprocess.run(
            command, stdout=out, stderr=out, env=os.environ | threads, check=False
        ).returncode
    if code:
        raise RuntimeError(f"the run {folder.name} failed, see {log}:\n{last_words(log)}")


def last_words(log: Path) -> str:
    """The end of what a run has said."""
    return "\n".join(log.read_text(errors="replace").splitlines()[-LOG_LINES:])


def _summary(folder: Path) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads((folder / SUMMARY).read_text())
    return summary
