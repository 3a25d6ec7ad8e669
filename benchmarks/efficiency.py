# SPDX-License-Identifier: Apache-2.0
"""How many real episodes a policy needs, with and without a world model.

    python -m benchmarks efficiency --recipe=recipes/imagination.yaml --budgets=16,64,256

Every cell may collect so many real episodes, and makes as many updates as any other; where nothing is
imagined, each real decision is used so much more often.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from rich.table import Table

from accerl_lerobot.config.ranges import Pattern, Range, Seed
from accerl_lerobot.console import Console
from accerl_lerobot.engines.config import RunConfig, parse
from benchmarks.records import as_markdown, mean_interval, write
from benchmarks.study import (
    INTERVALS,
    Cell,
    Results,
    Study,
    StudyConfig,
    draw_lines,
    named,
    pooled,
    rated,
    tabled,
    together,
)

ARMS = {
    "none": ("--imagination.environments=0",),
    "learned": ("--imagination.learn.steps_per_episode=5",),
    "frozen": ("--imagination.learn.steps_per_episode=0",),
}
"""Options of each arm."""
SPARE = 1.25
"""Draws that a budget of real episodes gives, beside what the updates of a cell need: nobody knows before how
long the episodes are."""


@dataclass(frozen=True, kw_only=True)
class BenchEfficiencyConfig(StudyConfig):
    """Fields of ``python -m benchmarks efficiency``."""

    recipe: str = "recipes/imagination.yaml"
    """The run that every cell is a variation of; read once, when the study starts."""
    output_dir: str = "outputs/efficiency"
    """Folder of the runs and of efficiency.json, .md and .png; finished cells in it are kept."""
    seeds: tuple[Seed, ...] = (0, 1, 2, 3, 4)
    """Each a warm start of its own."""
    arms: tuple[Annotated[str, Pattern("|".join(ARMS), " or ".join(ARMS))], ...] = tuple(ARMS)
    """Compared arms: none (nothing is imagined), learned (the world model goes on to learn), frozen (it does
    not)."""
    budgets: tuple[Annotated[int, Range("[1, 1000000]")], ...] = (16, 64, 256)
    """Real episodes of a cell, ``rollout.episodes``."""
    decisions: Annotated[int, Range("[1, 100000]")] = 15
    """Decisions of a real episode, about; from it follows how often each is learnt from, for the updates to
    be made."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("arms", "budgets"):
            named(self, name)


def cells(config: BenchEfficiencyConfig, recipe: RunConfig) -> list[Cell]:
    """Cells of all arms, budgets and seeds; seeds outermost, so that what is stopped has compared everything
    on the first ones.
    """
    updates = recipe.trainer.updates if config.updates is None else config.updates
    made = []
    for seed in config.seeds:
        for budget in config.budgets:
            for arm in config.arms:
                drawn = SPARE * updates * recipe.trainer.batch_decisions
                uses = max(1, math.ceil(drawn / (budget * config.decisions)))
                if arm != "none":  # imagined decisions make up the rest
                    uses = math.ceil(recipe.replay.samples_per_insert)
                chosen = (
                    *ARMS[arm],
                    f"--rollout.episodes={budget}",
                    f"--replay.samples_per_insert={uses}",
                    f"--replay.max_lag={max(updates, uses, recipe.replay.max_lag)}",
                )
                made.append(
                    Cell(
                        name=f"{arm}-{budget}-seed{seed}",
                        seed=seed,
                        of={"arm": arm, "budget": budget, "uses": uses},
                        chosen=chosen,
                    )
                )
    return made


def bench_efficiency(config: BenchEfficiencyConfig) -> dict[str, Any]:
    """Runs the cells that are missing, and compares all of them.

    Returns:
        ``starts`` (success of each seed's warm start), ``cells`` (of each run success, n, real episodes and
        env steps, updates, and what was imagined) and ``groups`` (arm, budget, what `together` and
        `over_none` give, and means of real episodes and env steps and of updates).
    """
    from accerl_lerobot.world_model.imagined import check_imagination

    recipe = parse(RunConfig, [f"--config_path={config.recipe}"])
    study, console = Study(config, cells(config, recipe)), Console()
    for run in study.runs[: len(config.arms)]:
        if run.imagination.environments:
            check_imagination(replace(study.starts[run.seed], imagination=run.imagination))
    result = compare(config, study.run(console))
    write(study.root, "efficiency", result, markdown(result), draw)
    console.say(f"wrote efficiency.json, .md and .png into {study.root}")
    return result


