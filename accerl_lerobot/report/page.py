# SPDX-License-Identifier: Apache-2.0
"""Values for the template of the page, about one run or several side by side, and charts by matplotlib."""

from __future__ import annotations

import base64
import contextlib
import datetime
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np

from accerl_lerobot import __version__
from accerl_lerobot.checkpoint.layout import SUMMARY
from accerl_lerobot.config.help import shown
from accerl_lerobot.config.parsing import decode
from accerl_lerobot.console import ABSENT, count, duration, number, percent, rate
from accerl_lerobot.engines.config import RunConfig, lag_limits
from accerl_lerobot.errors import ERROR_LOG, InputError
from accerl_lerobot.evaluation import STEPS, Chart, Series, evaluations_over_steps
from accerl_lerobot.report.read import Record, Run, changed_fields, column, differences, finite, newest
from accerl_lerobot.timeline import read_timeline

VIDEO_MB = 20
FEW = 25  # exploring episodes below which their success says nothing; the first to end are the short ones
LATE = 20  # updates at the end of a run that tell whether its samples are too old
STALE = 0.3
MOST_GAP = 0.3  # success of imagined episodes less that of real ones above which a report warns
MEASURED = (
    "Evaluation is with LeRobot's own sampler on seeds that no run trains on, with 95 % Wilson intervals. "
    "While exploring, the policy has its noise, and success is that of the newest 100 episodes."
)
WARNINGS = {
    "restarts": "restarts of a rollout worker, which crashed or hung",
    "dropped_episodes": "episodes dropped, because the environment returned NaN or infinity",
    "dropped_nonfinite": "decisions thrown away, because the environment returned NaN or infinity",
    "replay_evicted_unused": "segments left the replay buffer unused because it was full",
    "replay_retired_unused": "segments left the replay buffer unused, being older than replay.max_lag",
    "replay_dropped_nonfinite": "segments refused by the replay buffer because of a NaN or infinity",
    "skipped": "updates skipped, because loss or gradient was not finite",
}
"""Counter → what it counts; a run in which it is 0 needs no warning."""
LEARNING = (
    ("policy_loss",), ("imitation_loss",), ("value_loss",), ("approx_kl", "kl"),
    ("clip_fraction", "low_weight"), ("explained_variance",), ("grad_norm", "value_grad_norm"), ("lr",),
)  # fmt: skip
"""Metrics of each chart of learning."""


def over_updates(records: Sequence[Record], names: Sequence[str], **options: Any) -> Chart:
    """A chart of some numbers of records."""
    updates = column(records, "update")
    series = {name: Series(updates, column(records, name)) for name in names}
    return Chart(", ".join(names), "updates", series, **options)


class Block(NamedTuple):
    """A chapter of the page; what is empty is not shown."""

    title: str
    charts: Sequence[Chart] = ()
    columns: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    videos: Sequence[Path] = ()
    shares: dict[str, dict[str, float]] | None = None
    note: str = ""
    text: str = ""


