# SPDX-License-Identifier: Apache-2.0
"""Runs of one recipe, to be compared: arms and settings from the same SFT policies, over several seeds.

    python -m benchmarks study --recipe=recipes/gipo.yaml --updates=200 \\
      --arms='[--algorithm.type=gipo, --algorithm.type=ppo]' \\
      --settings='[--trainer.hold_back=0, --trainer.hold_back=16]'

Runs are in the single-process engine, each on one thread, where lag is what settings make it and not what
else the machine is doing. Finished runs are kept: the same command continues a study that was stopped, and
adds seeds, arms or settings to one that is finished. Another recipe, `updates` or `episodes` needs another
folder.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import yaml
from rich.table import Table

from accerl_lerobot.checkpoint.layout import CHECKPOINTS, CONFIG, DEMOS, LAST, PRETRAINED, SUMMARY
from accerl_lerobot.config.ranges import Range, Section, Seed, Steps
from accerl_lerobot.console import Console
from accerl_lerobot.demos.record import REPO_ID
from accerl_lerobot.engines.config import RunConfig, encode, parse
from accerl_lerobot.evaluation import Rate, drawing
from benchmarks.tables import as_markdown, as_table, last_words, mean_interval, named, output_folder, write

NOTE = "intervals are 95 %, over policies where there are several"
NUMBERS = ("episodes_explored", "env_steps", "updates", "lag_mean", "rl_s")
"""Fields of a run's summary that a study keeps."""
ALL = "all starts"


@dataclass(frozen=True, kw_only=True)
class BenchStudyConfig(Section):
    """Fields of ``python -m benchmarks study``. An arm, setting or start is options, separated by spaces."""

    recipe: str = "recipes/gipo.yaml"
    """The run that every cell is a variation of."""
    output_dir: str = "outputs/study"
    """Folder of the runs and of study.json, .md and .png; finished runs in it are kept."""
    starts: tuple[str, ...] = ("",)
    """Options of demonstrations and SFT, such as a task; each has an SFT policy of its own for each seed."""
    arms: tuple[str, ...] = ("",)
    """Options that are compared: rows of the table, lines of the picture."""
    settings: tuple[str, ...] = ("",)
    """Options that every arm is tried with: columns of the table, places of the picture."""
    seeds: tuple[Seed, ...] = (0, 1, 2)
    """Each with demonstrations, an SFT policy and evaluation starts of its own."""
    updates: Steps | None = None
    """Updates of each cell; None: the recipe's."""
    episodes: Annotated[int, Range("[1, 1000000]")] = 100
    """Episodes of the evaluation after each cell."""
    jobs: Annotated[int, Range("[1, 1024]")] = 2
    """Cells that run at the same time, each on one thread."""

    def __post_init__(self) -> None:
        super().__post_init__()
        named(self, "starts", "arms", "settings", "seeds")


class Cell(NamedTuple):
    """One run of a study, in the order in which they are made."""

    start: str
    seed: int
    setting: str
    arm: str

    @property
    def folder(self) -> str:
        return _folder(self.start, self.arm, self.setting, f"seed{self.seed}")

    @property
    def start_folder(self) -> str:
        """Folder of the run that makes its SFT policy."""
        return _folder("start", self.start, f"seed{self.seed}")


def _folder(*parts: str) -> str:
    words = "-".join(part.replace("--", "") for part in parts if part)
    return re.sub(r"[^\w.=-]+", "_", words)


def bench_study(config: BenchStudyConfig) -> dict[str, Any]:
    """Runs what is missing, and compares all of it.

    Returns:
        ``config``, ``cells`` (one per run) and ``groups`` (one per start, arm and setting, see `together`).
    """
    from accerl_lerobot.run.preflight import check_start

    console = Console()
    root = output_folder(config.output_dir).resolve()
    choices = itertools.product(config.starts, config.seeds, config.settings, config.arms)
    cells = [Cell(*choice) for choice in choices]
    starts = {}
    runs = {}
    for cell in cells:
        made = root / cell.start_folder
        if made not in starts:
            starts[made] = _start(config, cell, made)
        runs[root / cell.folder] = _run(config, cell, starts[made], made, root / cell.folder)
    for folder, start in starts.items():
        check_start(replace(start, resume=folder.exists()))  # a run that is there is resumed
    _do("SFT policies", starts, config.jobs, console)
    _do("cells", runs, config.jobs, console)
    rows = [_row(root, cell) for cell in cells]
    result = {"config": asdict(config), "cells": rows, "groups": groups(config, rows)}
    write(root, "study", result, markdown(result), draw)
    console.say(f"wrote study.json, .md and .png into {root}")
    return result


