# SPDX-License-Identifier: Apache-2.0
"""The page of one world model: what it learnt, and how it did on episodes it had not seen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from accerl_lerobot.console import ABSENT, count, duration, number
from accerl_lerobot.report.blocks import Block, Cell, Commands, Page, Table, Tile, figures, section
from accerl_lerobot.report.charts import Chart, Series, line
from accerl_lerobot.report.commands import commands
from accerl_lerobot.report.dreams import gate_table
from accerl_lerobot.report.notes import notes, status
from accerl_lerobot.report.read import Record, Run, column, has
from accerl_lerobot.report.run_page import films, recipe_blocks
from accerl_lerobot.world_model.validation.tables import dataset_rows, has_several, per_dataset

DEPTH = "depth of the prediction in chunks"
ARMS = {
    "true": "its own actions",
    "shuffled": "another episode's",
    "zero": "none",
    "opposite": "the opposite",
    "failed": "a failed episode's",
}
"""Which actions were dreamt with."""
BY_SOURCE: tuple[tuple[str, str, tuple[float | None, float | None]], ...] = (
    ("Skill where pixels changed", "skill_changed", (None, 1.0)),
    ("Sensitivity to another episode's actions", "sensitivity_shuffled", (0.0, None)),
)
"""Title, measure and limits of a chart with a line per source."""


def world_model_page(run: Run, config_class: type[Any], now: float) -> Page:
    """Says what became of a world model.

    Args:
        run: of ``accerl world-model`` or ``world-model-eval``.
        config_class: of its recipe.
        now: in seconds since 1970.
    """
    state, good = status(run, now)
    found = run.result or {}
    return Page(
        title=run.name,
        kicker=f"accerl {run.verb} · {run.name}",
        state=state,
        state_good=good,
        headline=_headline(run),
        lead=_lead(found),
        outcomes=[],
        tiles=_tiles(found),
        warnings=notes(run, None, now),
        sections=[
            *section("checks", "Checks", _gates(found)),
            *films(run),
            *section("depth", "By depth", figures(*depth_charts(found.get("depths", [])))),
            *section("datasets", "By dataset", *source_blocks(found)),
            *section("learning", "Learning", figures(*_learning(run))),
            *section("recipe", "Recipe", recipe_blocks(run, config_class)),
            *section("next", "What to do next", [Commands(commands=commands(run))]),
        ],
    )


def estimates(depths: Sequence[Record], name: str, called: str, colour: int) -> Series:
    """An estimate at each depth with its interval; numbers without one are a plain line."""
    x = column(depths, "depth")
    if has(depths, name):
        return line(called, x, column(depths, name), colour=colour)
    parts = [d.get(name) or {} for d in depths]
    y, low, high = (column(parts, key) for key in ("value", "low", "high"))
    there = np.isfinite(y)
    ends = (np.where(np.isfinite(end), end, y)[there] for end in (low, high))
    low, high = ends
    return Series(name=called, x=x[there], y=y[there], low=low, high=high, kind="points", colour=colour)


def depth_charts(depths: Sequence[Record]) -> list[Chart]:
    """Skill, sensitivity and outcomes by depth."""
    arms = [arm for arm in ARMS if has(depths, f"false_success_{arm}")]
    return [
        Chart(
            title="Skill",
            x_label=DEPTH,
            limits=(None, 1.0),
            note="1 is perfect, 0 is a copy of the last frame.",
            series=(
                estimates(depths, "skill_changed", "where pixels changed", 0),
                estimates(depths, "skill", "all pixels", 1),
            ),
        ),
        Chart(
            title="Sensitivity to actions",
            unit="times the error",
            x_label=DEPTH,
            limits=(0.0, None),
            note="How much the error grows with wrong actions; 1 would be a model that ignores them.",
            series=tuple(
                estimates(depths, f"sensitivity_{arm}", ARMS[arm], i)
                for i, arm in enumerate(("shuffled", "zero", "opposite"))
            ),
        ),
        Chart(
            title="Error of the state",
            x_label=DEPTH,
            limits=(0.0, None),
            series=(
                estimates(depths, "state_error", "predicted", 0),
                estimates(depths, "state_error_copy", "copy of the last state", 7),
            ),
        ),
        Chart(
            title="Taken for a success",
            x_label=DEPTH,
            share=True,
            limits=(0.0, None),
            note="Share of dreams told as successes, by the actions they were dreamt with; with its own "
            "actions, of failures.",
            series=tuple(
                estimates(depths, f"false_success_{arm}", ARMS[arm], i) for i, arm in enumerate(arms)
            ),
        ),
    ]


def source_blocks(found: Record) -> list[list[Block]]:
    """A table and charts of the trials on several sources; nothing where there was one."""
    if not has_several(found):
        return []
    every = per_dataset(found)
    names = [str(one.get("name")) for one in every]
    table = Table(
        caption="The same measures on episodes from each source",
        columns=("", *names),
        rows=[
            (Cell(text=name), *(Cell(text=text or ABSENT, number=True) for text in cells))
            for name, cells in dataset_rows(every)
        ],
    )
    charts = [
        Chart(
            title=title,
            x_label=DEPTH,
            limits=limits,
            series=tuple(
                estimates(one["depths"], key, name, i)
                for i, (one, name) in enumerate(zip(every, names, strict=True))
            ),
        )
        for title, key, limits in BY_SOURCE
    ]
    return [[table], figures(*charts)] if len(every) > 1 else [[table]]


def _headline(run: Run) -> str:
    if run.result is None:
        steps = max((int(r.get("step", 0)) for r in run.records.get("world_model", [])), default=0)
        return f"A world model after {count(steps, 'step')}, not validated yet"
    gates = run.result["checks"]
    failed = [name for name, gate in gates.items() if not gate["holds"]]
    if not failed:
        return f"The world model passed validation: all {len(gates)} checks hold"
    return f"The world model failed validation: {', '.join(failed)}"


def _lead(found: Record) -> str:
    if not found:
        return ""
    every = per_dataset(found)
    text = count(sum(one["windows"] for one in every), "window")
    if all("episodes" in one for one in every):
        text += f" on {count(sum(one['episodes'] for one in every), 'episode')} it had not learnt from"
    return f"{text}; each predicted from a real frame with the executed actions, and with others."


def _tiles(found: Record) -> list[Tile]:
    tiles = []
    for key, name in (("learnt", "learnt from"), ("held_out", "held out")):
        amount = found.get(key)
        if isinstance(amount, dict):
            note = f"{number(amount.get('env_steps'))} env steps"
            tiles.append(Tile(name=name, value=count(amount.get("episodes", 0), "episode"), note=note))
    for row in found.get("depths", [])[-1:]:
        skill = (row.get("skill_changed") or {}).get("value")
        tiles.append(Tile(name="skill", value=number(skill, 2), note=f"after {count(row['depth'], 'chunk')}"))
    auroc = (found.get("outcomes") or {}).get("auroc") or {}
    if auroc:
        ends = f"[{number(auroc.get('low'), 3)}, {number(auroc.get('high'), 3)}]"
        tiles.append(Tile(name="AUROC of outcomes", value=number(auroc.get("value"), 3), note=ends))
    if "seconds" in found:
        tiles.append(Tile(name="learning", value=duration(found["seconds"])))
    return tiles


def _gates(found: Record) -> list[Block]:
    gates = found.get("checks", {})
    rows = [(name, gate["value"], gate["wanted"], gate["holds"]) for name, gate in gates.items()]
    return [gate_table("What it had to pass", rows)] if rows else []


def _learning(run: Run) -> list[Chart]:
    """Training losses as lines, and the same on held-out windows as points."""
    charts = []
    for kind, title, names in (
        ("world_model", "Loss of the world model", _parts(run.records.get("world_model", []))),
        ("success_model", "Success model", ("loss", "accuracy")),
    ):
        learnt, held = (run.records.get(f"{kind}{which}", []) for which in ("", "_held_out"))
        series = []
        for i, name in enumerate(names):
            shown = name.replace("_", " ")
            if has(learnt, name):
                series.append(line(shown, column(learnt, "step"), column(learnt, name), colour=i))
            if has(held, name):
                x, y = column(held, "step"), column(held, name)
                series.append(Series(name=f"{shown}, held out", x=x, y=y, kind="points", colour=i))
        charts.append(Chart(title=title, x_label="gradient steps", limits=(0.0, None), series=tuple(series)))
    return charts


def _parts(records: Sequence[Record]) -> tuple[str, ...]:
    """Names of the parts of a world model's loss, which each class of models has its own; else the loss."""
    names = dict.fromkeys(name for record in records for name in record)
    parts = tuple(name for name in names if name not in ("kind", "step", "loss", "grad_norm"))
    return parts or ("loss",)
