# SPDX-License-Identifier: Apache-2.0
"""Values for the templates of the pages: of one run, and of several side by side."""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from accerl_lerobot.checkpoint.layout import CHECKPOINTS, CONFIG, LAST, PRETRAINED, SUMMARY
from accerl_lerobot.config.help import shown
from accerl_lerobot.config.parsing import decode
from accerl_lerobot.console import ABSENT, count, duration, number, percent, rate
from accerl_lerobot.engines.config import RunConfig, lag_limits
from accerl_lerobot.errors import ERROR_LOG, InputError, reading
from accerl_lerobot.hub.card import lerobot_eval_command, read_json
from accerl_lerobot.report.charts import Chart, Series, line
from accerl_lerobot.report.read import Record, Run, changed_fields, column, differences, largest, newest
from accerl_lerobot.timeline.read import read_timeline

RECENT_S = 120.0
FEW = 25  # exploring episodes below which their success says nothing; the first to end are the short ones
MISMATCH = 1e-4  # nats between acting and learning at equal weights that rounding in float32 does not explain
LATE = 20  # updates at the end of a run that tell whether its samples are too old
STALE = 0.3
STEPS = "env steps of online experience"
SHARE: dict[str, Any] = {"share": True, "bottom": -0.03, "top": 1.04}
"""Options of a chart of shares, such that points at both ends are whole."""
SAMPLER = "LeRobot's own sampler on seeds that no run trains on, with 95 % Wilson intervals"
EXPLORING = "the policy with its noise, over the newest 100 episodes"
STATE_COLOURS = {
    "compute": "#3a7d44", "wait_in": "#dfe3e8", "wait_out": "#f0b429", "transport": "#5b8def",
    "weights": "#9b5de5", "checkpoint": "#8d6e63", "recovery": "#d64545", "training": "#a8c8a0",
    "evaluation": "#7fb8c9",
}  # fmt: skip
WARNINGS = {
    "restarts": ("restart", "of a rollout worker, which crashed or hung"),
    "dropped_episodes": ("episode", "dropped, because the environment returned NaN or infinity"),
    "dropped_nonfinite": ("decision", "thrown away, because the environment returned NaN or infinity"),
    "replay_evicted_unused": ("segment", "left the replay buffer unused because it was full"),
    "replay_retired_unused": ("segment", "left the replay buffer unused, being older than replay.max_lag"),
    "replay_dropped_nonfinite": ("segment", "refused by the replay buffer because of a NaN or infinity"),
}
"""Counter → what is counted, and what happened; a run in which it is 0 needs no warning."""

Spec = tuple[str, str, dict[str, str], dict[str, Any]]  # title, note, metric → label, and options of a chart
LEARNING: tuple[Spec, ...] = (
    ("Policy loss", "The algorithm's own term.", {"policy_loss": "policy loss"}, {}),
    ("Imitation loss", "LeRobot's training loss.", {"imitation_loss": "imitation loss"}, {}),
    ("Value loss", "Squared error of the critic against the returns.", {"value_loss": "value loss"}, {}),
    ("KL divergence", "How far the policy has left its samples; in the loss, far samples are bounded.",
     {"approx_kl": "unbounded", "kl": "in the loss"}, {"unit": "nats"}),
    ("Samples that count little", "Ratios outside the range of PPO, and samples weighed below a tenth.",
     {"clip_fraction": "outside the clip", "low_weight": "weight below 0.1"}, {"share": True, "bottom": 0}),
    ("Explained variance of the critic", "1 is perfect, 0 a constant; below −1 is not shown.",
     {"explained_variance": "explained variance"}, {"bottom": -1.04, "top": 1.04}),
    ("Gradient norm", "Before each is clipped.", {"grad_norm": "policy", "value_grad_norm": "critic"},
     {"bottom": 0}),
    ("Learning rate", "0 while only the critic learns.", {"lr": "policy"}, {"bottom": 0}),
)  # fmt: skip
MOST_GAP = 0.3  # success of imagined episodes less that of real ones above which a report warns
IMAGINATION: tuple[Spec, ...] = (
    ("Success, imagined and real", "Imagined success far above the real one misleads the policy.",
     {"success_imagined": "imagined", "success_exploring": "real"}, SHARE),
)  # fmt: skip


