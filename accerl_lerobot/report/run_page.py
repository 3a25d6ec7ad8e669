# SPDX-License-Identifier: Apache-2.0
"""The page of one run of ``accerl train``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import yaml

from accerl_lerobot.console import count, duration, number, percent, rate
from accerl_lerobot.report.blocks import (
    Block,
    Cell,
    Changes,
    Commands,
    Film,
    Folded,
    Outcome,
    Page,
    Section,
    Table,
    Tile,
    Words,
    figures,
    rated,
    section,
)
from accerl_lerobot.report.charts import WHOLE, Chart, Series, line
from accerl_lerobot.report.commands import commands
from accerl_lerobot.report.dreams import dream_blocks, dream_films
from accerl_lerobot.report.learning import lag_chart, learning_charts
from accerl_lerobot.report.notes import notes, status
from accerl_lerobot.report.read import Record, Run, column, newest
from accerl_lerobot.report.recipe import differences, lag_bound, unreadable
from accerl_lerobot.report.speed import speed_charts, time_blocks

FEW = 25
"""Exploring episodes below which their success says nothing."""
FILMS = {
    "before_after.mp4": (
        "Before and after",
        "The same episodes before training, left, and after it, right, under the success of the whole "
        "evaluation. The frame at the end of a clip says how it ended: green is success, red failure.",
    ),
    "preview.mp4": (
        "Predictions beside reality",
        "Top to bottom: what happened; what the world model predicted with the same actions; and with "
        "those of another episode.",
    ),
    "preview_online.mp4": (
        "Predictions of a policy's episodes",
        "The same of episodes that a policy lived through.",
    ),
}
"""Title and caption of the videos that runs make."""


def run_page(run: Run, config_class: type[Any], now: float) -> Page:
    """Says what became of a run.

    Args:
        run: of ``accerl train``.
        config_class: of its recipe.
        now: in seconds since 1970.
    """
    train, rollout = run.records.get("train", []), run.records.get("rollout", [])
    bound = lag_bound(config_class, run.config)
    state, good = status(run, now)
    return Page(
        title=run.name,
        kicker=f"accerl train · {run.name}",
        state=state,
        state_good=good,
        headline=headline(run),
        lead=_lead(run),
        outcomes=_outcomes(run),
        tiles=_tiles(run, bound),
        warnings=notes(run, bound, now),
        sections=[
            *section("success", "Success", figures(success_chart(run)), _tasks(run)),
            *films(run),
            *section(
                "imagination",
                "Imagination",
                dream_blocks(rollout, run.room("imagination")),
                dream_films(run.dreams),
            ),
            *section("lag", "Staleness", figures(lag_chart(train, bound)) if train else []),
            *section(
                "speed",
                "Speed",
                figures(*speed_charts(train, rollout)),
                time_blocks(train, rollout, run.room("inference").get("max_batch")),
            ),
            *section(
                "learning", "Learning", figures(*learning_charts(train, run.room("trainer").get("grad_clip")))
            ),
            *section("recipe", "Recipe", recipe_blocks(run, config_class)),
            *section("next", "What to do next", [Commands(commands=commands(run))]),
        ],
    )


def evaluations(run: Run) -> list[Record]:
    """In the order of the policy's experience."""
    return sorted(run.records.get("evaluation", []), key=lambda e: e.get("env_steps") or 0.0)


