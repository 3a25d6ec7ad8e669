# SPDX-License-Identifier: Apache-2.0
"""Seeds, intervals and summaries by hand; planned episodes; curve and film."""

import itertools
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import av
import numpy as np
import pytest

from accerl_lerobot import evaluation
from accerl_lerobot.evaluation import (
    FILM,
    GAP,
    Rate,
    before_after,
    evaluation_plans,
    success_curve,
    summarise,
)  # fmt: skip
from accerl_lerobot.rollout.runner import EpisodeResult
from accerl_lerobot.seeds import (
    DEMO_SEEDS,
    EVAL_SEEDS,
    TRAIN_SEEDS,
    demo_seed,
    eval_seed,
    noise_seed,
    train_seed,
)
from tests.rollout.environments import ended, evaluate


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [
        # z = 1.959964, z² = 3.841459. n = 10, p = ½: centre ½, half √(0.025 + 0.0096036)·1.959964/1.3841459
        (5, 10, 0.236593, 0.763407),
        (93, 100, 0.862505, 0.965681),
        (0, 20, 0.0, 0.161125),  # z²/(n + z²) = 3.841459/23.841459
        (20, 20, 0.838875, 1.0),
        (0, 1, 0.0, 0.793450),  # 3.841459/4.841459
        (0, 0, 0.0, 1.0),
    ],
)
def test_wilson_by_hand(successes: int, n: int, low: float, high: float) -> None:
    interval = Rate(successes=successes, n=n).interval()
    assert interval.low == pytest.approx(low, abs=2e-6)
    assert interval.high == pytest.approx(high, abs=2e-6)


def test_a_summary_in_all_and_per_task() -> None:
    results = []
    for task, successes, versions in (("door", 8, (3, 5)), ("drawer", 1, (2, 4))):
        for i in range(10):
            won = i < successes
            numbers = {"episode_return": 1.0 if won else -0.5, "steps": 50 if won else 150}
            results.append(ended(evaluate(seed=i, task=task), success=won, versions=versions, **numbers))
    summary = summarise(results)
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


def evaluated(env_steps: float, successes: int, n: int) -> dict[str, Any]:
    ci95 = list(Rate(successes=successes, n=n).interval())
    return {"env_steps": env_steps, "success": successes / n, "n": n, "ci95": ci95}


def test_the_curve_shows_rates_with_their_intervals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    axes = MagicMock()
    monkeypatch.setattr(evaluation, "drawing", lambda path: nullcontext(axes))
    first, last = evaluated(0, 50, 100), evaluated(5000, 9, 10)
    success_curve(tmp_path / "curve.png", [last, first], [(0, 0.2), (5000, 0.8)])
    (x, y), lengths = axes.errorbar.call_args.args, axes.errorbar.call_args.kwargs["yerr"]
    np.testing.assert_array_equal([x, y], [[0, 5000], [0.5, 0.9]])
    np.testing.assert_allclose([y - lengths[0], y + lengths[1]], np.transpose([first["ci95"], last["ci95"]]))
    assert axes.plot.call_args.args == ((0, 5000), (0.2, 0.8)), "success while exploring"


def clip(frames: int, grey: int, side: int = 32) -> list[np.ndarray]:
    return [np.full((side, side, 3), grey, np.uint8) for _ in range(frames)]


def filmed(index: int, success: bool, frames: list[np.ndarray]) -> EpisodeResult:
    return ended(evaluate(index=index), success=success, frames=frames)


def test_before_beside_after_with_outcomes(tmp_path: Path) -> None:
    grey = clip(3, 120, side=64)
    before = [filmed(i, i == 0, grey) for i in (1, 0, 2)] + [filmed(3, True, [])]
    after = [filmed(i, i != 2, grey) for i in range(4)]
    before_after(tmp_path / "film.mp4", before, after, fps=4)
    with av.open(tmp_path / "film.mp4") as file:
        film = np.stack([each.to_ndarray(format="rgb24").astype(int) for each in file.decode(video=0)])
    half = 2 * 64 + GAP
    assert film.shape[1:3] == (half, 2 * half + 4 * GAP)

    def edge(frame: int, row: int, column: int) -> str:
        left = column % 2 * (64 + GAP) + column // 2 * (half + 4 * GAP)
        red, green, _ = film[frame, row * (64 + GAP) + 61, left + 20 : left + 44].mean(0)
        return "red" if red > green + 60 else "green" if green > red + 60 else "none"

    assert [edge(0, r, c) for r in (0, 1) for c in range(4)] == ["none"] * 8
    ends = [edge(-1, r, c) for r in (0, 1) for c in range(4)]
    assert ends == ["green", "red", "green", "green", "red", "none", "red", "none"]
    assert (film[:, 80:, 80:half] > 150).all(), "no fourth episode"


def test_what_cannot_be_drawn_is_left_out_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    nowhere = tmp_path / "missing"
    success_curve(nowhere / "curve.png", [evaluated(0, 1, 2)], [])
    sizes = ([filmed(0, True, clip(1, 0, side))] for side in (32, 16))
    before_after(tmp_path / "both.mp4", *sizes, fps=4)
    starts = ("success_curve.png", "film (")
    assert all(m.startswith(f"there is no {s}") for m, s in zip(caplog.messages, starts, strict=True))
    before_after(tmp_path / "film.mp4", [], [], fps=4)
    assert list(tmp_path.iterdir()) == [], "without frames there is no video"


def test_seeds_stay_in_their_range_at_the_corners():
    assert DEMO_SEEDS.stop <= TRAIN_SEEDS.start and TRAIN_SEEDS.stop <= EVAL_SEEDS.start
    assert EVAL_SEEDS.stop <= 2**32
    for run in (0, 99, 1_000, 2**32 - 1):
        assert all(demo_seed(run, i) in DEMO_SEEDS for i in (0, 1, 999_999))
        places = itertools.product((run,), (0, 999), (0, 999_998, 10**7))
        assert all(train_seed(*place) in TRAIN_SEEDS for place in places)
    assert eval_seed(0, 0) == 2_000_000_000


def test_training_seeds_differ_between_runs_workers_and_episodes():
    places = itertools.product((0, 1, 99, 1_000, 2**32 - 1), (0, 1, 999), (0, 1, 9_999, 10_000, 999_998))
    seeds = [train_seed(*place) for place in places]
    assert len(set(seeds)) == len(seeds)


def test_runs_of_different_seeds_are_evaluated_on_different_starts():
    starts = [{eval_seed(run, i) for i in (0, 1, 9_999)} for run in (0, 1, 2, 99, 1_000, 99_999)]
    assert len(set.union(*starts)) == 3 * len(starts)
    assert all(seed in EVAL_SEEDS for seed in set.union(*starts, {eval_seed(10**12, 5)}))


def test_noise_differs_between_episodes_and_decisions():
    corners = (0, 1, 2**32 - 1), (0, 1, 999_999)
    seeds = [noise_seed(*place) for place in itertools.product(*corners)]
    assert len(set(seeds)) == len(seeds) and min(seeds) == 0
    assert noise_seed(7, 5) == 7 * 1_000_003 + 5
