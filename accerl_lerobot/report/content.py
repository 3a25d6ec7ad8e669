# SPDX-License-Identifier: Apache-2.0
"""Contents of the pages: of one training run, and of several side by side."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from accerl_lerobot.checkpoint.layout import CHECKPOINTS, CONFIG, LAST, PRETRAINED, SUMMARY
from accerl_lerobot.config.help import shown
from accerl_lerobot.config.parsing import decode
from accerl_lerobot.console import ABSENT, count, duration, number, percent, rate
from accerl_lerobot.engine.config import RunConfig, lag_limits
from accerl_lerobot.errors import ERROR_LOG, InputError, reading
from accerl_lerobot.hub.card import lerobot_eval_command, read_json
from accerl_lerobot.report.charts import COLOURS, Chart, Series, line, rates
from accerl_lerobot.report.read import Record, Run, apart, column, differences, newest
from accerl_lerobot.timeline.read import COLOURS as STATE_COLOURS
from accerl_lerobot.timeline.read import read_timeline

RECENT_S = 120.0
FEW = 25  # exploring episodes below which their success says nothing; the first to end are the short ones
MISMATCH = 1e-4  # nats between acting and learning at equal weights that rounding in float32 does not explain
STEPS = "env steps of online experience"
SHARE: dict[str, Any] = {"share": True, "bottom": -0.03, "top": 1.04}
"""Options of a chart of shares, such that points at both ends are whole."""
FILM = (
    "The same episodes before training, left, and after it, right, under the success of the evaluation. The "
    "frame at the end of a clip is green for a success and red for a failure."
)
WARNINGS = {
    "restarts": ("restart", "of a rollout worker, which crashed or hung"),
    "dropped_episodes": ("episode", "dropped, because the environment returned NaN or infinity"),
    "dropped_nonfinite": ("decision", "thrown away, because the environment returned NaN or infinity"),
    "replay_evicted_unused": ("segment", "left the replay buffer unused because it was full"),
    "replay_retired_unused": ("segment", "left the replay buffer unused, being older than replay.max_lag"),
    "replay_dropped_nonfinite": ("segment", "refused by the replay buffer because of a NaN or infinity"),
}
"""Counter → what is counted, and what happened; a run in which it is 0 needs no warning."""

LATE = 20  # updates at the end over which `WORRIES` are looked at
WORRIES: dict[str, tuple[Callable[[float], bool], str]] = {
    "low_weight": (lambda x: x > 0.3, "Many samples hardly counted: too stale, or trainer.lr too high"),
    "explained_variance": (
        lambda x: x < -0.05,
        "The critic explained less of the returns than their mean does",
    ),
}
"""Metric → when it points to a problem, and to which."""

Spec = tuple[str, str, dict[str, str], dict[str, Any]]  # title, note, metric → label, and options of a chart
LEARNING: tuple[Spec, ...] = (
    ("Policy loss", "The algorithm's own term.", {"policy_loss": "policy loss"}, {}),
    ("Imitation loss", "LeRobot's training loss.", {"imitation_loss": "imitation loss"}, {}),
    ("Value loss", "Squared error of the critic against the returns.", {"value_loss": "value loss"}, {}),
    ("KL divergence", "How far the policy has left its samples; in the loss, far samples are bounded.",
     {"approx_kl": "unbounded", "kl": "in the loss"}, {"unit": "nats"}),
    ("Samples that count little", "Ratios outside the range of PPO, and samples weighed below a tenth.",
     {"clip_fraction": "outside the clip", "low_weight": "weight below 0.1"}, {"share": True, "bottom": 0}),
    ("Effective sample size", "100 %: all samples count alike.", {"ess": "share of the batch"}, SHARE),
    ("Explained variance of the critic", "1 is perfect, 0 a constant; below −1 is not shown.",
     {"explained_variance": "explained variance"}, {"bottom": -1.04, "top": 1.04}),
    ("Gradient norm", "Before each is clipped.", {"grad_norm": "policy", "value_grad_norm": "critic"},
     {"bottom": 0}),
    ("Return", "Mean of the returns that the critic is regressed to.", {"return_mean": "return"}, {}),
    ("Learning rate", "0 while only the critic learns.", {"lr": "policy"}, {"bottom": 0}),
)  # fmt: skip
INFERENCE: tuple[Spec, ...] = (
    ("Requests decided together", "Mean since the start.", {"inference_batch_size_mean": "observations"},
     {"unit": "observations a forward pass", "bottom": 0}),
    ("Wait of a request", "From its arrival to its forward pass, mean since the start.",
     {"inference_wait_mean_s": "seconds"}, {"unit": "s", "bottom": 0}),
)  # fmt: skip
IMAGINATION: tuple[Spec, ...] = (
    ("Success, imagined and real", "Imagined success far above the real one misleads the policy.",
     {"imagination_success": "imagined", "imagination_success_real": "real",
      "imagination_success_imagined": "imagined, weighted as the real outcomes"}, SHARE),
    ("Imagined share", "", {"replay_imagined_share": "of a batch"}, SHARE),
    ("Real episodes that the world model has learned from", "",
     {"imagination_learn_episodes": "episodes"}, {"bottom": 0}),
    ("Skill of the world model", "At each validation: 1 is perfect, 0 a copy of the last frame.",
     {"imagination_check_skill_changed_first": "after one chunk",
      "imagination_check_skill_changed_last": "at the horizon"}, {"top": 1}),
)  # fmt: skip


Table = tuple[str, Sequence[str], Sequence[Sequence[str]]]
"""Caption, columns and rows; the first cell of a row is its heading."""


@dataclass(frozen=True)
class Section:
    """A heading and what is under it, in this order."""

    title: str
    text: str = ""
    _: KW_ONLY
    bars: Mapping[str, Sequence[tuple[str, float, str, str]]] = field(default_factory=dict)
    """Role → name, share, text and colour of the parts of its time."""
    charts: Sequence[Chart] = ()
    tables: Sequence[Table] = ()
    videos: Sequence[tuple[Path, str]] = ()
    details: str = ""

    @property
    def empty(self) -> bool:
        rest = (self.text, self.bars, self.tables, self.videos, self.details)
        return not any(rest) and not any(chart.drawable for chart in self.charts)


def run_page(run: Run, now: float) -> dict[str, Any]:
    """Values for the template: the page of one run, at `now`, in seconds since 1970."""
    text, bound = "", None
    try:
        bound = None if run.offline else lag_limits(decode(RunConfig, run.config))[0]
    except InputError as error:  # another version, or a package of the user's, wrote it
        text = f"This accerl does not know all of the recipe's types or fields: {error}."
    rows = [(name, shown(value), shown(default)) for name, value, default in differences(run.config)]
    tables = [("Fields that differ from the defaults", ("field", "value", "default"), rows)] if rows else []
    videos = [(path, FILM if path.stem == "before_after" else path.name) for path in run.videos]
    success, *others = _training_sections(run, bound)
    sections = [
        success,
        Section("Videos", videos=videos),
        Section("Policy", tables=_uses(run)),
        *others,
        Section("Recipe", text, tables=tables, details=run.config_text),
    ]
    return {
        "verb": "offline" if run.offline else "train",
        "title": run.name,
        "status": status(run, now),
        "headline": _headline(run),
        "tiles": _tiles(run, bound),
        "warnings": list(warnings(run, bound, now)),
        "sections": [section for section in sections if not section.empty],
    }


def _uses(run: Run) -> list[Table]:
    policy = run.path.resolve() / CHECKPOINTS / LAST / PRETRAINED
    if not policy.is_dir():
        return []
    rows = [("publish it", f"accerl push --path={policy} --repo_id=USER/NAME")]
    with reading("runs", str(run.path), f"{CHECKPOINTS}/{LAST}/{PRETRAINED}/config.json or {CONFIG}"):
        stock = lerobot_eval_command(str(policy), read_json(policy / "config.json"), run.section("env"))
    if stock:
        rows.insert(0, ("evaluate it with LeRobot alone", stock))
    return [(f"{policy}, a LeRobot checkpoint", ("", "command"), rows)]


def comparison_page(runs: Sequence[Run], now: float) -> dict[str, Any]:
    """Values for the template: several runs of ``accerl train``. No winner is named."""
    names = [run.name for run in runs]
    names = [name if names.count(name) == 1 else str(run.path) for name, run in zip(names, runs, strict=True)]
    each = dict(zip(names, runs, strict=True))
    rows = [(name, *map(shown, values)) for name, values in apart([run.config for run in runs])]
    tables = [("Fields that are not the same in all of them", ("field", *names), rows)] if rows else []
    sections = [
        Section("Runs", tables=[_run_table(each, now)]),
        Section("Curves", charts=_curves(each)),
        Section("Differences", "" if rows else "Their recipes are the same.", tables=tables),
    ]
    return {
        "verb": "train",
        "title": f"{len(runs)} runs",
        "status": f"{sum(run.result is not None for run in runs)} of {len(runs)} finished",
        "headline": count(len(runs), "training run"),
        "tiles": (),
        "warnings": [f"{name}: {text}" for name, run in each.items() for text in warnings(run, None, now)],
        "sections": [section for section in sections if not section.empty],
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
        age = now - run.written
        at = datetime.datetime.fromtimestamp(run.written).strftime("%d %B %Y, %H:%M")
        if age < RECENT_S:
            yield f"The run is still going: there is no {SUMMARY} yet. This page shows it {at}."
        else:
            ago = f"It last wrote {at}, {duration(age)} ago."
            yield f"The run has no {SUMMARY}: it ended early, or waits. {ago}"
    if not run.records:
        yield "There are no metrics: the run has not come to its first record."
    if run.truncated:
        yield "The last line of metrics.jsonl is incomplete and left out: the run was writing it, or crashed."
    for name, (thing, what) in WARNINGS.items():
        if n := int(newest(run.rollout, name) or 0):
            yield f"{count(n, thing)} {what}."
    for evaluation in run.outcomes:
        for note in evaluation.get("notes", ()):
            yield f"Evaluation {evaluation.get('group')}, {note}."
    if note := (run.result or {}).get("note"):
        yield f"While exploring, {note}."
    if skipped := int(newest(run.train, "skipped") or 0):
        yield f"{count(skipped, 'update')} skipped, because loss or gradient was not finite."
    if run.train and newest(run.train, "lr") == np.nanmax([0.0, *column(run.train, "lr")]) == 0:
        yield "The policy was not changed: its learning rate was 0, as in trainer.value_warmup_updates."
    if len(run.rollout) and np.nanmax([0.0, *column(run.rollout, "success_exploring")]) == 0:
        yield "No exploring episode succeeded: there was nothing to learn from, unless rewards say more."
    late = run.train[-LATE:] if len(run.train) > LATE else []
    for name, (worse, what) in WORRIES.items():
        values = column(late, name)
        if np.isfinite(values).any() and worse(value := float(np.nanmean(values))):
            yield f"{what} (mean of the last {count(len(late), 'update')}: {number(value, 2)})."
    lag, mismatch = (np.nanmax([0.0, *column(run.train, k)]) for k in ("lag_max", "logprob/mismatch_max"))
    if bound is not None and lag > bound:
        yield f"The lag reached {number(lag)} updates, above the bound of {bound}."
    if run.section("policy").get("precision", "fp32") == "fp32" and mismatch > MISMATCH:
        yield f"Acting and learning disagreed by up to {mismatch:.2g} nats at equal weights, beyond rounding."
    if run.section("imagination").get("share"):
        rollouts = newest(run.rollout, "imagination_rollouts")
        means = [percent(newest(run.rollout, f"imagination_success_{of}")) for of in ("imagined", "real")]
        if rollouts and newest(run.rollout, "imagination_on") == 0:
            yield f"Imagination was switched off: {means[0]} success imagined, {means[1]} in reality."
        elif run.rollout and not rollouts and not newest(run.rollout, "imagination_promoted"):
            yield "No rollout was imagined: no world model passed validation."


def _charts(records: Sequence[Record], specs: Sequence[Spec]) -> list[Chart]:
    update = column(records, "update")
    charts = []
    for title, note, names, options in specs:
        lines = [line(label, update, column(records, key), i) for i, (key, label) in enumerate(names.items())]
        charts.append(Chart(title, note, "updates", lines, **options))
    return charts


def _training_sections(run: Run, bound: int | None) -> list[Section]:
    note = "LeRobot's own sampler on seeds that no run trains on, with 95 % Wilson intervals; exploring: the "
    note += "policy with its noise, over the newest 100 episodes."
    curves = [line("while exploring", *exploring(run), 7), evaluated(run, "evaluation", 0)]
    rows = []
    for e in run.evaluations:
        tasks = e.get("tasks") or {}
        for task, one in (tasks if len(tasks) == 1 else tasks | {"all": e}).items():
            success = rate(one["success"], one["ci95"])
            rows.append((str(e.get("group")), number(e["env_steps"]), task, success, number(one["n"])))
    table = ("Evaluations, with 95 % Wilson intervals", ("", "env steps", "task", "success", "n"), rows)
    update, mean, largest = (column(run.train, name) for name in ("update", "lag_mean", "lag_max"))
    lags = [line("mean of a batch", update, mean), line("largest", update, largest, 1)]
    dashed = "" if bound is None else f" Dashed: the bound of the recipe, {bound}."
    options: dict[str, Any] = {"unit": "updates", "limit": bound, "bottom": 0, "wide": True}
    lag = Chart("Lag", f"Age of the weights that decided.{dashed}", "updates", lags, **options)
    chart = Chart("Success rate", note, STEPS, curves, wide=True, **SHARE)
    return [
        Section("Success", charts=[chart], tables=[table] if rows else []),
        _imagination(run),
        Section("Staleness", charts=[lag]),
        _speed(run),
        Section("Learning", charts=_charts(run.train, LEARNING)),
    ]


def exploring(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Env steps since training began, and the success of the newest exploring episodes.

    Counters of workers include the evaluation before training, which is subtracted: its episodes times their
    mean length.
    """
    before = [e for e in run.evaluations if e.get("group") == "before"]
    steps = column(run.rollout, "env_steps") - sum(e["steps_mean"] * e["n"] for e in before)
    episodes = column(run.rollout, "episodes") - sum(e["n"] for e in before)
    if run.result is not None:  # workers go on during the final evaluation
        steps = np.where(steps <= run.result.get("env_steps", np.inf), steps, np.nan)
    return steps, np.where(episodes >= FEW, column(run.rollout, "success_exploring"), np.nan)


