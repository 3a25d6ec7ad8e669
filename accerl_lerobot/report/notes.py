# SPDX-License-Identifier: Apache-2.0
"""Warnings before anybody believes a run: one plain sentence each, none if all is well."""

from __future__ import annotations

import datetime
from collections.abc import Iterator

from accerl_lerobot.console import count, duration, number, percent
from accerl_lerobot.report.read import Run, column, newest

RECENT_S = 120.0
"""A run that has written something since is taken to be going on."""
MISMATCH = 1e-4
"""Nats between acting and learning at equal weights that rounding in float32 does not explain."""

COUNTED = {
    "restarts": "{n} of a rollout worker: it died or hung, and was started again.",
    "dropped_nonfinite": "{n} thrown away, because the world returned NaN or infinity.",
    "replay_evicted_unused": "{n} left the replay unused because it was full: experience that was wasted.",
    "replay_retired_unused": "{n} left the replay unused because they were older than replay.max_lag.",
    "replay_lost_unused": "{n} that nobody had learnt from were gone when the run was taken up again.",
    "replay_dropped_nonfinite": "{n} refused by the replay because of a NaN or infinity.",
    "replay_duplicates": "{n} came twice and were ignored.",
}
"""Counter → sentence; a run in which it is 0 needs none."""
THINGS = {"restarts": "restart", "dropped_nonfinite": "decision"}
"""Nouns of what is counted, where it is not segments."""


def status(run: Run, now: float) -> tuple[str, bool]:
    """A few words about how a run stands, and whether that is good."""
    if run.result is not None:
        passed = run.result.get("passed", True)
        return ("finished" if run.verb == "train" else "passed" if passed else "failed"), bool(passed)
    return ("still going" if now - run.written < RECENT_S else "not finished"), False


def notes(run: Run, bound: int | None, now: float) -> list[str]:
    """All of them."""
    return [*_state(run, now), *_counted(run), *_learning(run, bound), *_dreams(run)]


def _state(run: Run, now: float) -> Iterator[str]:
    if run.result is None:
        file = "summary.json" if run.verb == "train" else "validation.json"
        ago = now - run.written
        if ago < RECENT_S:
            yield f"The run is still going: there is no {file} yet. This page shows it {_at(now)}."
        else:
            yield (
                f"The run has no {file}: it ended early, or waits for something. "
                f"The last thing it wrote is from {_at(run.written)}, {duration(ago)} before this page."
            )
    if not run.records and run.verb != "world-model-eval":
        yield "There are no metrics: the run has not come to its first record."
    if run.torn:
        yield "The last line of metrics.jsonl is incomplete and left out: the run was writing it, or died."
    if run.sessions > 1:
        times = count(run.sessions - 1, "time")
        yield f"The run was taken up again {times}; what was done twice counts once."


def _counted(run: Run) -> Iterator[str]:
    rollout = run.records.get("rollout", [])
    for name, sentence in COUNTED.items():
        n = int(newest(rollout, name) or 0)
        if n:
            yield sentence.format(n=count(n, THINGS.get(name, "segment")))
    dropped, kept = (newest(rollout, f"groups_{name}") or 0 for name in ("dropped", "kept"))
    if dropped > kept:
        yield (
            f"{count(int(dropped), 'group')} of equal starts thrown away and {int(kept):,} kept: "
            "most had nothing to compare."
        )


def _learning(run: Run, bound: int | None) -> Iterator[str]:
    train = run.records.get("train", [])
    skipped = int(newest(train, "skipped") or 0)
    if skipped:
        yield f"{count(skipped, 'update')} skipped, because loss or gradient was not finite."
    lag = column(train, "lag_max")
    if bound is not None and len(lag) and lag.max() > bound:
        yield f"The lag came to {number(float(lag.max()))} updates, above the bound of {bound}."
    mismatch = column(train, "logprob/mismatch_max")
    mismatch = mismatch[mismatch == mismatch]
    precision = run.room("policy").get("precision", "fp32")
    if precision == "fp32" and len(mismatch) and mismatch.max() > MISMATCH:
        yield (
            f"Acting and learning disagreed by up to {mismatch.max():.2g} nats at equal weights, "
            "which rounding does not explain."
        )


def _dreams(run: Run) -> Iterator[str]:
    rollout = run.records.get("rollout", [])
    if not run.room("imagination").get("share"):
        return
    promoted = newest(rollout, "imagination_promoted") or 0
    if newest(rollout, "imagination_on") == 0 and (newest(rollout, "imagination_rollouts") or 0) > 0:
        dreamt, real = (percent(newest(rollout, f"imagination_success_{of}")) for of in ("imagined", "real"))
        yield f"Imagination was switched off: {dreamt} of rollouts succeeded, and {real} of real episodes."
    elif rollout and not promoted and not newest(rollout, "imagination_rollouts"):
        yield "Nothing was imagined: no world model passed validation."


def _at(moment: float) -> str:
    return datetime.datetime.fromtimestamp(moment).strftime("%d %B %Y, %H:%M")
