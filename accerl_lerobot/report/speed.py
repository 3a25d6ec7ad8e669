# SPDX-License-Identifier: Apache-2.0
"""How fast a run went, and what its workers did with their time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from accerl_lerobot.console import duration, number, percent
from accerl_lerobot.report.blocks import Bar, Bars, Block, Part, Words, figures
from accerl_lerobot.report.charts import Chart, line, rates
from accerl_lerobot.report.read import Record, column, has, newest
from accerl_lerobot.timeline.states import ROLES, STATES

SOME, MOST = 0.1, 0.8
"""Share of its time up to which the trainer hardly waits; and above which inference hardly does."""
TIME = "minutes since the workers began to start"
TRAINER = (
    ("update_s", "updating", 0),
    ("publish_s", "publishing weights", 2),
    ("wait_s", "waiting for a batch", 7),
)
"""Number, what the trainer does in it, colour."""
STATE_COLOURS = dict(zip(STATES, (0, 7, 1, 3, 2, 6, 5, 4, 4), strict=True))


def speed_charts(train: Sequence[Record], rollout: Sequence[Record]) -> list[Chart]:
    """Env steps, decisions and updates a second, evaluation while training included."""
    wall = column(rollout, "wall_s")
    counted = [
        ("Env steps", rates("env steps", wall, column(rollout, "env_steps"), colour=0)),
        ("Decisions", rates("decisions", wall, column(rollout, "decisions"), colour=2)),
        ("Updates", rates("updates", column(train, "wall_s"), column(train, "update"), colour=4)),
    ]
    return [
        Chart(title=title, unit="per second", x_label=TIME, series=(series,), limits=(0.0, None))
        for title, series in counted
    ]


def time_blocks(train: Sequence[Record], rollout: Sequence[Record], batch: int | None) -> list[Block]:
    """Time of each worker by activity, as far as it is measured; nothing for the engine in which nobody
    waits."""
    spent = {key: float(np.nansum(column(train, key))) for key, _, _ in TRAINER if has(train, key)}
    if not spent or not sum(spent.values()):
        return []
    inference = _inference_busy(rollout)
    return [
        Words(text=_verdict(spent, newest(rollout, "replay_insert_wait_s"), inference)),
        Bars(bars=_role_bars(rollout) or _partial_bars(spent, inference)),
        *figures(_busy_chart(train, rollout), _batch_chart(rollout, batch), _request_chart(rollout)),
    ]


def _role_bars(rollout: Sequence[Record]) -> list[Bar]:
    """How the time of every role divides; nothing for a run without a timeline.

    Each record's shares are of the time since the one before.
    """
    length = np.diff(column(rollout, "wall_s"), prepend=np.nan)
    bars = []
    for role in ROLES:
        name = f"timeline_{role.replace(' ', '_')}"
        there = np.isfinite(column(rollout, f"{name}_bubble")) & (length > 0)
        if role == "driver" or not there.any():
            continue
        parts = []
        for state in STATES:
            own = np.nan_to_num(column(rollout, f"{name}_{state}_share"))[there]
            share = float((own * length[there]).sum() / length[there].sum())
            if share > 0:
                note, colour = percent(share), STATE_COLOURS[state]
                parts.append(Part(name=state.replace("_", " "), share=share, colour=colour, note=note))
        bars.append(Bar(name=role, parts=parts))
    return bars


def _partial_bars(spent: dict[str, float], inference: float | None) -> list[Bar]:
    """Busy shares that the trainer and inference log of themselves, as all runs do."""
    bars = [Bar(name="trainer", parts=_trainer_parts(spent))]
    if inference is not None:
        idle = Part(name="waiting for requests", share=1 - inference, colour=7, note=percent(1 - inference))
        busy = Part(name="deciding", share=inference, colour=0, note=percent(inference))
        bars.append(Bar(name="inference", parts=(busy, idle)))
    return bars


def _trainer_parts(spent: dict[str, float]) -> list[Part]:
    whole = sum(spent.values())
    return [
        Part(
            name=name,
            share=spent[key] / whole,
            colour=colour,
            note=f"{percent(spent[key] / whole)}, {duration(spent[key])}",
        )
        for key, name, colour in TRAINER
        if key in spent
    ]


def _verdict(spent: dict[str, float], at_the_door: float | None, inference: float | None) -> str:
    """Says in words which worker waited for which; `inference` is its busy share."""
    waited = spent.get("wait_s", 0.0) / sum(spent.values())
    text = f"The trainer was busy for {percent(1 - waited)} of its time and waited for batches in the rest. "
    if at_the_door is not None:
        text += (
            f"Segments stood at the replay's door for {duration(at_the_door)}, added up over all of them. "
        )
    if waited <= SOME:
        return text + "Learning was the slower side: more worlds would wait at the door."
    if inference is not None and inference > MOST:
        return text + f"Inference, busy for {percent(inference)} of the time, held collecting up."
    return (
        text + "Collecting was the slower side, and inference had time left: there is room for more worlds."
    )


def _inference_busy(rollout: Sequence[Record]) -> float | None:
    """Each record's share is of the time since the one before."""
    busy, wall = column(rollout, "inference_busy_share"), column(rollout, "wall_s")
    length = np.diff(wall, prepend=np.nan)
    there = np.isfinite(busy) & np.isfinite(length) & (length > 0)
    if not there.any():
        return None
    return float(min(1.0, (busy[there] * length[there]).sum() / length[there].sum()))


def _busy_chart(train: Sequence[Record], rollout: Sequence[Record]) -> Chart:
    """Seconds of work in a second."""
    worked = np.cumsum(np.nan_to_num(column(train, "update_s")) + np.nan_to_num(column(train, "publish_s")))
    wall = column(rollout, "wall_s")
    decided = np.cumsum(
        np.nan_to_num(column(rollout, "inference_busy_share") * np.diff(wall, prepend=np.nan))
    )
    return Chart(
        title="Busy share",
        x_label=TIME,
        share=True,
        limits=(0.0, 1.0),
        note="Of the time that passed.",
        series=(
            rates("trainer", column(train, "wall_s"), worked, colour=0),
            rates("inference", wall, decided, colour=1),
        ),
    )


def _batch_chart(rollout: Sequence[Record], batch: int | None) -> Chart:
    """The logged mean is since the start, so the means of its parts are taken back out of it."""
    batches = column(rollout, "inference_batches")
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.diff(batches * column(rollout, "inference_batch_size_mean")) / np.diff(batches)
    return Chart(
        title="Requests decided together",
        unit="observations a forward pass",
        x_label=TIME,
        note=f"At most {number(batch)}." if batch else "",
        limits=(0.0, None),
        series=(line("mean", column(rollout, "wall_s")[1:] / 60, size, colour=2),) if len(size) else (),
    )


def _request_chart(rollout: Sequence[Record]) -> Chart:
    x = column(rollout, "wall_s") / 60
    return Chart(
        title="Wait of a request",
        unit="ms",
        x_label=TIME,
        note="From its arrival to the start of its forward pass.",
        limits=(0.0, None),
        series=(line("mean", x, 1000 * column(rollout, "inference_wait_mean_s"), colour=2),),
    )