def exploring(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Env steps since training began, and the success of the newest exploring episodes.

    Counters of workers include the evaluation before training, which is taken out again: its episodes times
    their mean length.
    """
    rollout = run.records.get("rollout", [])
    before = [e for e in evaluations(run) if e.get("group") == "before"]
    base = sum(e["steps_mean"] * e["n"] for e in before)
    steps = column(rollout, "env_steps") - base
    episodes = column(rollout, "episodes") - sum(e["n"] for e in before)
    if run.result is not None:  # workers go on while the policy is evaluated in the end
        steps = np.minimum(steps, run.result["env_steps"])
    # The first episodes to end are the short ones, which are successes.
    return steps, np.where(episodes >= FEW, column(rollout, "success_exploring"), np.nan)


def success_chart(run: Run) -> Chart:
    """Evaluations with intervals over env steps, and the exploring policy's success behind them."""
    steps, share = exploring(run)
    behind = line("while exploring", steps, share, colour=7)
    points = evaluated(run, "evaluation, 95 % Wilson", 0)
    reach = (0.0, max([*behind.x[-1:], *points.x], default=1.0))
    return Chart(
        title="Success rate",
        x_label="env steps of online experience",
        share=True,
        limits=WHOLE,
        wide=True,
        note="Evaluations use LeRobot's own sampler on seeds that no run trains on; exploring is the policy "
        "with its noise, over the newest 100 episodes.",
        series=(replace(behind, reach=reach), points),
    )


def evaluated(run: Run, name: str, colour: int) -> Series:
    """The evaluations of a run with their intervals."""
    found = evaluations(run)
    low, high = (np.array([e["ci95"][end] for e in found], dtype=np.float64) for end in (0, 1))
    x, y = column(found, "env_steps"), column(found, "success")
    return Series(name=name, x=x, y=y, low=low, high=high, kind="points", colour=colour)


def headline(run: Run) -> str:
    """The result in one sentence."""
    tasks = _task_names(run)
    if run.result is None:
        made, of = len(run.records.get("train", [])), run.room("trainer").get("updates")
        share = newest(run.records.get("rollout", []), "success_exploring")
        so_far = "" if share is None else f", with {percent(share)} success while exploring"
        return f"{number(made)} of {number(of)} updates on {tasks} so far{so_far}"
    before, after = run.result["success_before"], run.result["success_after"]
    if before is None:
        return f"{percent(after)} success on {tasks} after training"
    if before == after:
        return f"Success on {tasks} stayed at {percent(after)}"
    change = f"from {percent(before)} to {percent(after)}"
    if not _apart(run.result["ci95_before"], run.result["ci95_after"]):
        return f"Success on {tasks} went {change}, and the intervals overlap"
    return f"Success on {tasks} {'rose' if after > before else 'fell'} {change}"


def algorithm(run: Run) -> str:
    """As it is called on the command line, in capitals."""
    return str(run.room("algorithm").get("type", "")).upper()


def films(run: Run) -> list[Section]:
    """Every video in the folder; one that accerl does not know stands under its own name."""
    return [
        Section(anchor=path.stem, title=title, blocks=[Film(path=path, caption=caption)])
        for path in run.videos
        for title, caption in [FILMS.get(path.name, ("Video", path.name))]
    ]


def recipe_blocks(run: Run, config_class: type[Any]) -> list[Block]:
    """Differences from the defaults, and the whole recipe."""
    rows = [(field, shown(v), shown(usual)) for field, v, usual in differences(config_class, run.config)]
    found: list[Block] = [Changes(caption="What this run sets, and what the default would be", rows=rows)]
    if why := unreadable(config_class, run.config):
        text = f"This accerl cannot read the recipe, so what it implies is not known here: {why}."
        found.append(Words(text=text))
    return [*found, Folded(title="The complete recipe, config.yaml", text=run.config_text)]


def shown(value: Any) -> str:
    """A value as one would type it."""
    if isinstance(value, str):
        return value
    text = yaml.safe_dump(value, default_flow_style=True, width=10_000, allow_unicode=True)
    return text.removesuffix("\n").removesuffix("\n...")


def _lead(run: Run) -> str:
    """How the number came about, with n and the intervals."""
    result = run.result
    if result is None:
        last = evaluations(run)[-1:]
        said = [f"Last evaluation: {rate(e['success'], e['ci95'])}, n = {e['n']}." for e in last]
        return " ".join([f"{algorithm(run)}, seed {run.config.get('seed')}.", *said])
    n = result["n_after"]
    times = "before and after" if result["success_before"] is not None else "after training"
    before = result["success_before"]
    intervals = rate(result["success_after"], result["ci95_after"])
    if before is not None:
        intervals = f"{rate(before, result['ci95_before'])} → {intervals}"
    return (
        f"{intervals}, 95 % Wilson intervals, on {count(n, 'episode')} {times} that no run trains on. "
        f"{algorithm(run)}, seed {result['seed']}, {number(result['env_steps'])} env steps in "
        f"{duration(result['wall_s'])}."
    )


def _outcomes(run: Run) -> list[Outcome]:
    result = run.result
    if result is None:
        return [
            Outcome(
                name=str(e.get("group")),
                success=e["success"],
                interval=(e["ci95"][0], e["ci95"][1]),
                n=e["n"],
            )
            for e in evaluations(run)[-1:]
        ]
    return [
        Outcome(
            name=f"{when} training",
            success=result[f"success_{when}"],
            interval=tuple(result[f"ci95_{when}"]),
            n=result[f"n_{when}"],
        )
        for when in ("before", "after")
        if result[f"success_{when}"] is not None
    ]


def _tiles(run: Run, bound: int | None) -> list[Tile]:
    train, rollout, result = run.records.get("train", []), run.records.get("rollout", []), run.result or {}
    steps, _ = exploring(run)
    walls = [newest(records, "wall_s") for records in run.records.values()]
    wall = result.get("wall_s", max((w for w in walls if w is not None), default=None))
    parts = [
        f"{name} {duration(result[key])}"
        for key, name in (("warm_start_s", "warm start"), ("rl_s", "RL"))
        if result.get(key, 0.0) >= 1
    ]
    lags = column(train, "lag_mean")
    largest = column(train, "lag_max")
    known = [f"largest {number(float(np.nanmax(largest)))}"] if len(lags) else []
    known += [f"bound {bound}"] if bound is not None else []
    of = run.room("trainer").get("updates")
    return [
        Tile(
            name="env steps",
            value=number(result.get("env_steps", float(steps[-1]) if len(steps) else None), 3),
            note=f"{number(result.get('episodes', newest(rollout, 'episodes')))} episodes",
        ),
        Tile(name="wall time", value=duration(wall), note=", ".join(parts)),
        Tile(
            name="updates",
            value=number(result.get("updates", len(train))),
            note=f"of {number(of)}" if of else "",
        ),
        Tile(
            name="lag",
            value=number(float(np.nanmean(lags)), 2) if len(lags) else number(None),
            note=", ".join(known),
        ),
        Tile(
            name="algorithm", value=algorithm(run), note=f"advantage {run.room('algorithm').get('advantage')}"
        ),
        Tile(name="seed", value=str(run.config.get("seed"))),
    ]


def _tasks(run: Run) -> list[Block]:
    """A row per task, where there are several."""
    result, last = run.result or {}, evaluations(run)[-1:]
    before, after = result.get("tasks_before") or {}, result.get("tasks_after") or {}
    if not result and last:
        after = last[0].get("tasks") or {}
    if len(after) < 2:
        return []
    rows = []
    for task, entry in sorted(after.items()):
        start = before.get(task, {})
        rows.append(
            (
                Cell(text=task),
                rated(start.get("success"), start.get("ci95")),
                rated(entry.get("success"), entry.get("ci95")),
                Cell(text=number(entry.get("n")), number=True),
            )
        )
    return [Table(caption="Success of each task", columns=("task", "before", "after", "n"), rows=rows)]


def _task_names(run: Run) -> str:
    last = evaluations(run)[-1:]
    names = (run.result or {}).get("tasks") or sorted((last[0].get("tasks") if last else None) or ())
    env = run.room("env")
    if not names:
        return str(env.get("task") or env.get("name") or env.get("type"))
    return str(names[0]) if len(names) == 1 else count(len(names), "task")


def _apart(a: Sequence[float], b: Sequence[float]) -> bool:
    """True if two intervals have nothing in common."""
    return a[1] < b[0] or b[1] < a[0]