def html(page: dict[str, Any], folder: Path) -> str:
    """The template filled in, as a page in this folder."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("accerl_lerobot", "report"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters["percent"] = percent
    environment.filters["base64"] = lambda data: base64.b64encode(data).decode()
    environment.filters["address"] = lambda path: quote(os.path.relpath(path.resolve(), folder))
    return environment.get_template("page.html").render(**page, version=__version__, video_mb=VIDEO_MB)


def one_run(run: Run) -> dict[str, Any]:
    """Values of a page about one run."""
    bound = None
    with contextlib.suppress(InputError):  # another version, or a package of the user's, may have written it
        if not run.offline:
            bound = lag_limits(decode(RunConfig, run.config))[0]
    success = {"while exploring": exploring(run), "evaluation": evaluations_over_steps(run.evaluations)}
    imagined = []
    if len(finite(run.rollout, "success_imagined")):
        imagined = [over_updates(run.rollout, ("success_imagined", "success_exploring"), share=True)]
    facts = _facts(run)
    if bound is not None:
        facts["bound of the lag"] = f"{bound} updates"
    changed = changed_fields(run.config)
    verb = "offline" if run.offline else "train"
    blocks = [
        Block(
            "Success and staleness",
            charts=[
                Chart("Success rate", STEPS, success, share=True),
                over_updates(run.train, ("lag_mean", "lag_max"), limit=bound),
            ],
            note=f"{MEASURED} The dashed line is the bound of the recipe for the lag.",
        ),
        Block("Evaluations", columns=("", "env steps", "task", "success", "n"), rows=_evaluations(run)),
        Block("Videos", videos=run.videos),
        Block("Imagined rollouts", charts=imagined),
        Block("Time of each role while training", shares=_time_shares(run)),
        Block("Learning", charts=[over_updates(run.train, names) for names in LEARNING]),
        Block(
            "Recipe: fields that differ from the defaults",
            columns=("field", "value", "default"),
            rows=[(name, shown(value), shown(default)) for name, (value, default) in changed],
            text=run.config_text,
        ),
    ]
    return {
        "about": f"accerl {verb} · {run.name} · {status(run)}",
        "title": _headline(run),
        "facts": facts,
        "warnings": list(warnings(run)),
        "blocks": blocks,
    }


def comparison(runs: Sequence[Run]) -> dict[str, Any]:
    """Values of a page about several runs. No winner is named."""
    each = {str(run.path): run for run in runs}
    rows = []
    notes = []
    for name, run in each.items():
        rows.append((name, *_facts(run).values(), status(run)))
        notes += [f"{name}: {text}" for text in warnings(run)]
    evaluations = {name: evaluations_over_steps(run.evaluations) for name, run in each.items()}
    explored = {name: exploring(run) for name, run in each.items()}
    unlike = differences([run.config for run in runs])
    blocks = [
        Block("Runs", columns=("run", *_facts(runs[0]), "status"), rows=rows),
        Block(
            "Success",
            charts=[
                Chart("In evaluation", STEPS, evaluations, share=True),
                Chart("While exploring", STEPS, explored, share=True),
            ],
            note=MEASURED,
        ),
        Block(
            "Recipes: fields that are not the same in all of them",
            columns=("field", *each),
            rows=[(name, *map(shown, values)) for name, values in unlike],
        ),
    ]
    finished = sum(bool(run.result) for run in runs)
    return {
        "about": f"accerl report · {finished} of {len(runs)} finished",
        "title": count(len(runs), "training run"),
        "facts": {},
        "warnings": notes,
        "blocks": blocks,
    }


def status(run: Run) -> str:
    if run.error:
        return "failed"
    return "finished" if run.result else "not finished"


def warnings(run: Run) -> Iterator[str]:
    """Caveats of a run's numbers: one plain sentence each, none if all is well."""
    if run.error:
        yield f"The run failed: {run.error} The traceback is in {ERROR_LOG}."
    elif not run.result:
        at = datetime.datetime.fromtimestamp(run.written).strftime("%d %B %Y, %H:%M")
        yield f"The run is not finished: there is no {SUMMARY}. It last wrote at {at}."
    for name, what in WARNINGS.items():
        n = newest(run.rollout, name) or newest(run.train, name)
        if n:
            yield f"{n:,.0f} {what}."
    for evaluation in (run.before, run.newest):
        for note in evaluation.get("notes", ()):
            yield f"Evaluation {evaluation.get('group')}, {note}."
    if run.result.get("note"):
        yield f"While exploring, {run.result['note']}."
    if run.rollout and not finite(run.rollout, "success_exploring").any():
        yield "No exploring episode succeeded: there was nothing to learn from, unless rewards say more."
    low_weight = finite(run.train[-LATE:], "low_weight")
    if len(low_weight) and low_weight.mean() > STALE:
        share = percent(float(low_weight.mean()))
        yield f"Many samples hardly counted, {share} at the end: too stale, or trainer.lr too high."
    imagined = newest(run.rollout, "success_imagined")
    real = newest(run.rollout, "success_exploring")
    if imagined is not None and real is not None and imagined - real > MOST_GAP:
        rates = f"{percent(imagined)} and {percent(real)}"
        yield f"Imagined episodes succeed far more often than real ones, {rates}: the world model misleads."