def evaluated(run: Run, name: str, colour: int) -> Series:
    ends = np.array([e["ci95"] for e in run.evaluations], dtype=np.float64).reshape(-1, 2)
    x, y = column(run.evaluations, "env_steps"), column(run.evaluations, "success")
    return Series(name, x, y, colour, ends[:, 0], ends[:, 1], points=True)


def _imagination(run: Run) -> Section:
    """Imagined rollouts: how many, how true, and how often the world model passed validation."""
    title, settings, rollout = "Imagined rollouts", run.section("imagination"), run.rollout
    if not settings.get("share") or newest(rollout, "imagination_rollouts") is None:
        return Section(title)
    names = ("rollouts", "decisions", "successes", "uncertain", "promoted", "rejected")
    total, decisions, successes, uncertain, passed, failed = (
        int(newest(rollout, f"imagination_{name}") or 0) for name in names
    )
    text = f"{count(total, 'imagined rollout')} of {count(decisions, 'decision')}; "
    text += f"{percent(successes / total if total else None)} of them succeeded"
    text += f", and {uncertain:,} ended early because the model was too uncertain." if uncertain else "."
    if passed + failed:
        text += f" The world model passed {passed} of {count(passed + failed, 'validation')}."
    real, imagined = (newest(rollout, f"replay_{kind}trained_decisions") or 0.0 for kind in ("", "imagined_"))
    if real + imagined:
        text += f" {percent(imagined / (real + imagined))} of the decisions learned from were imagined."
    return Section(title, text, charts=_charts(rollout, IMAGINATION))