def one_run(run: Run, now: float) -> dict[str, Any]:
    """Values for ``run.html``, at `now`, in seconds since 1970."""
    unknown = ""
    bound = None
    try:
        if not run.offline:
            bound = lag_limits(decode(RunConfig, run.config))[0]
    except InputError as error:  # another version, or a package of the user's, wrote it
        unknown = str(error)
    curves = [line("while exploring", *exploring(run)), evaluated(run, "evaluation")]
    changed = changed_fields(run.config)
    return {
        "run": run,
        "status": status(run, now),
        "headline": _headline(run),
        "tiles": _tiles(run, bound),
        "warnings": list(warnings(run, bound, now)),
        "success": Chart("Success rate", f"{SAMPLER}; exploring: {EXPLORING}.", STEPS, curves, **SHARE),
        "evaluations": _evaluations(run),
        "commands": _commands(run),
        "imagination": _charts(run.rollout, IMAGINATION) if _imagines(run) else [],
        "lag": _lag(run, bound),
        "shares": _time_shares(run),
        "learning": _charts(run.train, LEARNING),
        "unknown": unknown,
        "changed": [(name, shown(value), shown(default)) for name, (value, default) in changed],
    }


def comparison(runs: Sequence[Run], now: float) -> dict[str, Any]:
    """Values for ``comparison.html``: several runs. No winner is named."""
    names = [run.name for run in runs]
    each = {}
    for name, run in zip(names, runs, strict=True):
        each[name if names.count(name) == 1 else str(run.path)] = run
    notes = []
    for name, run in each.items():
        notes += [f"{name}: {text}" for text in warnings(run, None, now)]
    unlike = differences([run.config for run in runs])
    return {
        "names": list(each),
        "runs": [_compared(name, run, now) for name, run in each.items()],
        "finished": sum(run.result is not None for run in runs),
        "warnings": notes,
        "curves": _curves(each),
        "differences": [(name, *map(shown, values)) for name, values in unlike],
    }


def status(run: Run, now: float) -> str:
    if run.error:
        return "failed"
    if run.result is None:
        return "still going" if now - run.written < RECENT_S else "not finished"
    return "finished"


def warnings(run: Run, bound: int | None, now: float) -> Iterator[str]:
    """Caveats of a run's numbers: one plain sentence each, none if all is well."""
    if run.error:
        yield f"The run failed: {run.error} The traceback is in {ERROR_LOG}."
    elif run.result is None:
        at = datetime.datetime.fromtimestamp(run.written).strftime("%d %B %Y, %H:%M")
        if now - run.written < RECENT_S:
            yield f"The run is still going: there is no {SUMMARY} yet. This page shows it {at}."
        else:
            ago = duration(now - run.written)
            yield f"The run has no {SUMMARY}: it ended early, or waits. It last wrote {at}, {ago} ago."
    if not run.records:
        yield "There are no metrics: the run has not come to its first record."
    if run.truncated:
        yield "The last line of metrics.jsonl is incomplete and left out: the run was writing it, or crashed."
    for name, (thing, what) in WARNINGS.items():
        n = int(newest(run.rollout, name) or 0)
        if n:
            yield f"{count(n, thing)} {what}."
    for evaluation in run.outcomes:
        for note in evaluation.get("notes", ()):
            yield f"Evaluation {evaluation.get('group')}, {note}."
    exploring_note = (run.result or {}).get("note")
    if exploring_note:
        yield f"While exploring, {exploring_note}."
    yield from _warnings_of_learning(run, bound)
    if _imagines(run):
        yield from _warnings_of_imagination(run)


def _warnings_of_learning(run: Run, bound: int | None) -> Iterator[str]:
    skipped = int(newest(run.train, "skipped") or 0)
    if skipped:
        yield f"{count(skipped, 'update')} skipped, because loss or gradient was not finite."
    if newest(run.train, "lr") == 0 and largest(run.train, "lr") == 0:
        yield "The policy was not changed: its learning rate was 0, as in trainer.value_warmup_updates."
    if run.rollout and largest(run.rollout, "success_exploring") == 0:
        yield "No exploring episode succeeded: there was nothing to learn from, unless rewards say more."
    low_weight = _mean(run.train[-LATE:], "low_weight")
    if low_weight is not None and low_weight > STALE:
        share = percent(low_weight)
        yield f"Many samples hardly counted, {share} at the end: too stale, or trainer.lr too high."
    lag = largest(run.train, "lag_max")
    if bound is not None and lag > bound:
        yield f"The lag reached {number(lag)} updates, above the bound of {bound}."
    mismatch = largest(run.train, "logprob/mismatch_max")
    if run.section("policy").get("precision", "fp32") == "fp32" and mismatch > MISMATCH:
        yield f"Acting and learning disagreed by up to {mismatch:.2g} nats at equal weights, beyond rounding."