def _start(config: BenchStudyConfig, cell: Cell, folder: Path) -> RunConfig:
    """The run that makes an SFT policy; it pins the revision of a policy that is given."""
    from accerl_lerobot.policies.loading import pinned

    options = ["--trainer.updates=0", "--imagination.environments=0"]
    run = _parsed(config, cell, folder, options)
    return run if run.policy.path is None else replace(run, policy=pinned(run.policy))


def _run(config: BenchStudyConfig, cell: Cell, start: RunConfig, made: Path, folder: Path) -> RunConfig:
    """A cell's run; `made` is the folder of the run that makes its SFT policy."""
    options = [*shlex.split(cell.setting), *shlex.split(cell.arm)]
    if config.updates is not None:
        options.append(f"--trainer.updates={config.updates}")
    if start.policy.revision is not None:
        options.append(f"--policy.revision={start.policy.revision}")
    if start.policy.path is None:
        checkpoint = made / CHECKPOINTS / LAST / PRETRAINED
        options += ["--sft.steps=0", f"--policy.path={checkpoint}"]
        if start.dataset.repo_id is None:
            options += [f"--dataset.repo_id={REPO_ID}", f"--dataset.root={made / DEMOS}"]
    return _parsed(config, cell, folder, options)


def _parsed(config: BenchStudyConfig, cell: Cell, folder: Path, options: list[str]) -> RunConfig:
    fixed = [
        f"--config_path={config.recipe}",
        f"--seed={cell.seed}",
        "--launch.engine=local",
        "--trainer.num_threads=1",
        "--sft.num_threads=1",
        "--evaluation.before=false",
        f"--evaluation.episodes={config.episodes}",
        "--evaluation.every_updates=0",
        "--evaluation.videos=0",
        f"--output_dir={folder}",
    ]
    run: RunConfig = parse(RunConfig, [*fixed, *shlex.split(cell.start), *options])
    return run


def _do(name: str, runs: dict[Path, RunConfig], jobs: int, console: Console) -> None:
    """Does the runs that have no summary yet, some at a time."""
    missing = [(folder, run) for folder, run in runs.items() if not (folder / SUMMARY).is_file()]
    done = len(runs) - len(missing)
    with console.stage(name, total=len(runs)) as stage, ThreadPoolExecutor(jobs) as pool:
        stage.update(done)
        for _ in pool.map(lambda run: train(*run), missing):
            done += 1
            stage.update(done)


def train(folder: Path, config: RunConfig) -> None:
    """Runs ``accerl train``; resumes a run that was stopped."""
    command = [sys.executable, "-m", "accerl_lerobot.cli", "train"]
    if (folder / CHECKPOINTS).is_dir():
        command += ["--resume=true", f"--config_path={folder / CONFIG}"]
    else:
        shutil.rmtree(folder, ignore_errors=True)
        recipe = folder.with_name(f"{folder.name}.yaml")
        recipe.write_text(yaml.safe_dump(encode(config), sort_keys=False))
        command.append(f"--config_path={recipe}")
    log = folder.with_name(f"{folder.name}.log")
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
    with log.open("ab") as out:
        done = subprocess.run(command, stdout=out, stderr=out, env=environment, check=False)
    if done.returncode:
        raise RuntimeError(f"the run {folder.name} failed, see {log}:\n{last_words(log)}")


def _row(root: Path, cell: Cell) -> dict[str, Any]:
    before = json.loads((root / cell.start_folder / SUMMARY).read_text())
    after = json.loads((root / cell.folder / SUMMARY).read_text())
    success = {"sft": before["success_after"], "success": after["success_after"], "n": after["n_after"]}
    return cell._asdict() | success | {name: after[name] for name in NUMBERS}