def _time_shares(run: Run) -> dict[str, list[tuple[str, float, str, str]]]:
    """How the time of each role divides in the training, as `Section.bars`; nothing without a timeline."""
    try:
        timeline = read_timeline(run.path)
    except InputError:
        return {}
    shares = timeline.shares(timeline.training())
    return {
        role: [(state.replace("_", " "), v, percent(v), STATE_COLOURS[state]) for state, v in own.items()]
        for role, own in shares.items()
        if role != "driver"  # which neither works nor waits
    }


def _mean(records: Sequence[Record], name: str) -> float | None:
    values = column(records, name)
    return float(np.nanmean(values)) if np.isfinite(values).any() else None


def _speed(run: Run) -> Section:
    x_label, counters = "minutes since the workers began to start", ("env_steps", "decisions")
    curves = {name: (column(run.rollout, "wall_s"), column(run.rollout, name)) for name in counters}
    curves["updates"] = (column(run.train, "wall_s"), column(run.train, "update"))
    charts = []
    for key, (seconds, counter) in curves.items():
        name = key.replace("_", " ")
        series = [rates(name, seconds, counter)]
        charts.append(Chart(name.capitalize(), "", x_label, series, unit="per second", bottom=0))
    charts += _charts(run.rollout, INFERENCE) if np.nansum(column(run.train, "wait_s")) else []
    return Section("Speed", bars=_time_shares(run), charts=charts)


