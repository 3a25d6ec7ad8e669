# SPDX-License-Identifier: Apache-2.0
"""Faults that a run survives: in each of its processes, at named points and at any moment, and their cost.

    python -m benchmarks faults                                          # a run made of time: seconds each
    python -m benchmarks faults --recipe=recipes/gipo.yaml --faults=kill --targets=driver --repeats=5

One run for each target, in which things go wrong again and again (`hits.py`), in an order drawn from the
seed; each is proved to have happened. A cell is target × fault. After each the run's log is looked at, and at
the end, when it has been asked to stop, its segments (`audit.py`) and what it has left behind.
"""

from __future__ import annotations

import json
import random
import statistics
import subprocess
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from rich.table import Table

from accerl_lerobot.checkpoint.layout import CHECKPOINTS, LAST, PRETRAINED, SUMMARY
from accerl_lerobot.config.ranges import Range, Repeats, Section, Seed, Steps
from accerl_lerobot.console import Console
from accerl_lerobot.engines.config import RunConfig, encode, parse
from accerl_lerobot.errors import InputError, check_absent
from accerl_lerobot.evaluation import Rate
from benchmarks.audit import audit_segments, audit_updates
from benchmarks.hits import FAULTS, START_S, TIDY_S, places, strike
from benchmarks.light_run import light_config
from benchmarks.tables import as_markdown, as_table, host, last_words, write
from benchmarks.victims import CLASSES, DRIVER, EVERYTHING, LIGHT, TRAIN, Victim, alive

IMAGINING = "world-model learning"
"""Target that is there where the world model of imagined environments learns."""
TARGETS = (*CLASSES, DRIVER, EVERYTHING)
GRACE_S = 60.0
"""How long a run may take to stop when it is asked to."""
LATEST = 0.9
"""Share of a run's updates in which it is hit: the last ones are to be left to it."""
WAIT_S = 3600.0
"""How long a run may take from one hit to the moment of the next."""
ENDLESS = 1_000_000


