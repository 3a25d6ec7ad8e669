# SPDX-License-Identifier: Apache-2.0
"""Runs of one recipe, to be compared: arms and settings from the same SFT policies, over several seeds.

    python -m benchmarks study --recipe=recipes/gipo.yaml --updates=200 \\
      --arms='[--algorithm.type=gipo, --algorithm.type=ppo]' \\
      --settings='[--trainer.hold_back=0, --trainer.hold_back=16]'

Runs are in the single-process engine, each on one thread, where lag is what settings make it and not what
else the machine is doing. Finished runs are kept: the same command continues a study that was stopped, and
adds seeds, arms or settings to one that is finished. Another recipe, `updates` or `episodes` needs another
folder.

``--trainer.hold_back=N``, in an arm or a setting, has the acting policy use weights that are N updates old.
"""

from __future__ import annotations

import functools
import itertools
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple
from unittest.mock import patch

import numpy as np
import yaml
from rich.table import Table

from accerl_lerobot import cli
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import (
    CHECKPOINTS,
    CONFIG,
    DEMOS,
    LAST,
    PRETRAINED,
    SUMMARY,
    TRAINING_STATE,
)
from accerl_lerobot.config.ranges import Range, Section, Seed, Steps
from accerl_lerobot.console import Console
from accerl_lerobot.demos.record import REPO_ID
from accerl_lerobot.engines import Progress, local
from accerl_lerobot.engines.config import RunConfig, encode, parse
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation import Rate
from accerl_lerobot.experience import Decision, Request
from accerl_lerobot.policies.config import Load, loader
from benchmarks.tables import (
    as_markdown,
    as_table,
    drawing,
    last_words,
    mean_interval,
    named,
    output_folder,
    write,
)

NOTE = "intervals are 95 %, over policies where there are several"
NUMBERS = ("episodes_explored", "env_steps", "updates", "lag_mean", "rl_s")
"""Fields of a run's summary that a study keeps."""
ALL = "all starts"
HOLD_BACK = "--trainer.hold_back="


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

    @property
    def options(self) -> list[str]:
        """Options of its setting and arm, `HOLD_BACK` included."""
        return [*shlex.split(self.setting), *shlex.split(self.arm)]

    @property
    def hold_back(self) -> int:
        """Updates by which the weights of its acting policy are held back."""
        updates = [word.removeprefix(HOLD_BACK) for word in self.options if word.startswith(HOLD_BACK)]
        if not updates:
            return 0
        if not updates[-1].isdecimal():
            raise InputError("trainer.hold_back", updates[-1], "use a number of updates, 0 or more")
        return int(updates[-1])


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
    held_back = {}
    for cell in cells:
        made = root / cell.start_folder
        if made not in starts:
            starts[made] = _start(config, cell, made)
        runs[root / cell.folder] = _run(config, cell, starts[made], made, root / cell.folder)
        held_back[root / cell.folder] = cell.hold_back
    for start in starts.values():
        check_start(start)
    _do("SFT policies", starts, {}, config.jobs, console)
    _do("cells", runs, held_back, config.jobs, console)
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
    options = [option for option in cell.options if not option.startswith(HOLD_BACK)]
    if config.updates is not None:
        options.append(f"--trainer.updates={config.updates}")
    if start.policy.revision is not None:
        options.append(f"--policy.revision={start.policy.revision}")
    if start.policy.path is None:
        checkpoint = made / CHECKPOINTS / LAST / PRETRAINED
        options += ["--sft.steps=0", f"--policy.path={checkpoint}"]
        if start.dataset.repo_id is None:
            options += [f"--dataset.repo_id={REPO_ID}", f"--dataset.root={made / DEMOS}"]
    run = _parsed(config, cell, folder, options)
    if cell.hold_back and cell.hold_back >= run.replay.max_lag:
        hint = f"use more than trainer.hold_back, {cell.hold_back}, or all is thrown away as too old"
        raise InputError("replay.max_lag", run.replay.max_lag, hint)
    return run


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


def _do(
    name: str, runs: dict[Path, RunConfig], held_back: Mapping[Path, int], jobs: int, console: Console
) -> None:
    """Does the runs that have no summary yet, some at a time."""
    missing = [
        (folder, run, held_back.get(folder, 0))
        for folder, run in runs.items()
        if not (folder / SUMMARY).is_file()
    ]
    done = len(runs) - len(missing)
    with console.stage(name, total=len(runs)) as stage, ThreadPoolExecutor(jobs) as pool:
        stage.update(done)
        for _ in pool.map(lambda run: train(*run), missing):
            done += 1
            stage.update(done)


def train(folder: Path, config: RunConfig, hold_back: int) -> None:
    """Runs ``accerl train``, with `main` if weights are held back; resumes a run that was stopped."""
    program = ["benchmarks.study", str(hold_back)] if hold_back else ["accerl_lerobot.cli"]
    command = [sys.executable, "-m", *program, "train"]
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


class HeldBackEngine(local.LocalEngine):
    """The engine of one process, whose acting policy has weights that are `hold_back` updates old."""

    state_name = "local_held_back"  # without `main`, a run cannot be resumed, which would lose its lag

    def __init__(
        self,
        hold_back: int,
        config: RunConfig,
        tasks: tuple[str, ...],
        history: int = 1,
        state: Path | None = None,
        load: Load | None = None,
    ) -> None:
        self._hold_back = hold_back
        self._held_back: deque[tuple[int, dict[str, np.ndarray]]] = deque()
        self._acting_version = 0
        super().__init__(config, tasks, history, load=load)
        self._acting = loader(load)(config.policy)
        self._acting.load_trainable(self._adapter.export_trainable())
        if state is not None:
            self._restore(state)

    def poll(self) -> Progress:
        progress = super().poll()
        version = self._update.version
        if progress.updates:
            self._held_back.append((version, self._adapter.export_trainable()))
        due = version - self._hold_back
        if not self._exploring:  # the last weights act at once
            due = version
        while self._held_back and self._held_back[0][0] <= due:
            self._acting_version, weights = self._held_back.popleft()
            self._acting.load_trainable(weights)
        return replace(progress, inference={"version": float(self._acting_version)})

    def save(self, directory: Path) -> Progress:
        saved = super().save(directory)
        acting = {"version": self._acting_version, "weights": self._acting.export_trainable()}
        state = {"acting": acting, "waiting": list(self._held_back)}
        snapshot.save(directory / TRAINING_STATE / "held_back", state)
        return saved

    def _restore(self, directory: Path) -> None:
        state = snapshot.load(directory / "held_back")
        self._acting_version = state["acting"]["version"]
        self._acting.load_trainable(state["acting"]["weights"])
        self._held_back.extend(state["waiting"])
        super()._restore(directory)

    def _decide(self, requests: list[Request]) -> list[Decision]:
        return self._acting.decide(requests, self._acting_version)


def main(hold_back: int, arguments: list[str]) -> int:
    """Runs ``accerl`` with `arguments`, and holds weights back if its engine is that of one process."""
    with patch.object(local, "LocalEngine", functools.partial(HeldBackEngine, hold_back)):
        return cli.main(arguments)


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


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), sys.argv[2:]))
