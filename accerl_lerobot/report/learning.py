# SPDX-License-Identifier: Apache-2.0
"""Charts of what the trainer did: how stale its samples were, and what it learnt from them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from accerl_lerobot.report.charts import Chart, Series, limit, line
from accerl_lerobot.report.read import Record, column, has

UPDATE = "updates"


def lag_chart(train: Sequence[Record], bound: int | None) -> Chart:
    """Mean and largest lag of each update, below what the recipe allows, if that is known."""
    x = column(train, "update")
    series = [
        line("mean of a batch", x, column(train, "lag_mean"), colour=0),
        line("largest of a batch", x, column(train, "lag_max"), colour=1, how="max"),
    ]
    if bound is not None:
        series.append(limit(f"bound of the recipe, {bound}", bound))
    return Chart(
        title="Lag",
        unit="updates",
        x_label=UPDATE,
        series=tuple(series),
        limits=(0.0, None),
        note="How many updates older than the trainer the weights were that decided.",
        wide=True,
    )


def learning_charts(train: Sequence[Record], grad_clip: float | None) -> list[Chart]:
    """Losses, and what says whether they can be trusted."""

    def of(*names: str, called: Sequence[str] = ()) -> tuple[Series, ...]:
        x = column(train, UPDATE.removesuffix("s"))
        labels = called or [name.replace("_", " ") for name in names]
        return tuple(
            line(label, x, column(train, name), colour=i)
            for i, (name, label) in enumerate(zip(names, labels, strict=True))
            if has(train, name)
        )

    def chart(title: str, note: str, series: tuple[Series, ...], **more: object) -> Chart:
        return Chart(title=title, note=note, series=series, x_label=UPDATE, **more)  # type: ignore[arg-type]

    variance = column(train, "explained_variance")
    worst = float(np.nanmin(variance)) if np.isfinite(variance).any() else 0.0
    kl, unbounded = column(train, "kl"), column(train, "approx_kl")
    alike = bool(np.allclose(kl, unbounded, rtol=0.01, equal_nan=True))
    clip = (limit(f"clipped at {grad_clip:g}", grad_clip),) if grad_clip else ()
    return [
        chart("Policy loss", "The algorithm's own term.", of("policy_loss")),
        chart("Value loss", "Squared error of the critic against the returns.", of("value_loss")),
        chart(
            "KL divergence",
            "How far the policy has left its samples"
            + ("." if alike else ", with far samples bounded as in the loss, and without."),
            of("kl", "kl_reference", called=("to the samples", "to the start"))
            if alike
            else of("approx_kl", "kl", "kl_reference", called=("unbounded", "in the loss", "to the start")),
            unit="nats",
        ),
        chart(
            "Samples that count little",
            "Share of ratios outside the range of PPO, and of samples weighed below a tenth.",
            of("clip_fraction", "low_weight", called=("outside the clip", "weight below 0.1")),
            share=True,
            limits=(0.0, None),
        ),
        chart(
            "Effective sample size",
            "100 %: all samples count alike.",
            of("ess"),
            share=True,
            limits=(None, 1.0),
        ),
        chart(
            "Explained variance of the critic",
            f"1 is perfect, 0 a constant{'; what is below −1 is not shown' if worst < -1 else ''}.",
            of("explained_variance"),
            limits=(-1.0 if worst < -1 else None, None),
        ),
        chart(
            "Gradient norm",
            "Of the policy and of the critic, before each is clipped.",
            of("grad_norm", "value_grad_norm") + clip,
            limits=(0.0, None),
        ),
        chart(
            "Return",
            "Mean of the returns that the critic is regressed to.",
            of("return_mean"),
        ),
        chart(
            "Learning rate",
            "Of the policy: 0 while only the critic learns.",
            of("lr", called=("policy",)),
            limits=(0.0, None),
        ),
    ]  # fmt: skip
