# SPDX-License-Identifier: Apache-2.0
"""The page of several runs of one kind: a row each, curves over each other, what sets them apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from accerl_lerobot.console import count, duration, number, percent
from accerl_lerobot.report.blocks import Block, Cell, Page, Table, Words, figures, rated, section
from accerl_lerobot.report.charts import COLOURS, WHOLE, Chart, Series, line
from accerl_lerobot.report.notes import notes, status
from accerl_lerobot.report.read import Record, Run, column, newest
from accerl_lerobot.report.recipe import apart
from accerl_lerobot.report.run_page import algorithm, evaluated, evaluations, exploring, shown
from accerl_lerobot.report.world_model_page import DEPTH, estimates


def comparison_page(runs: Sequence[Run], now: float) -> Page:
    """Sets runs beside each other; all are of one verb."""
    names = labels(runs)
    trained = runs[0].verb == "train"
    done = sum(run.result is not None for run in runs)
    warnings = [
        f"{name}: {note}" for name, run in zip(names, runs, strict=True) for note in notes(run, None, now)
    ]
    return Page(
        title=f"{len(runs)} runs",
        kicker=f"accerl {runs[0].verb} · comparison",
        state=f"{done} of {len(runs)} finished",
        state_good=done == len(runs),
        headline=_range(runs) if trained else f"{len(runs)} world models",
        lead=f"{', '.join(names)}." if len(runs) <= COLOURS else "",
        outcomes=[],
        tiles=[],
        warnings=warnings,
        sections=[
            *section("runs", "Runs", [_trained(runs, names, now) if trained else _tried(runs, names, now)]),
            *section(
                "curves", "Curves", figures(*(_curves(runs, names) if trained else _depths(runs, names)))
            ),
            *section("recipe", "What sets them apart", [_recipes(runs, names)]),
        ],
    )


def labels(runs: Sequence[Run]) -> list[str]:
    """Each run's folder name, with as many folders above it as it takes to tell them apart."""
    parts = [run.path.resolve().parts for run in runs]
    named = []
    for own in parts:
        depths = range(1, len(own) + 1)
        alone = next(d for d in depths if sum(other[-d:] == own[-d:] for other in parts) == 1)
        named.append("/".join(own[-alone:]))
    return named


def _range(runs: Sequence[Run]) -> str:
    """The span of what they came to; no winner is named, as seeds differ and intervals overlap."""
    ends = [
        (name, success)
        for name, run in zip(labels(runs), runs, strict=True)
        if (success := _end(run)) is not None
    ]
    if not ends:
        return f"{count(len(runs), 'run')}, none of them evaluated yet"
    (worst, low), (best, high) = (pick(ends, key=lambda end: end[1]) for pick in (min, max))
    if low == high:
        return f"{count(len(runs), 'run')}, all with {percent(low)} success"
    return f"Success from {percent(low)} ({worst}) to {percent(high)} ({best})"


def _end(run: Run) -> float | None:
    last = evaluations(run)[-1:]
    return run.result["success_after"] if run.result else last[0]["success"] if last else None


def _trained(runs: Sequence[Run], names: Sequence[str], now: float) -> Table:
    rows = []
    for i, (run, name) in enumerate(zip(runs, names, strict=True)):
        result = run.result or {}
        steps, _ = exploring(run)
        train = run.records.get("train", [])
        lag = column(train, "lag_mean")
        last = evaluations(run)[-1:]
        success, interval = (
            (result["success_after"], result["ci95_after"])
            if result
            else (last[0]["success"], last[0]["ci95"])
            if last
            else (None, None)
        )
        rows.append(
            (
                Cell(text=name, colour=i),
                Cell(text=algorithm(run), number=True),
                Cell(text=str(run.config.get("seed")), number=True),
                rated(result.get("success_before"), result.get("ci95_before")),
                rated(success, interval),
                Cell(
                    text=number(result.get("env_steps", float(steps[-1]) if len(steps) else None)),
                    number=True,
                ),
                Cell(
                    text=f"{number(float(lag.mean()), 2)}, {number(float(column(train, 'lag_max').max()))}"
                    if len(lag)
                    else number(None),
                    number=True,
                ),
                Cell(text=duration(result.get("wall_s", _wall(run))), number=True),
                _state(run, now),
            )
        )
    columns = (
        "run", "algorithm", "seed", "success before", "success after", "env steps", "lag mean, max", "wall",
        "",
    )  # fmt: skip
    return Table(caption="A row a run; 95 % Wilson intervals", columns=columns, rows=rows)


