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
"""What a run survives: workers killed and stopped while it learns, and what that costs.

    accerl bench faults --repeats=5

A cell is one run in which one kind of process is hit again and again, at random moments, by one signal. Each
hit is proved to have happened; the run has recovered when another process has its place and, but for a
rollout worker, an update has been made that had not been made before. At the end the run is asked to stop,
and its books are looked at: every update logged once, none missing, every segment of replay accounted for.
"""

from __future__ import annotations

import json
import random
import signal
import statistics
import subprocess
import time
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from accerl_lerobot.bench.study import as_markdown, as_table, last_words
from accerl_lerobot.bench.victims import CLASSES, Victim, alive, await_hit, hit
from accerl_lerobot.checkpoint import CHECKPOINTS, LAST, PRETRAINED, newest_whole
from accerl_lerobot.config import RunConfig, parse
from accerl_lerobot.console import Console
from accerl_lerobot.errors import InputError, check_absent

SIGNALS = {"kill": signal.SIGKILL, "stop": signal.SIGSTOP}
"""Fault → what is sent."""
START_S = 300.0
"""How long a run may take to its first update."""
GRACE_S = 60.0
"""How long it may take to stop when it is asked to."""
SPARE = 5
"""Updates beyond the last that was logged before a hit, by which a run has recovered."""
TIDY_S = 10.0
"""How long what it has started may outlive it."""
ENDLESS = 1_000_000


@dataclass(frozen=True, kw_only=True)
class BenchFaultsConfig:
    """What is done, and to whom."""

    recipe: str = "recipes/quickstart.yaml"
    """The run. Its demonstrations and SFT are cut short, unless it has a policy: they do not matter here."""
    output_dir: str = "outputs/faults"
    """Folder of the runs and of faults.json and faults.md; must not exist."""
    targets: tuple[str, ...] = ("rollout", "inference", "replay", "trainer", "driver")
    """Of these, and, where anything is imagined, dream and world learning. The driver is the process of the
    run itself: after its end the run is gone on with by its command line."""
    faults: tuple[str, ...] = ("kill", "stop")
    """kill: SIGKILL. stop: SIGSTOP, so that it hangs; not of the driver, which nobody watches."""
    repeats: int = 5
    """Hits of each cell."""
    stall_s: float = 10.0
    """``launch.stall_s`` of the runs: how long a process that hangs is waited for."""
    seed: int = 0
    """Of the moments, and of which worker is hit."""

    def __post_init__(self) -> None:
        known = {"targets": [*CLASSES, "driver"], "faults": list(SIGNALS)}
        for name, names in known.items():
            given = getattr(self, name)
            if not given or len(set(given)) < len(given) or not set(given) <= set(names):
                raise InputError(name, given, f"use some of {', '.join(names)}, none twice")
        if self.repeats < 1:
            raise InputError("repeats", self.repeats, "use at least 1")
        if not self.stall_s >= 5:
            remedy = "use 5 s or more, or a busy worker is taken for one that hangs"
            raise InputError("stall_s", self.stall_s, remedy)


def bench_faults(config: BenchFaultsConfig) -> dict[str, Any]:
    """Does it all.

    Returns:
        ``cells``, of each ``target``, ``fault``, ``fired``, ``recovered``, ``seconds`` of each recovery,
        ``updates``, ``lost``, ``doubled``, ``books`` (whether replay's add up), ``exit`` (its code at the
        end), ``left_behind`` (processes), and ``error`` if the run did not survive.

    Raises:
        InputError: the folder exists, or the recipe is wrong.
        RuntimeError: no policy could be made to begin with.
    """
    root, console = Path(config.output_dir).expanduser().resolve(), Console()
    recipe: RunConfig = parse(RunConfig, [f"--config_path={config.recipe}"])
    for target in ("dream", "world learning"):
        if target in config.targets and not recipe.imagination.share:
            raise InputError("targets", target, "nothing is imagined in this recipe")
    check_absent(root)
    root.mkdir(parents=True)
    start = _policy(config, recipe, root, console)
    cells = []
    for target in config.targets:
        for fault in config.faults:
            if (target, fault) == ("driver", "stop"):
                continue
            with console.stage(f"{fault} {target}"):
                cells.append(
                    _cell(config, start, root / f"{fault}-{target.replace(' ', '_')}", target, fault)
                )
            console.say(_told(cells[-1]))
    result = {"config": asdict(config), "cells": cells}
    (root / "faults.json").write_text(json.dumps(result, indent=2) + "\n")
    (root / "faults.md").write_text(markdown(result))
    return result


def _policy(config: BenchFaultsConfig, recipe: RunConfig, root: Path, console: Console) -> list[str]:
    """The arguments of all runs, after one that has made their policy."""
    arguments = [f"--config_path={config.recipe}", f"--launch.stall_s={config.stall_s}"]
    if recipe.policy.path is not None:
        return arguments
    short = ["--sft.steps=5", "--trainer.updates=0", "--evaluation.before=false", "--evaluation.episodes=1"]
    if recipe.dataset.repo_id is None:
        short.append("--demos.episodes=2")
    with console.stage("a policy to begin with"):
        made = Victim(root / "start", [*arguments, *short, "--evaluation.videos=0"], root / "start.log")
        if code := made.process.wait():
            raise RuntimeError(f"its run ended with code {code}:\n{last_words(root / 'start.log')}")
    return [
        *arguments,
        "--sft.steps=0",
        f"--policy.path={root / 'start' / CHECKPOINTS / LAST / PRETRAINED}",
    ]