def groups(config: BenchStudyConfig, rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Comparisons of the cells of each start, arm and setting, and of all starts if there are several."""
    found = []
    starts = [*config.starts, ALL] if len(config.starts) > 1 else config.starts
    for start, arm, setting in itertools.product(starts, config.arms, config.settings):
        of = [row for row in rows if (row["arm"], row["setting"]) == (arm, setting)]
        if start != ALL:
            of = [row for row in of if row["start"] == start]
        means = {name: sum(row[name] for row in of) / len(of) for name in ("sft", *NUMBERS)}
        found.append({"start": start, "arm": arm, "setting": setting, **together(of), **means})
    return found


def together(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Successes and episodes of some runs.

    Returns:
        ``successes`` and ``n`` of all, ``by_policy``, the success of each, and ``ci95`` of their mean. That
        is `mean_interval` over policies, where there are several, and never narrower than if one policy had
        played all episodes: policies may be equal by chance.
    """
    successes = sum(round(row["success"] * row["n"]) for row in rows)
    rate = Rate(successes=successes, n=sum(row["n"] for row in rows))
    by_policy = [row["success"] for row in rows]
    intervals = [rate.interval()]
    if len(rows) > 1:
        intervals.append(mean_interval(by_policy))
    low = max(0.0, min(interval.low for interval in intervals))
    high = min(1.0, max(interval.high for interval in intervals))
    return {"successes": rate.successes, "n": rate.n, "by_policy": by_policy, "ci95": [low, high]}


def table(result: dict[str, Any]) -> Table:
    """`result` for people: a row per start and arm, a column per setting."""
    return as_table(f"success; {NOTE}", _columns(result), _rows(result))


def markdown(result: dict[str, Any]) -> str:
    """`table` for the docs."""
    return as_markdown(_columns(result), _rows(result)) + f"\n{NOTE.capitalize()}.\n"


def _columns(result: dict[str, Any]) -> list[str]:
    return ["start", "arm", "SFT", *(setting or "success" for setting in result["config"]["settings"])]


def _rows(result: dict[str, Any]) -> list[list[str]]:
    rows: dict[tuple[str, str], list[str]] = {}
    for group in result["groups"]:
        key = (group["start"], group["arm"])
        row = rows.setdefault(key, [*key, f"{group['sft']:.0%}"])
        row.append(_rated(group))
    return list(rows.values())


def _rated(group: dict[str, Any]) -> str:
    """Rate, interval, n and each policy's success, and its real episodes and lag."""
    policies = " ".join(f"{100 * success:.0f}" for success in group["by_policy"])
    low, high = (100 * end for end in group["ci95"])
    rate = 100 * group["successes"] / group["n"]
    practice = f"{group['episodes_explored']:,.0f} episodes, lag {group['lag_mean']:.1f}"
    return f"{rate:.1f} % [{low:.1f}, {high:.1f}] n={group['n']} ({policies}), {practice}"


def draw(path: Path, result: dict[str, Any]) -> None:
    """Success over starts and settings: one line per arm with its interval, one dot per policy."""
    config = result["config"]
    places = list(itertools.product(config["starts"], config["settings"]))
    with drawing(path) as axes:
        for number, arm in enumerate(config["arms"]):
            shift = 0.08 * (number - (len(config["arms"]) - 1) / 2)
            for group in result["groups"]:
                if group["arm"] != arm or group["start"] == ALL:
                    continue
                place = places.index((group["start"], group["setting"])) + shift
                rate = group["successes"] / group["n"]
                error = [[max(0.0, rate - group["ci95"][0])], [max(0.0, group["ci95"][1] - rate)]]
                axes.errorbar(place, rate, yerr=error, marker="o", capsize=3, color=f"C{number}")
                dots = {"s": 12, "alpha": 0.4, "color": f"C{number}", "linewidths": 0}
                axes.scatter([place] * len(group["by_policy"]), group["by_policy"], **dots)
            axes.plot([], [], marker="o", color=f"C{number}", label=arm or "success")
        axes.set_xticks(range(len(places)), [" ".join(place) for place in places], rotation=20, ha="right")
        axes.set(ylabel="success", ylim=(-0.02, 1.02))
        axes.legend()