def _tried(runs: Sequence[Run], names: Sequence[str], now: float) -> Table:
    gates = list(dict.fromkeys(gate for run in runs for gate in (run.result or {}).get("checks", {})))
    rows = []
    for i, (run, name) in enumerate(zip(runs, names, strict=True)):
        found = (run.result or {}).get("checks", {})
        cells = [
            Cell(
                text=number(found.get(gate, {}).get("value"), 2),
                good=found.get(gate, {}).get("holds"),
                number=True,
            )
            for gate in gates
        ]
        rows.append((Cell(text=name, colour=i), _state(run, now), *cells))
    return Table(caption="Checks of the validation", columns=("run", "", *gates), rows=rows)


def _state(run: Run, now: float) -> Cell:
    text, good = status(run, now)
    return Cell(text=text, good=good)


def _curves(runs: Sequence[Run], names: Sequence[str]) -> list[Chart]:
    """Beyond what the palette can tell apart without intervals, points stand without them."""
    crowded = len(runs) > COLOURS
    explored, ended, lags = [], [], []
    for i, (run, name) in enumerate(zip(runs, names, strict=True)):
        explored.append(line(name, *exploring(run), colour=i))
        points = evaluated(run, name, i)
        ended.append(replace(points, low=None, high=None) if crowded else points)
        train = run.records.get("train", [])
        lags.append(line(name, column(train, "update"), column(train, "lag_mean"), colour=i))
    x = "env steps of online experience"
    return [
        Chart(
            title="Success in evaluation",
            x_label=x,
            share=True,
            limits=WHOLE,
            wide=True,
            series=_there(ended),
            note="LeRobot's own sampler on seeds that no run trains on"
            + ("." if crowded else ", with 95 % Wilson intervals."),
        ),
        Chart(
            title="Success while exploring",
            x_label=x,
            share=True,
            limits=WHOLE,
            wide=True,
            series=_there(explored),
            note="The policy with its noise, over the newest 100 episodes.",
        ),
        Chart(
            title="Lag", unit="updates", x_label="updates", limits=(0.0, None), wide=True,
            series=_bare(_there(lags)), note="Mean of each batch.",
        ),
    ]  # fmt: skip


def _depths(runs: Sequence[Run], names: Sequence[str]) -> list[Chart]:
    def of(name: str) -> tuple[Series, ...]:
        depths: list[Sequence[Record]] = [(run.result or {}).get("depths", []) for run in runs]
        found = [estimates(rows, name, names[i], i) for i, rows in enumerate(depths)]
        return _there(found)

    return [
        Chart(
            title="Skill where pixels changed",
            x_label=DEPTH,
            limits=(None, 1.0),
            series=of("skill_changed"),
            note="1 is perfect, 0 is a copy of the last frame.",
        ),
        Chart(
            title="Sensitivity to actions",
            unit="times the error",
            x_label=DEPTH,
            limits=(0.0, None),
            series=of("sensitivity_shuffled"),
            note="With another episode's actions; 1 would be a model that ignores them.",
        ),
    ]


def _recipes(runs: Sequence[Run], names: Sequence[str]) -> Block:
    rows = apart([run.config for run in runs])
    if not rows:
        return Words(text="Nothing: their recipes are the same.")
    return Table(
        caption="Fields that are not the same in all of them",
        columns=("field", *names),
        rows=[(Cell(text=field), *(Cell(text=shown(value)) for value in values)) for field, values in rows],
    )


def _there(series: Sequence[Series]) -> tuple[Series, ...]:
    return tuple(s for s in series if len(s.x))


def _bare(series: Sequence[Series]) -> tuple[Series, ...]:
    """Without shades, which hide each other."""
    return tuple(replace(s, low=None, high=None) for s in series)


def _wall(run: Run) -> float | None:
    walls = [newest(records, "wall_s") for records in run.records.values()]
    return max((w for w in walls if w is not None), default=None)