def _headline(run: Run) -> str:
    if run.offline:
        losses = column(run.train, "imitation_loss")
        losses = losses[np.isfinite(losses)]
        change = f": imitation loss {number(losses[0])} → {number(losses[-1])}" if len(losses) else ""
        made = int(newest(run.train, "update") or 0)
        return f"{count(made, 'update')} on recorded episodes{change}"
    last, env = run.evaluations[-1:], run.section("env")
    names = (run.result or {}).get("tasks") or sorted((last[0].get("tasks") if last else None) or ())
    names = names or [env.get("task") or env.get("name") or env.get("type")]
    tasks = str(names[0]) if len(names) == 1 else count(len(names), "task")
    if run.result is None or not run.outcomes:
        share = newest(run.rollout, "success_exploring")
        so_far = "" if share is None else f", with {percent(share)} success while exploring"
        of = run.section("trainer").get("updates")
        return f"{len(run.train)} of {of} updates on {tasks} so far{so_far}"
    *before, after = run.outcomes
    if not before:
        return f"{percent(after['success'])} success on {tasks} after training"
    (low, high), old, new = before[0]["ci95"], before[0]["success"], after["success"]
    if old == new:
        return f"Success on {tasks} stayed at {percent(new)}"
    change = f"from {percent(old)} to {percent(new)}"
    if after["ci95"][0] <= high and low <= after["ci95"][1]:
        return f"Success on {tasks} went {change}, and the intervals overlap"
    return f"Success on {tasks} {'rose' if new > old else 'fell'} {change}"


