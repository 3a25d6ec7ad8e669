# SPDX-License-Identifier: Apache-2.0
"""Practice after few-shot imitation: algorithms from one SFT policy, at equal real episodes.

    python -m benchmarks few_shot --tasks=lever-pull-v3,push-v3 --seeds=0 --jobs=2

Writes few_shot.json, few_shot.md and few_shot.png into the output folder. The same command continues a study
that was stopped, and adds tasks, seeds or algorithms to one that is finished.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from accerl_lerobot.config.ranges import Steps
from accerl_lerobot.console import Console
from accerl_lerobot.evaluation import Rate, drawing
from benchmarks.records import as_markdown, mean_interval, output_folder, write
from benchmarks.study import Cell, Study, StudyConfig, named
from benchmarks.tables import as_table

MAX_SLANTED = 12  # with more tasks than this, their names are vertical
COLUMNS = ("task", "seed", "algorithm", "SFT", "after", "real episodes", "env steps")


@dataclass(frozen=True, kw_only=True)
class BenchFewShotConfig(StudyConfig):
    """Fields of the study."""

    recipe: str = "recipes/few_shot.yaml"
    """Demonstrations, SFT and trainer settings of every run."""
    output_dir: str = "outputs/few_shot"
    """One folder per task below it; finished runs are kept."""
    seeds: tuple[int, ...] = (0,)
    """Each with demonstrations, an SFT policy and evaluation starts of its own."""
    tasks: tuple[str, ...] = ("lever-pull-v3",)
    """MetaWorld tasks."""
    algorithms: tuple[str, ...] = ("chunk_critic", "self_imitation")
    """Values of ``algorithm.type``. Empty: SFT only, to choose tasks."""
    explored: Steps = 1500
    """Real exploring episodes of each run."""

    def __post_init__(self) -> None:
        super().__post_init__()
        named(self, "tasks")


def bench_few_shot(config: BenchFewShotConfig) -> dict[str, Any]:
    """Runs what is missing, task by task, and writes all results after each task.

    Returns:
        ``config``, ``rows`` (one per task, seed and algorithm) and ``means`` of each algorithm.
    """
    console, root, rows = Console(), output_folder(config.output_dir).resolve(), []
    for task in config.tasks:
        cells = [
            Cell(
                name=f"{algorithm}-seed{seed}",
                seed=seed,
                of={"task": task, "algorithm": algorithm},
                chosen=(f"--algorithm.type={algorithm}", f"--rollout.episodes={config.explored}"),
            )
            for seed in config.seeds
            for algorithm in config.algorithms
        ]
        study = Study(replace(config, output_dir=str(root / task)), cells, [f"--env.task={task}"])
        results = study.run(console)
        sft = {"task": task, "algorithm": "sft"}
        rows += [_row(sft, seed, start, start) for seed, start in results.starts.items()]
        rows += [_row(c.of, c.seed, results.starts[c.seed], summary) for c, summary in results.cells]
        result = {"config": asdict(config), "rows": rows, "means": means(rows)}
        write(root, "few_shot", result, markdown(result), draw)
        console.say(f"{task}: wrote few_shot.json, few_shot.md and few_shot.png into {root}")
    return result


def means(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Mean success over tasks and seeds by algorithm, with a 95 % t interval over (task, seed) pairs."""
    found: dict[str, dict[str, Any]] = {}
    for name in dict.fromkeys(row["algorithm"] for row in rows):
        success = [row["success"] for row in rows if row["algorithm"] == name]
        found[name] = {"success": sum(success) / len(success), "policies": len(success)}
        if len(success) > 1:
            interval = mean_interval(success)
            found[name]["ci95"] = [interval.low, interval.high]
    return found


def table(result: dict[str, Any]) -> Table:
    """Rows for people."""
    return as_table("practice after few-shot imitation", COLUMNS, _rows(result))


def markdown(result: dict[str, Any]) -> str:
    """A table of all rows but SFT's, which is a column."""
    return as_markdown(COLUMNS, _rows(result))


def _rows(result: dict[str, Any]) -> list[list[str]]:
    rows = []
    for row in result["rows"]:
        if row["algorithm"] != "sft" or not result["config"]["algorithms"]:
            rates = [_rate(row[key], row["n"]) for key in ("sft", "success")]
            counts = [f"{row[key]:,}" for key in ("episodes", "env_steps")]
            rows.append([row["task"], str(row["seed"]), row["algorithm"], *rates, *counts])
    return rows


def draw(path: Path, result: dict[str, Any]) -> None:
    """A group of bars per task, one bar per algorithm, sorted by the last one's success."""
    arms: dict[str, dict[str, list[float]]] = {}
    for row in result["rows"]:
        arms.setdefault(row["algorithm"], {}).setdefault(row["task"], []).append(row["success"])
    success_by_task(path, arms)


def success_by_task(path: Path, arms: Mapping[str, Mapping[str, Sequence[float]]]) -> None:
    """Draws a group of bars per task, one bar per arm, the mean over policies; where several, they are dots.

    `arms` is arm → task → success of each policy; the last arm sorts the tasks.
    """
    last = list(arms.values())[-1]

    def order(task: str) -> tuple[float, str]:
        return float(np.mean(last.get(task, 0.0))), task

    tasks = sorted(set().union(*arms.values()), key=order)
    with drawing(path) as axes:
        for i, (name, success) in enumerate(arms.items()):
            places = [tasks.index(task) + 0.8 * (i + 0.5) / len(arms) - 0.4 for task in success]
            means = [float(np.mean(values)) for values in success.values()]
            axes.bar(places, means, 0.75 / len(arms), color=f"C{i}", label=name)
            for place, values in zip(places, success.values(), strict=True):
                if len(values) > 1:
                    axes.scatter([place] * len(values), values, s=10, color="black", zorder=3)
        labels = [task.removesuffix("-v3") for task in tasks]
        if len(tasks) > MAX_SLANTED:
            axes.set_xticks(range(len(tasks)), labels, rotation=90, fontsize=6)
        else:
            axes.set_xticks(range(len(tasks)), labels, rotation=20, ha="right")
        axes.set(ylabel="success", ylim=(0, 1.02))
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1), ncols=len(arms))


def _row(of: dict[str, Any], seed: int, start: dict[str, Any], summary: dict[str, Any]) -> dict[str, Any]:
    shown = {"sft": start["success_after"], "success": summary["success_after"], "n": summary["n_after"]}
    counts = {"episodes": summary["episodes_explored"], "env_steps": summary["env_steps"]}
    return of | {"seed": seed} | shown | counts | {"rl_s": summary["rl_s"]}


def _rate(success: float, n: int) -> str:
    interval = Rate(successes=round(success * n), n=n).interval()
    return f"{success:.0%} [{interval.low:.0%}, {interval.high:.0%}]"