def _cell(
    config: BenchFaultsConfig, start: list[str], folder: Path, target: str, fault: str
) -> dict[str, Any]:
    """One run and all its hits."""
    number, rng = SIGNALS[fault], random.Random(f"{config.seed} {target} {fault}")
    arguments = [
        *start,
        f"--trainer.updates={ENDLESS}",
        "--trainer.schedule=constant",
        "--rollout.workers=2",
        "--rollout.max_restarts=1000",
        "--evaluation.before=false",
        "--evaluation.every_updates=0",
        "--evaluation.videos=0",
        "--save_every_updates=5",
    ]
    victim = Victim(folder, arguments, folder.with_suffix(".log"))
    found: dict[str, Any] = {"target": target, "fault": fault, "fired": 0, "recovered": 0, "seconds": []}
    left: list[int] = []
    try:
        victim.await_update(7, START_S)
        for _ in range(config.repeats):
            time.sleep(rng.uniform(0.5, 3.0))
            _hit_once(victim, found, target, number, rng)
        found["exit"], left = victim.end(GRACE_S)
    except (RuntimeError, subprocess.TimeoutExpired) as error:
        found["error"] = str(error)
    finally:
        deadline = time.monotonic() + TIDY_S
        while time.monotonic() < deadline and any(alive(pid) for pid in left):
            time.sleep(0.1)
        found["left_behind"] = sum(alive(pid) for pid in left)
        victim.kill()
    return found | audit(victim)


def _hit_once(victim: Victim, found: dict[str, Any], target: str, number: int, rng: random.Random) -> None:
    pids = victim.pids(target)
    if not pids:
        raise RuntimeError(f"there is no process of {target} to be hit")
    pid, last = rng.choice(pids), max(victim.updates())
    started = time.monotonic()
    if not (hit(pid, number) and await_hit(pid, number)):
        raise RuntimeError(f"{target} {pid} took no notice of signal {number}")
    found["fired"] += 1
    if target == "driver":
        victim.process.wait()
        last = max(victim.updates())
        victim.go_on()
    victim.await_successors(target, pid, len(pids), START_S)
    if target != "rollout":
        # With some to spare: a few may have been on their way when it was hit.
        victim.await_update(last + SPARE, START_S)
    found["recovered"] += 1
    found["seconds"].append(round(time.monotonic() - started, 2))


def audit(victim: Victim) -> dict[str, Any]:
    """What a run's own files say of it: updates lost and doubled, and whether replay's books add up."""
    counts = Counter(victim.updates())
    newest = max(counts, default=0)
    rollout = [record for record in victim.records() if record["kind"] == "rollout"]
    books = None
    if rollout:
        held = {
            name: rollout[-1].get(f"replay_{name}_segments", 0) for name in ("stored", "evicted", "retired")
        }
        books = rollout[-1]["replay_inserted_segments"] == sum(held.values())
    try:
        saved = newest_whole(victim.folder / CHECKPOINTS)[0].name
    except InputError as error:
        saved = str(error)
    return {
        "updates": newest,
        "lost": newest - len(counts),
        "doubled": sum(counts.values()) - len(counts),
        "books": books,
        "saved": saved,
    }


def table(result: dict[str, Any]) -> Table:
    """`result` for people."""
    return as_table("what a run survives", _COLUMNS, [_row(cell) for cell in result["cells"]])


def markdown(result: dict[str, Any]) -> str:
    """`table` for the docs."""
    return as_markdown(_COLUMNS, [_row(cell) for cell in result["cells"]])


_COLUMNS = [
    "hit",
    "times",
    "recovered",
    "seconds: median, most",
    "updates",
    "lost",
    "doubled",
    "books",
    "end",
]


def _row(cell: dict[str, Any]) -> list[str]:
    seconds = cell["seconds"]
    took = f"{statistics.median(seconds):.1f}, {max(seconds):.1f}" if seconds else "–"
    ended = cell["error"].splitlines()[0] if "error" in cell else f"exit {cell['exit']}"
    if cell["left_behind"]:
        ended += f", {cell['left_behind']} processes left behind"
    books = {True: "add up", False: "DO NOT", None: "–"}[cell["books"]]
    numbers = [str(cell[name]) for name in ("updates", "lost", "doubled")]
    return [
        f"{cell['fault']} {cell['target']}",
        str(cell["fired"]),
        str(cell["recovered"]),
        took,
        *numbers,
        books,
        ended,
    ]


def _told(cell: dict[str, Any]) -> str:
    return ", ".join(f"{name} {text}" for name, text in zip(_COLUMNS, _row(cell), strict=True))
