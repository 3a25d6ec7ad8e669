# SPDX-License-Identifier: Apache-2.0
"""Imagined episodes: how many, how true, and the gates that the world model had to pass."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from accerl_lerobot.console import count, number, percent
from accerl_lerobot.report.blocks import Block, Cell, Film, Table, Words, figures
from accerl_lerobot.report.charts import WHOLE, Chart, line
from accerl_lerobot.report.read import Record, column, has, newest

GATE = "imagination_check_"
MEANING = {
    "skill_changed_first": "better than a copy of the last frame, where pixels changed, after one chunk",
    "skill_changed_last": "the same at the end of the horizon",
    "skill_last": "the same on all pixels",
    "sensitivity_low": "how much worse it gets with another episode's actions",
    "auroc": "tells episodes that succeed from those that fail, lower end of the interval",
    "false_success": "failed episodes whose imagined rollout is classified as a success",
    "false_success_idle": "rollouts without actions that are classified as successes",
    "recall": "successes whose imagined rollout is classified as one",
}
FIELDS = {
    "skill_changed_first": "skill_first",
    "skill_changed_last": "skill_last",
    "skill_last": "skill_last",
    "sensitivity_low": "sensitivity",
    "auroc": "auroc",
    "false_success": "false_success",
    "false_success_idle": "false_success",
    "recall": "recall",
}
"""Gate → the field of the trial's config that holds what is wanted."""
AT_MOST = ("false_success", "false_success_idle")


def dream_blocks(rollout: Sequence[Record], imagination: Mapping[str, Any]) -> list[Block]:
    """Blocks about a run that imagines; nothing for one that does not."""
    if not imagination.get("share") or not has(rollout, "imagination_rollouts"):
        return []
    return [Words(text=_amount(rollout)), *figures(*_charts(rollout)), *_trial(rollout, imagination)]


def dream_films(paths: Sequence[Path]) -> list[Block]:
    """The first and the newest; a page does not hold all of a long run's."""
    found: list[Block] = []
    for path in dict.fromkeys([*paths[:1], *paths[-1:]]):
        trial, _, outcome = path.stem.partition("_")
        caption = (
            f"Validation {trial.lstrip('0')}, {outcome}: a held-out episode, above, and what the world model "
            "predicted with the same actions, below. The frame at the end is green for a success, red for a "
            "failure."
        )
        found.append(Film(path=path, caption=caption))
    return found


def gate_table(caption: str, rows: Sequence[tuple[str, float | None, str, bool]]) -> Table:
    """Gates of a trial: name, value, what is wanted, and whether it holds."""
    return Table(
        caption=caption,
        columns=("check", "found", "wanted", "", "meaning"),
        rows=[
            (
                Cell(text=name),
                Cell(text=number(value, 3), number=True),
                Cell(text=wanted, number=True),
                Cell(text="holds" if holds else "fails", good=holds),
                Cell(text=MEANING.get(name.rpartition(".")[2], "")),
            )
            for name, value, wanted, holds in rows
        ],
    )


def _amount(rollout: Sequence[Record]) -> str:
    def last(name: str) -> int:
        return int(newest(rollout, f"imagination_{name}") or 0)

    dreams, decisions = last("rollouts"), last("decisions")
    text = f"{count(dreams, 'imagined rollout')} of {count(decisions, 'decision')}; "
    text += f"{percent(last('successes') / dreams if dreams else None)} of them succeeded"
    if last("uncertain"):
        text += f", and {last('uncertain'):,} ended early because the model was too uncertain"
    tried = last("promoted") + last("rejected")
    if tried:
        text += f". The world model passed {last('promoted')} of {count(tried, 'validation')} in this run"
    return f"{text}."


def _charts(rollout: Sequence[Record]) -> list[Chart]:
    update = column(rollout, "update")
    real, imagined = (column(rollout, f"replay_{kind}trained_decisions") for kind in ("", "imagined_"))
    with np.errstate(invalid="ignore", divide="ignore"):
        learnt = imagined / (real + imagined)
    of_dreams = [
        ("imagined rollouts", "success", 0),
        ("imagined rollouts, at each real outcome", "success_imagined", 2),
        ("reality", "success_real", 1),
    ]
    return [
        Chart(
            title="Success in imagination and in reality",
            x_label="updates",
            share=True,
            limits=WHOLE,
            note="Imagined rollouts far above reality flatter the policy.",
            series=tuple(
                line(label, update, column(rollout, f"imagination_{name}"), colour=colour)
                for label, name, colour in of_dreams
                if has(rollout, f"imagination_{name}")
            ),
        ),
        Chart(
            title="Imagined share",
            x_label="updates",
            share=True,
            limits=WHOLE,
            note="Of the decisions of a batch, and of all learnt from so far.",
            series=(
                line("of a batch", update, column(rollout, "replay_imagined_share"), colour=0),
                line("so far", update, learnt, colour=2),
            ),
        ),
        Chart(
            title="What it learns from",
            unit="real episodes",
            x_label="updates",
            limits=(0.0, None),
            note="Episodes of the policy that the world model has learnt from.",
            series=(line("episodes", update, column(rollout, "imagination_learn_episodes"), colour=4),),
        ),
        Chart(
            title="Skill of the world model",
            x_label="updates",
            note="At each validation: 1 is perfect, 0 a copy of the last frame.",
            limits=(None, 1.0),
            series=tuple(
                line(label, update, column(rollout, f"{GATE}{name}"), colour=i)
                for i, (label, name) in enumerate(
                    [("after one chunk", "skill_changed_first"), ("at the horizon", "skill_changed_last")]
                )
                if has(rollout, f"{GATE}{name}")
            ),
        ),
    ]


def _trial(rollout: Sequence[Record], imagination: Mapping[str, Any]) -> list[Block]:
    """The gates of the last trial, where the recipe says what was wanted."""
    wanted = imagination.get("learn", {}).get("validation", {})
    rows = []
    for name, field in FIELDS.items():
        value, bound = newest(rollout, f"{GATE}{name}"), wanted.get(field)
        if value is None or bound is None:
            continue
        holds = value <= bound if name in AT_MOST else value > bound
        rows.append((name, value, f"{'at most' if name in AT_MOST else 'above'} {bound}", holds))
    return [gate_table("The last validation of the world model", rows)] if rows else []