def compare(config: BenchEfficiencyConfig, results: Results) -> dict[str, Any]:
    """The study's numbers from the summaries of its runs; see `bench_efficiency`."""
    rows = results.table(("episodes_explored", "env_steps", "updates", "rl_s", "imagined_episodes"))
    groups = []
    for arm in config.arms:
        for budget in config.budgets:
            of = [row for row in rows if (row["arm"], row["budget"]) == (arm, budget)]
            means = {
                name: sum(row[name] for row in of) / len(of)
                for name in ("episodes_explored", "env_steps", "updates")
            }
            beside = [row for row in rows if (row["arm"], row["budget"]) == ("none", budget)]
            gained = {} if arm == "none" else over_none(of, beside)
            groups.append({"arm": arm, "budget": budget, **together(of), **means, **gained})
    return {"config": asdict(config), "starts": results.before, "groups": groups, "cells": rows}


def over_none(rows: Sequence[dict[str, Any]], none: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Gain over imagining nothing, by seeds: ``gain`` and its ``gain_ci95``.

    That is `mean_interval` of the seeds' gains, and never narrower than of all episodes together by Newcombe
    (1998, method 10): seeds may gain alike by chance. Empty where `none` is, or there is one seed.
    """
    if len(none) < 2:
        return {}
    without = {row["seed"]: row["success"] for row in none}
    gains = [row["success"] - without[row["seed"]] for row in rows]
    gain, interval = sum(gains) / len(gains), mean_interval(gains)
    a, b = pooled(rows), pooled(none)
    low = gain - math.hypot(a.value - a.interval().low, b.interval().high - b.value)
    high = gain + math.hypot(a.interval().high - a.value, b.value - b.interval().low)
    return {"gain": gain, "gain_ci95": (min(low, interval.low), max(high, interval.high))}


def table(result: dict[str, Any]) -> Table:
    """`result` for people: one row per arm, one column per budget."""
    return tabled("success after so many real episodes; before them", result, _columns(result), _rows(result))


def markdown(result: dict[str, Any]) -> str:
    """`table` for the docs."""
    return as_markdown(_columns(result), _rows(result)) + f"\n{INTERVALS.capitalize()}.\n"


def draw(path: Path, result: dict[str, Any]) -> None:
    """Success over real episodes: one line per arm with its 95 % interval, one dot per seed."""
    budgets = result["config"]["budgets"]

    def dress(axes: Any) -> None:
        axes.set_xscale("log")
        axes.set_xticks(budgets, [str(b) for b in budgets], minor=False)
        axes.minorticks_off()
        axes.set(xlabel="real episodes")
        axes.legend(loc="best", ncols=2)

    def places(i: float) -> list[float]:
        return [budget * 1.04**i for budget in budgets]

    draw_lines(path, result, "arm", result["config"]["arms"], places, dress)


def _gained(group: dict[str, Any]) -> str:
    if "gain" not in group:
        return ""
    low, high = (100 * end for end in group["gain_ci95"])
    return f", {100 * group['gain']:+.1f} points [{low:+.1f}, {high:+.1f}] over none"


def _columns(result: dict[str, Any]) -> list[str]:
    return ["imagined", *(f"{budget} real episodes" for budget in result["config"]["budgets"])]


def _rows(result: dict[str, Any]) -> list[list[str]]:
    rows = []
    for arm in result["config"]["arms"]:
        row = [arm]
        for g in (g for g in result["groups"] if g["arm"] == arm):
            real = f"{g['episodes_explored']:.0f} episodes of {g['env_steps']:,.0f} env steps"
            made = f"{real}, {g['updates']:.0f} updates"
            row.append(f"{rated(g)}{_gained(g)}, {made}")
        rows.append(row)
    return rows