def _tiles(run: Run, bound: int | None) -> list[tuple[str, str, str]]:
    result = run.result or {}
    mean, largest = _mean(run.train, "lag_mean"), np.nanmax([0.0, *column(run.train, "lag_max")])
    parts = {"warm start": result.get("warm_start_s") or 0.0, "RL": result.get("rl_s") or 0.0}
    tiles = []
    for e in run.outcomes:
        interval = rate(e["success"], e["ci95"]).partition("[")[2]
        tiles.append((f"success {e.get('group')}", percent(e["success"]), f"[{interval} %, n = {e['n']}"))
    steps = result.get("env_steps", next(iter(exploring(run)[0][::-1].tolist()), None))
    episodes = number(result.get("episodes", newest(run.rollout, "episodes")))
    spent = ", ".join(f"{name} {duration(seconds)}" for name, seconds in parts.items() if seconds >= 1)
    updates = number(result.get("updates", len(run.train)))
    if run.offline:
        tiles.append(("episodes", episodes, f"{number(result.get('successes'))} successes"))
    else:
        tiles.append(("env steps", number(steps), f"{episodes} episodes"))
        tiles.append(("lag", number(mean, 2), f"largest {number(largest)}, bound {number(bound)}"))
    return [
        *tiles,
        ("wall time", duration(run.wall_s), spent),
        ("updates", updates, f"of {run.section('trainer').get('updates')}"),
        ("algorithm", str(run.section("algorithm").get("type")), f"seed {run.config.get('seed')}"),
    ]


def _run_table(runs: Mapping[str, Run], now: float) -> Table:
    rows = []
    for name, run in runs.items():
        before = [e for e in run.evaluations if e.get("group") == "before"]
        ends = [*(before[:1] or [{}]), *(run.outcomes[-1:] or [{}])]
        success = (rate(e.get("success"), e.get("ci95")) for e in ends)
        tiles = {key: value for key, value, _ in _tiles(run, None)}
        numbers = (tiles.get(key, ABSENT) for key in ("env steps", "lag", "wall time"))
        kind = tiles["algorithm"], str(run.config.get("seed"))
        rows.append((name, *success, *kind, *numbers, status(run, now)))
    columns = ("run", "before", "newest", "algorithm", "seed", "env steps", "mean lag", "wall time", "")
    return "Success before training and in the newest evaluation, with 95 % Wilson intervals", columns, rows


def _curves(runs: Mapping[str, Run]) -> list[Chart]:
    """Success and lag; where there are more runs than colours, without bands and intervals."""
    each = [(name, run, i) for i, (name, run) in enumerate(runs.items())]
    share: dict[str, Any] = {**SHARE, "wide": True, "bands": len(runs) <= len(COLOURS)}
    ended = [evaluated(run, name, i) for name, run, i in each]
    explored = [line(name, *exploring(run), i) for name, run, i in each]
    lags = [line(n, column(run.train, "update"), column(run.train, "lag_mean"), i) for n, run, i in each]
    sampler = "LeRobot's own sampler on seeds that no run trains on."
    noise = "The policy with its noise, over the newest 100 episodes."
    return [
        Chart("Success in evaluation", sampler, STEPS, ended, **share),
        Chart("Success while exploring", noise, STEPS, explored, **share),
        Chart("Mean lag", "", "updates", lags, unit="updates", bottom=0, bands=False, wide=True),
    ]
