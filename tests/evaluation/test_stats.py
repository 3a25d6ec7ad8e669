# SPDX-License-Identifier: Apache-2.0
"""Intervals against hand-computed numbers and simulation; summaries of episodes; the planned episodes."""

from __future__ import annotations

import math

import pytest

from accerl_lerobot.evaluation import FILM, Rate, evaluation_plans, summarise
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodeResult
from accerl_lerobot.seeds import DEMO_SEEDS, EVAL_SEEDS, TRAIN_SEEDS


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [
        # z = 1.959964, z² = 3.841459. n = 10, p = ½: centre ½, half √(0.025 + 0.0096036)·1.959964/1.3841459
        (5, 10, 0.236593, 0.763407),
        (93, 100, 0.862505, 0.965681),
        (0, 20, 0.0, 0.161125),  # z²/(n + z²) = 3.841459/23.841459
        (20, 20, 0.838875, 1.0),
        (0, 1, 0.0, 0.793450),  # 3.841459/4.841459
    ],
)
def test_wilson_by_hand(successes: int, n: int, low: float, high: float) -> None:
    interval = Rate(successes=successes, n=n).interval()
    assert interval.low == pytest.approx(low, abs=2e-6)
    assert interval.high == pytest.approx(high, abs=2e-6)


def test_knowing_nothing() -> None:
    nothing = Rate(successes=0, n=0)
    assert nothing.interval() == (0.0, 1.0)
    assert math.isnan(nothing.value) and str(nothing) == "no episodes"


def result(task: str, seed: int, success: bool, versions: tuple[int, int] = (3, 3)) -> EpisodeResult:
    plan = EpisodePlan(task=task, seed=seed, explore=False)
    return EpisodeResult(
        plan=plan,
        success=success,
        episode_return=1.0 if success else -0.5,
        steps=50 if success else 150,
        decisions=15,
        versions=versions,
    )


RESULTS = [
    *(result("door", i, success=i < 8, versions=(3, 5)) for i in range(10)),
    *(result("drawer", i, success=i < 1, versions=(2, 4)) for i in range(10)),
]


def test_a_summary_in_all_and_per_task() -> None:
    summary = summarise(RESULTS)
    assert (summary["success"], summary["n"]) == (0.45, 20)
    # Wilson, 9 of 20: (p + z²/2n ± z √(p(1 − p)/n + z²/4n²)) / (1 + z²/n) with z = 1.959964
    assert summary["ci95"] == pytest.approx([0.258199, 0.657906], abs=1e-5)
    assert summary["return_mean"] == pytest.approx((9 - 11 * 0.5) / 20)
    assert summary["steps_mean"] == pytest.approx((9 * 50 + 11 * 150) / 20)
    assert (summary["version_min"], summary["version_max"]) == (2, 5)
    tasks = summary["tasks"]
    assert list(tasks) == ["door", "drawer"]
    assert [(t["success"], t["n"]) for t in tasks.values()] == [(0.8, 10), (0.1, 10)]
    assert all(t["ci95"][0] < t["success"] < t["ci95"][1] for t in tasks.values())
    assert tasks["door"]["seeds"] == [0, 9] and tasks["door"]["failed_seeds"] == [8, 9]


def test_plans_are_paired_across_evaluations_and_runs_of_any_size() -> None:
    before, after = (evaluation_plans(("a", "b"), 10, group) for group in ("before", "after"))
    assert [(p.task, p.seed) for p in before] == [(p.task, p.seed) for p in after]
    assert len({(p.task, p.seed) for p in before}) == 10
    assert evaluation_plans(("a", "b"), 6, "before") == before[:6]


def test_plans_are_never_trained_on_do_not_explore_and_are_filmed_first() -> None:
    plans = evaluation_plans(("a",), 50, "x", filmed=2)
    for plan in plans:
        assert plan.seed in EVAL_SEEDS and plan.group == "x" and not plan.explore
        assert plan.seed not in TRAIN_SEEDS and plan.seed not in DEMO_SEEDS
    assert [p.film for p in plans] == [FILM, FILM] + [None] * 48
    assert [p.index for p in plans] == list(range(50))
