# SPDX-License-Identifier: Apache-2.0
"""Seeds, intervals and summaries by hand; planned episodes; curve and film."""

import itertools
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from accerl_lerobot import evaluation, seeds
from accerl_lerobot.evaluation import Chart, Rate, before_after, evaluation_plans, success_curve, summarise
from accerl_lerobot.rollout.runner import EpisodeResult
from tests.rollout.environments import ended, evaluate


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [
        # z = 1.959964, z² = 3.841459. n = 10, p = ½: centre ½, half √(0.025 + 0.0096036)·1.959964/1.3841459
        (5, 10, 0.236593, 0.763407),
        (93, 100, 0.862505, 0.965681),
        (0, 20, 0.0, 0.161125),  # z²/(n + z²) = 3.841459/23.841459
        (20, 20, 0.838875, 1.0),
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
    assert summary["ci95"] == list(Rate(successes=9, n=20).interval())
    assert summary["return_mean"] == pytest.approx((9 - 11 * 0.5) / 20)
    assert summary["steps_mean"] == pytest.approx((9 * 50 + 11 * 150) / 20)
    assert (summary["version_min"], summary["version_max"]) == (2, 5)
    tasks = summary["tasks"]
    assert [(t["success"], t["n"]) for t in (tasks["door"], tasks["drawer"])] == [(0.8, 10), (0.1, 10)]


def test_plans_are_paired_do_not_explore_and_are_filmed_first() -> None:
    before, after = (evaluation_plans(("a", "b"), 10, group, filmed=2) for group in ("before", "after"))
    assert [(p.task, p.seed) for p in before] == [(p.task, p.seed) for p in after]
    assert len({(p.task, p.seed) for p in before}) == 10
    assert evaluation_plans(("a", "b"), 6, "before", filmed=2) == before[:6]
    assert all(p.seed in seeds.EVAL_SEEDS and p.group == "before" and not p.explore for p in before)
    assert [p.film for p in before] == [evaluation.FILM, evaluation.FILM] + [None] * 8
    assert [p.index for p in before] == list(range(10))


def evaluated(env_steps: float, successes: int, n: int) -> dict[str, Any]:
    ci95 = list(Rate(successes=successes, n=n).interval())
    return {"env_steps": env_steps, "success": successes / n, "n": n, "ci95": ci95}


def test_the_curve_shows_rates_with_their_intervals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Chart] = []
    monkeypatch.setattr(Chart, "png", lambda chart: drawn.append(chart) or b"picture")
    first, last = evaluated(0, 50, 100), evaluated(5000, 9, 10)
    success_curve(tmp_path / "curve.png", [last, first], [(0, 0.2), (5000, 0.8)])
    assert (tmp_path / "curve.png").read_bytes() == b"picture"
    rates, exploring = drawn[0].series["evaluation"], drawn[0].series["while exploring"]
    np.testing.assert_array_equal([rates.x, rates.y], [[0, 5000], [0.5, 0.9]])
    np.testing.assert_allclose(rates.interval, np.transpose([first["ci95"], last["ci95"]]))
    np.testing.assert_array_equal([exploring.x, exploring.y], [[0, 5000], [0.2, 0.8]])
    success_curve(tmp_path / "curve.png", [last, first], [])
    assert not len(drawn[1].series["while exploring"].x)


def filmed(index: int, success: bool, frames: int = 3, side: int = 64) -> EpisodeResult:
    film = [np.full((side, side, 3), 120, np.uint8)] * frames
    return ended(evaluate(index=index), success=success, frames=film)


def test_before_beside_after_with_outcomes(tmp_path: Path) -> None:
    before = [filmed(i, i == 0) for i in (1, 0, 2)] + [filmed(3, True, frames=0)]
    after = [filmed(i, i != 2) for i in range(4)]
    before_after(tmp_path / "film.mp4", before, after, fps=4)
    with av.open(tmp_path / "film.mp4") as file:
        film = np.stack([each.to_ndarray(format="rgb24").astype(int) for each in file.decode(video=0)])
    half = 2 * 64 + evaluation.GAP
    assert film.shape[1:3] == (half, 2 * half + 4 * evaluation.GAP)

    def edge(frame: int, row: int, column: int) -> str:
        left = column % 2 * (64 + evaluation.GAP) + column // 2 * (half + 4 * evaluation.GAP)
        red, green, _ = film[frame, row * (64 + evaluation.GAP) + 61, left + 20 : left + 44].mean(0)
        return "red" if red > green + 60 else "green" if green > red + 60 else "none"

    assert [edge(0, r, c) for r in (0, 1) for c in range(4)] == ["none"] * 8
    ends = [edge(-1, r, c) for r in (0, 1) for c in range(4)]
    assert ends == ["green", "red", "green", "green", "red", "none", "red", "none"]
    assert (film[:, 80:, 80:half] > 150).all(), "no fourth episode"


def test_what_cannot_be_drawn_is_left_out_with_a_warning(tmp_path: Path, caplog: Any) -> None:
    success_curve(tmp_path / "missing" / "curve.png", [evaluated(0, 1, 2)], [])
    before_after(tmp_path / "both.mp4", [filmed(0, True, side=32)], [filmed(0, True, side=16)], fps=4)
    curve, film = caplog.messages
    assert curve.startswith("there is no success_curve.png") and film.startswith("there is no film (")
    before_after(tmp_path / "film.mp4", [], [], fps=4)
    assert list(tmp_path.iterdir()) == [], "without frames there is no video"


def test_seeds_stay_in_their_ranges():
    demos, training, tests = seeds.DEMO_SEEDS, seeds.TRAIN_SEEDS, seeds.EVAL_SEEDS
    assert demos.stop <= training.start and training.stop <= tests.start and tests.stop <= 2**32
    for run in (0, 99, 1_000, 2**32 - 1):
        assert all(seeds.demo_seed(run, i) in demos for i in (0, 1, 999_999))
        places = itertools.product((run,), (0, 999), (0, 999_998, 10**7))
        assert all(seeds.train_seed(*place) in training for place in places)
        assert seeds.eval_seed(10 * run, 5) in tests
    assert seeds.eval_seed(0, 0) == 2_000_000_000


def test_seeds_differ_between_runs_workers_episodes_and_decisions():
    places = itertools.product((0, 1, 99, 1_000, 2**32 - 1), (0, 1, 999), (0, 1, 9_999, 10_000, 999_998))
    starts = itertools.product((0, 1, 2, 99, 1_000, 99_999), (0, 1, 9_999))
    decisions = itertools.product((0, 1, 2**32 - 1), (0, 1, 999_999))
    for draw, many in ((seeds.train_seed, places), (seeds.eval_seed, starts), (seeds.noise_seed, decisions)):
        drawn = [draw(*one) for one in many]
        assert len(set(drawn)) == len(drawn)
    assert seeds.noise_seed(7, 5) == 7 * 1_000_003 + 5