def _evaluations(run: Run) -> list[tuple[str, ...]]:
    """Group, env steps, task, success and episodes of every evaluation."""
    rows: list[tuple[str, ...]] = []
    for e in run.evaluations:
        tasks = dict(e.get("tasks") or {})
        if len(tasks) != 1:
            tasks["all"] = e
        for task, one in tasks.items():
            steps = number(e["env_steps"])
            rows.append((str(e.get("group")), steps, task, success_of(one), number(one["n"])))
    return rows


def success_of(evaluation: Record) -> str:
    """Success of an evaluation, or of a task in it, with its interval; a dash where there is none."""
    return rate(evaluation.get("success"), evaluation.get("ci95"))


def exploring(run: Run) -> Series:
    """Success of the newest exploring episodes over the env steps since training began.

    Counters of workers include the evaluation before training, which is subtracted: its episodes times their
    mean length.
    """
    steps = column(run.rollout, "env_steps")
    episodes = column(run.rollout, "episodes")
    if run.before:
        n = run.before["n"]
        steps = steps - run.before["steps_mean"] * n
        episodes = episodes - n
    last = run.result.get("env_steps", np.inf)  # workers go on during the final evaluation
    counts = (episodes >= FEW) & (steps <= last)
    return Series(steps[counts], column(run.rollout, "success_exploring")[counts])


def _time_shares(run: Run) -> dict[str, dict[str, float]]:
    """How the time of each role divides in the training; nothing without a timeline."""
    try:
        timeline = read_timeline(run.path)
    except InputError:
        return {}
    shares = timeline.shares(timeline.training())
    shares.pop("driver", None)  # which neither works nor waits
    return shares


def _headline(run: Run) -> str:
    made = int(newest(run.train, "update") or 0)
    if run.offline:
        losses = finite(run.train, "imitation_loss")
        ends = ABSENT
        if len(losses):
            ends = f"{number(losses[0])} → {number(losses[-1])}"
        return f"{count(made, 'update')} on recorded episodes: imitation loss {ends}"
    if not run.result:
        return f"{made} of {run.section('trainer').get('updates')} updates on {_tasks(run)}"
    rates = [success_of(evaluation) for evaluation in (run.before, run.newest) if evaluation]
    return f"Success on {_tasks(run)}: {' → '.join(rates)}"


def _tasks(run: Run) -> str:
    """The run's task, or how many it has."""
    last = run.evaluations[-1] if run.evaluations else {}
    names = list(last.get("tasks") or ())
    if len(names) > 1:
        return count(len(names), "task")
    env = run.section("env")
    return str(names[0] if names else env.get("task") or env.get("name") or env.get("type"))


def _facts(run: Run) -> dict[str, str]:
    """Numbers at the top of a page, and of a run's row in the table of several."""
    result = run.result
    steps = result.get("env_steps")
    seen = exploring(run).x
    if steps is None and len(seen):
        steps = seen[-1]
    episodes = newest(run.rollout, "episodes")
    if episodes is not None and run.before:
        episodes -= run.before["n"]
    mean_lag = None
    lags = finite(run.train, "lag_mean")
    if len(lags):
        mean_lag = float(lags.mean())
    return {
        "success before": success_of(run.before),
        "success": success_of(run.newest),
        "algorithm": str(run.section("algorithm").get("type")),
        "seed": str(run.config.get("seed")),
        "updates": number(result.get("updates", newest(run.train, "update"))),
        "episodes": number(result.get("episodes", episodes)),
        "env steps": number(steps),
        "mean lag": number(mean_lag, 2),
        "wall time": duration(result.get("wall_s", newest(run.train, "wall_s"))),
    }