def _imagines(run: Run) -> bool:
    return bool(run.section("imagination").get("environments"))


def _warnings_of_imagination(run: Run) -> Iterator[str]:
    imagined, real = newest(run.rollout, "success_imagined"), newest(run.rollout, "success_exploring")
    if run.rollout and not newest(run.rollout, "imagined_episodes"):
        yield "No episode was imagined to its end."
    elif imagined is not None and real is not None and imagined - real > MOST_GAP:
        yield (
            f"Imagined episodes succeed far more often than real ones, {percent(imagined)} and "
            f"{percent(real)}: the policy learns to please the world model."
        )


def _evaluations(run: Run) -> list[tuple[str, ...]]:
    """Group, env steps, task, success and episodes of every evaluation."""
    rows: list[tuple[str, ...]] = []
    for e in run.evaluations:
        tasks = dict(e.get("tasks") or {})
        if len(tasks) != 1:
            tasks["all"] = e
        for task, one in tasks.items():
            success = rate(one["success"], one["ci95"])
            rows.append((str(e.get("group")), number(e["env_steps"]), task, success, number(one["n"])))
    return rows


def exploring(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Env steps since training began, and the success of the newest exploring episodes.

    Counters of workers include the evaluation before training, which is subtracted: its episodes times their
    mean length.
    """
    steps = column(run.rollout, "env_steps")
    episodes = column(run.rollout, "episodes")
    for e in run.evaluated("before"):
        steps = steps - e["steps_mean"] * e["n"]
        episodes = episodes - e["n"]
    if run.result is not None:  # workers go on during the final evaluation
        steps = np.where(steps <= run.result.get("env_steps", np.inf), steps, np.nan)
    return steps, np.where(episodes >= FEW, column(run.rollout, "success_exploring"), np.nan)


def evaluated(run: Run, name: str) -> Series:
    """Success of the evaluations, with intervals."""
    ends = np.array([e["ci95"] for e in run.evaluations], dtype=np.float64).reshape(-1, 2)
    x = column(run.evaluations, "env_steps")
    y = column(run.evaluations, "success")
    return Series(name, x, y, ends[:, 0], ends[:, 1], points=True)


def _commands(run: Run) -> list[tuple[str, str]]:
    """Uses of the run's policy, and the commands for them."""
    policy = run.path.resolve() / CHECKPOINTS / LAST / PRETRAINED
    if not policy.is_dir():
        return []
    rows = []
    with reading("runs", str(run.path), f"{CHECKPOINTS}/{LAST}/{PRETRAINED}/config.json or {CONFIG}"):
        stock = lerobot_eval_command(str(policy), read_json(policy / "config.json"), run.section("env"))
    if stock:
        rows.append(("Evaluate the newest checkpoint with LeRobot alone:", stock))
    rows.append(("Publish it:", f"accerl push --path={policy} --repo_id=USER/NAME"))
    return rows


def _lag(run: Run, bound: int | None) -> Chart:
    update = column(run.train, "update")
    names = {"lag_mean": "mean of a batch", "lag_max": "largest"}
    lags = [line(label, update, column(run.train, name)) for name, label in names.items()]
    note = "Age of the weights that decided."
    if bound is not None:
        note += f" Dashed: the bound of the recipe, {bound}."
    return Chart("Lag", note, "updates", lags, unit="updates", limit=bound, bottom=0)


def _time_shares(run: Run) -> dict[str, dict[str, float]]:
    """How the time of each role divides in the training; nothing without a timeline."""
    try:
        timeline = read_timeline(run.path)
    except InputError:
        return {}
    shares = timeline.shares(timeline.training())
    shares.pop("driver", None)  # which neither works nor waits
    return shares


def _charts(records: Sequence[Record], specs: Sequence[Spec]) -> list[Chart]:
    update = column(records, "update")
    charts = []
    for title, note, names, options in specs:
        lines = [line(label, update, column(records, name)) for name, label in names.items()]
        charts.append(Chart(title, note, "updates", lines, **options))
    return charts


def _mean(records: Sequence[Record], name: str) -> float | None:
    values = column(records, name)
    return float(np.nanmean(values)) if np.isfinite(values).any() else None


def _headline(run: Run) -> str:
    if run.offline:
        losses = column(run.train, "imitation_loss")
        losses = losses[np.isfinite(losses)]
        change = f": imitation loss {number(losses[0])} → {number(losses[-1])}" if len(losses) else ""
        made = int(newest(run.train, "update") or 0)
        return f"{count(made, 'update')} on recorded episodes{change}"
    tasks = _tasks(run)
    if run.result is None or not run.outcomes:
        share = newest(run.rollout, "success_exploring")
        so_far = "" if share is None else f", with {percent(share)} success while exploring"
        of = run.section("trainer").get("updates")
        return f"{len(run.train)} of {of} updates on {tasks} so far{so_far}"
    *before, after = run.outcomes
    new = after["success"]
    if not before:
        return f"{percent(new)} success on {tasks} after training"
    old = before[0]["success"]
    if old == new:
        return f"Success on {tasks} stayed at {percent(new)}"
    change = f"from {percent(old)} to {percent(new)}"
    low, high = before[0]["ci95"]
    if after["ci95"][0] <= high and low <= after["ci95"][1]:
        return f"Success on {tasks} went {change}, and the intervals overlap"
    return f"Success on {tasks} {'rose' if new > old else 'fell'} {change}"


def _tasks(run: Run) -> str:
    """The run's task, or how many it has."""
    names = list((run.result or {}).get("tasks") or ())
    if not names and run.evaluations:
        names = list(run.evaluations[-1].get("tasks") or ())
    if len(names) > 1:
        return count(len(names), "task")
    env = run.section("env")
    return str(names[0] if names else env.get("task") or env.get("name") or env.get("type"))


def _tiles(run: Run, bound: int | None) -> list[tuple[str, str, str]]:
    result = run.result or {}
    tiles = []
    for e in run.outcomes:
        interval = rate(e["success"], e["ci95"]).partition("[")[2]
        tiles.append((f"success {e.get('group')}", percent(e["success"]), f"[{interval} %, n = {e['n']}"))
    episodes = number(result.get("episodes", newest(run.rollout, "episodes")))
    if run.offline:
        tiles.append(("episodes", episodes, f"{number(result.get('successes'))} successes"))
    else:
        seen = exploring(run)[0].tolist()
        steps = result.get("env_steps", seen[-1] if seen else None)
        lag = f"largest {number(largest(run.train, 'lag_max'))}, bound {number(bound)}"
        tiles.append(("env steps", number(steps), f"{episodes} episodes"))
        tiles.append(("lag", number(_mean(run.train, "lag_mean"), 2), lag))
    parts = {"warm start": result.get("warm_start_s") or 0.0, "RL": result.get("rl_s") or 0.0}
    spent = ", ".join(f"{name} {duration(seconds)}" for name, seconds in parts.items() if seconds >= 1)
    updates = number(result.get("updates", len(run.train)))
    return [
        *tiles,
        ("wall time", duration(run.wall_s), spent),
        ("updates", updates, f"of {run.section('trainer').get('updates')}"),
        ("algorithm", str(run.section("algorithm").get("type")), f"seed {run.config.get('seed')}"),
    ]


def _compared(name: str, run: Run, now: float) -> tuple[str, ...]:
    """A run's row in the table of several."""
    success = []
    for ends in (run.evaluated("before")[:1], run.outcomes[-1:]):
        success.append(rate(ends[0]["success"], ends[0]["ci95"]) if ends else ABSENT)
    tiles = {key: value for key, value, _ in _tiles(run, None)}
    numbers = [tiles.get(key, ABSENT) for key in ("env steps", "lag", "wall time")]
    return name, *success, tiles["algorithm"], str(run.config.get("seed")), *numbers, status(run, now)


def _curves(runs: Mapping[str, Run]) -> list[Chart]:
    """Success and lag of several runs."""
    ended = [evaluated(run, name) for name, run in runs.items()]
    explored = [line(name, *exploring(run)) for name, run in runs.items()]
    lags = [
        line(name, column(run.train, "update"), column(run.train, "lag_mean")) for name, run in runs.items()
    ]
    return [
        Chart("Success in evaluation", f"{SAMPLER}.", STEPS, ended, **SHARE),
        Chart("Success while exploring", f"{EXPLORING.capitalize()}.", STEPS, explored, **SHARE),
        Chart("Mean lag", "", "updates", lags, unit="updates", bottom=0),
    ]