@dataclass(frozen=True, kw_only=True)
class BenchFaultsConfig(Section):
    """Fields of ``python -m benchmarks faults``."""

    recipe: str | None = None
    """The run. Its demonstrations and SFT are cut short, unless it has a policy: they do not matter here.
    None: one with environments and a policy made of time, in which all else is real."""
    output_dir: str = "outputs/faults"
    """Folder of the runs and of faults.json and .md; must not exist."""
    targets: tuple[str, ...] = (
        "rollout",
        "inference",
        "replay",
        "trainer",
        "trainer rank",
        "driver",
        "everything",
    )
    """Processes to strike: these, and where a run imagines, world-model learning too.
    driver: the run's own process, which is gone on with by its command line. everything: it and all below it,
    at once."""
    faults: tuple[str, ...] = FAULTS
    """kill, stop: SIGKILL and SIGSTOP, at a point or at any moment. exception, exit (with code 0), hang (of
    one thread), nan, nans (in as many updates in a row as end the trainer), full (the disk), torn (a file of
    a checkpoint): at the points of `fault_injection` where they can happen."""
    repeats: Repeats = 5
    """Hits of each cell."""
    stall_s: Annotated[float, Range("[5, inf)")] = 10.0
    """``launch.stall_s`` of the runs: how long a process that hangs is waited for."""
    updates: Steps = 0
    """Where everything is hit: that happens at random moments of so many updates. When it has, the run goes
    on to the last of them and ends by itself, and so does one that was left alone, to compare what they have
    learnt. 0: hits follow each other, and the run is asked to stop like others."""
    seed: Seed = 0
    """Seed of the order, the places and the moments."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, names in (("targets", TARGETS), ("faults", FAULTS)):
            given = getattr(self, name)
            if not given or len(set(given)) < len(given) or not set(given) <= set(names):
                raise InputError(name, given, f"use some of {', '.join(names)}, none twice")
        if not any(self.of(target) for target in self.targets):
            hint = f"none of them can befall {', '.join(self.targets)}; add kill"
            raise InputError("faults", self.faults, hint)

    def of(self, target: str) -> list[str]:
        """The faults that can befall it."""
        return [fault for fault in self.faults if places(target, fault)]


def bench_faults(config: BenchFaultsConfig) -> dict[str, Any]:
    """Does it all; what is known is written after each target.

    Returns:
        ``hits``, see `hits.Hit`; ``runs``, of each ``target``, what `audit` finds, ``exit`` (its code at the
        end), ``left_behind`` (processes) and ``skipped_updates``; ``config`` and ``host``.
    """
    root, console = Path(config.output_dir).expanduser().resolve(), Console()
    recipe = recipe_of(config)
    check_absent(root)
    root.mkdir(parents=True)
    start = Start(config.recipe, recipe, config.stall_s, root, console)
    result: dict[str, Any] = {"config": asdict(config), "host": host(), "hits": [], "runs": []}
    for target in config.targets:
        drawn = [fault for fault in config.of(target) for _ in range(config.repeats)]
        random.Random(f"{config.seed} {target}").shuffle(drawn)
        with console.stage(target, total=len(drawn)) as stage:
            _target(config, start, target, drawn, result, stage.update)
        result["host_after"] = host()
        write(root, "faults", result, markdown(result))
    return result


def recipe_of(config: BenchFaultsConfig) -> RunConfig:
    """The run."""
    if config.recipe is None:
        recipe = light_config(updates=ENDLESS, stall_s=config.stall_s)
    else:
        recipe = parse(RunConfig, [f"--config_path={config.recipe}"])
    if IMAGINING in config.targets and not recipe.imagination.learns:
        raise InputError("targets", IMAGINING, "no imagined environment's world model learns in this recipe")
    if "trainer rank" in config.targets and config.recipe is not None and recipe.trainer.ranks < 2:
        raise InputError("targets", "trainer rank", "the trainer of this recipe is one process")
    return recipe


class Start:
    """How runs to be done harm to are begun: all of one recipe, and of one policy."""

    def __init__(
        self, path: str | None, recipe: RunConfig, stall_s: float, root: Path, console: Console
    ) -> None:
        self._root = root
        self._module = LIGHT if path is None else TRAIN
        self.recipe = recipe
        self._stall_s = stall_s
        self._arguments = [f"--config_path={path}", f"--launch.stall_s={stall_s}"]
        if path is None:
            light = root / "light.yaml"
            light.write_text(yaml.safe_dump(encode(recipe), sort_keys=False))
            self._arguments = [f"--config_path={light}"]
        else:
            self._arguments += ["--rollout.workers=2", "--launch.max_restarts=1000"]
        if recipe.policy.path is None:
            self._arguments += self._policy(console)

    def run(self, name: str, *changes: str, orders: Path | None = None) -> Victim:
        """Begins one."""
        chosen = [
            f"--trainer.updates={ENDLESS}",
            "--trainer.final_lr_share=1",
            "--evaluation.before=false",
            "--evaluation.every_updates=0",
            "--evaluation.videos=0",
        ]
        if self._module is TRAIN:
            chosen.append("--save_every_updates=5")
        folder = self._root / name
        arguments = [*self._arguments, *chosen, *changes]
        return Victim(folder, arguments, folder.with_suffix(".log"), self._module, orders)

    def ranks(self) -> list[str]:
        """Changes that give the trainer another rank, where it has none."""
        return [] if self._module is TRAIN else ["--trainer.ranks=2"]

    def _policy(self, console: Console) -> list[str]:
        """Arguments that name it, after a run that has made it."""
        short = [
            "--sft.steps=5",
            "--trainer.updates=0",
            "--evaluation.before=false",
            "--evaluation.episodes=1",
        ]
        if self.recipe.dataset.repo_id is None:
            short.append("--demos.episodes=2")
        log = self._root / "start.log"
        with console.stage("a policy to begin with"):
            made = Victim(self._root / "start", [*self._arguments, *short, "--evaluation.videos=0"], log)
            if code := made.process.wait():
                raise RuntimeError(f"its run ended with code {code}:\n{last_words(log)}")
        checkpoint = self._root / "start" / CHECKPOINTS / LAST / PRETRAINED
        return ["--sft.steps=0", f"--policy.path={checkpoint}"]


def _target(
    config: BenchFaultsConfig,
    start: Start,
    target: str,
    drawn: list[str],
    result: dict[str, Any],
    on_progress: Any,
) -> None:
    """All hits of one target, in one run unless it is lost."""
    rng, done = random.Random(f"{config.seed} {target} where"), 0
    changes = start.ranks() if target == "trainer rank" else []
    moments: list[int] = []
    if target == EVERYTHING and config.updates:
        last = max(_first(config), int(LATEST * config.updates))
        moments = sorted(rng.randint(_first(config), last) for _ in drawn)
    while done < len(drawn):
        name = f"{target.replace(' ', '_')}-{len(result['runs'])}"
        orders = Path(config.output_dir).expanduser().resolve() / f"{name}.orders"
        victim = start.run(name, *changes, orders=orders)
        found: dict[str, Any] = {"target": target, "run": name}
        before = done
        try:
            victim.await_update(_first(config), START_S)
            while done < len(drawn):
                if moments:
                    victim.await_update(moments[done], WAIT_S, every=1.0)
                struck = strike(victim, orders, str(done), target, drawn[done], rng)
                result["hits"].append(asdict(struck))
                done += 1
                on_progress(done, f"{struck.fault} at {struck.place}: {struck.outcome}")
                if struck.outcome == "lost":
                    break
            found |= end_run(victim)
            if moments:
                found["success"] = _finish(victim, start, config.updates)
        except (RuntimeError, subprocess.TimeoutExpired) as error:
            found["error"] = str(error)
            if done == before:
                done = len(drawn)  # it did not even come to be hit, nor would another one
        finally:
            victim.kill()
        result["runs"].append(found | audit_updates(victim.records()) | audit_segments(victim.folder))


def _first(config: BenchFaultsConfig) -> int:
    """The update before which nothing happens."""
    return 20 if config.recipe is None else 7


def end_run(victim: Victim) -> dict[str, Any]:
    """Asks the run to stop: its ``exit`` code, processes ``left_behind``, and ``skipped_updates``."""
    code, below = victim.end(GRACE_S)
    deadline = time.monotonic() + TIDY_S
    while time.monotonic() < deadline and any(alive(pid) for pid in below):
        time.sleep(0.1)
    skipped = [record["skipped"] for record in victim.records() if "skipped" in record]
    left = sum(alive(pid) for pid in below)
    return {"exit": code, "left_behind": left, "skipped_updates": (skipped or [0])[-1]}


def _finish(victim: Victim, start: Start, updates: int) -> dict[str, Any]:
    """Success at the end of a run that things were done to, and of one that was left alone."""
    alone = start.run("alone", f"--trainer.updates={updates}")
    found = {}
    try:
        victim.go_on(f"--trainer.updates={updates}")
        for name, one in (("struck", victim), ("alone", alone)):
            if code := one.process.wait():
                raise RuntimeError(f"{name}: it ended with code {code}:\n{last_words(one.log)}")
            summary = json.loads((one.folder / SUMMARY).read_text())
            rate = Rate(successes=round(summary["success_after"] * summary["n_after"]), n=summary["n_after"])
            found[name] = str(rate)
    finally:
        alone.kill()
    return found


def table(result: dict[str, Any]) -> Table:
    """`result` for people."""
    return as_table("what a run survives", _COLUMNS, _rows(result))


def markdown(result: dict[str, Any]) -> str:
    """`table` for the docs, and what was found at the end of each run."""
    text = as_markdown(_COLUMNS, _rows(result))
    return f"{text}\n{as_markdown(_RUN_COLUMNS, [_run_row(run) for run in result['runs']])}"


_COLUMNS = ("hit", "times", "survived", "stopped", "lost", "seconds: median, p95, most", "where")
_RUN_COLUMNS = ("run", "updates", "lost", "doubled", "segments", "lost", "doubled", "books", "end")


def cells(result: dict[str, Any]) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Hits by target and fault, in the order of the config."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for hit in result["hits"]:
        found.setdefault((hit["target"], hit["fault"]), []).append(hit)
    targets, faults = result["config"]["targets"], result["config"]["faults"]
    order = sorted(found, key=lambda cell: (targets.index(cell[0]), faults.index(cell[1])))
    return {cell: found[cell] for cell in order}


def _rows(result: dict[str, Any]) -> list[list[str]]:
    rows = []
    for (target, fault), hits in cells(result).items():
        outcomes = [str(sum(h["outcome"] == o for h in hits)) for o in ("survived", "stopped", "lost")]
        seconds = [h["seconds"] for h in hits if h["seconds"] is not None]
        took = "–"
        if seconds:
            took = f"{statistics.median(seconds):.1f}, {np.percentile(seconds, 95):.1f}, {max(seconds):.1f}"
        where = sorted({h["place"].split(".")[-1] for h in hits})
        fired = str(sum(h["fired"] for h in hits))
        rows.append([f"{fault} {target}", fired, *outcomes, took, ", ".join(where)])
    return rows


def _run_row(run: dict[str, Any]) -> list[str]:
    ended = run["error"].splitlines()[0] if "error" in run else f"exit {run['exit']}"
    if run.get("left_behind"):
        ended += f", {run['left_behind']} processes left behind"
    if "success" in run:
        ended += f"; in the end {run['success']['struck']}, left alone {run['success']['alone']}"
    books = {True: "add up", False: "DO NOT", None: "–"}[run["books"]]
    names = ("updates", "lost", "doubled", "segments", "segments_lost", "segments_doubled")
    return [run["target"], *(str(run.get(name, "–")) for name in names), books, ended]
