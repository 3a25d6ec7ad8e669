# SPDX-License-Identifier: Apache-2.0
"""Intervals and tests against hand-computed numbers, and against simulation."""

import math
import random

import pytest

from accerl_lerobot.evaluation.stats import (
    Outcomes,
    Rate,
    compare,
    format_rate,
    mcnemar_p,
    mean_interval,
    paired_interval,
    per_task,
    task_mean,
    total,
    wilson_interval,
)


@pytest.mark.parametrize(
    ("successes", "n", "confidence", "low", "high"),
    [
        # z = 1.959964, z² = 3.841459. n = 10, p = ½: centre ½, half √(0.025 + 0.0096036)·1.959964/1.3841459
        (5, 10, 0.95, 0.236593, 0.763407),
        (93, 100, 0.95, 0.862505, 0.965681),
        (0, 20, 0.95, 0.0, 0.161125),  # z²/(n + z²) = 3.841459/23.841459
        (20, 20, 0.95, 0.838875, 1.0),
        (0, 1, 0.95, 0.0, 0.793450),  # 3.841459/4.841459
        # z = 1.644854, z² = 2.705543. centre ½, half √(0.025 + 0.00676386)·1.644854/1.2705543
        (5, 10, 0.90, 0.269273, 0.730727),
        (0, 20, 0.99, 0.0, 0.249107),  # z² = 6.634897
    ],
)
def test_wilson_by_hand(successes: int, n: int, confidence: float, low: float, high: float) -> None:
    interval = wilson_interval(successes, n, confidence)
    assert interval.low == pytest.approx(low, abs=2e-6)
    assert interval.high == pytest.approx(high, abs=2e-6)


def test_wilson_ends_solve_the_score_equation() -> None:
    """Both ends are the rates p₀ from which the observed one is exactly z standard errors away."""
    for successes, n in [(1, 7), (40, 50), (123, 1000)]:
        interval = wilson_interval(successes, n, 0.95)
        for end in (interval.low, interval.high):
            distance = abs(successes / n - end) / math.sqrt(end * (1 - end) / n)
            assert distance == pytest.approx(1.959964, abs=1e-6)


def test_wilson_is_symmetric_nested_and_contains_the_rate() -> None:
    for n in (1, 3, 17, 100):
        for k in range(n + 1):
            narrow, wide = wilson_interval(k, n, 0.8), wilson_interval(k, n, 0.99)
            mirror = wilson_interval(n - k, n, 0.8)
            assert 0.0 <= wide.low <= narrow.low <= k / n <= narrow.high <= wide.high <= 1.0
            assert narrow.low == pytest.approx(1 - mirror.high, abs=1e-12)


def test_wilson_covers_about_as_often_as_it_says() -> None:
    for p in (0.1, 0.5, 0.9):
        n = 50
        chance = [math.comb(n, k) * p**k * (1 - p) ** (n - k) for k in range(n + 1)]
        coverage = sum(c for k, c in enumerate(chance) if p in wilson_interval(k, n))
        assert 0.93 < coverage < 0.98


def test_knowing_nothing() -> None:
    interval = wilson_interval(0, 0)
    assert (interval.low, interval.high) == (0.0, 1.0)
    assert math.isnan(Rate(successes=0, n=0).value) and str(Rate(successes=0, n=0)) == "no episodes"


def test_format() -> None:
    assert format_rate(93, 100) == "93.0 % [86.3, 96.6] n=100"
    assert str(Rate(successes=93, n=100)) == "93.0 % [86.3, 96.6] n=100"
    assert format_rate(0, 20) == "0.0 % [0.0, 16.1] n=20"
    assert format_rate(20, 20) == "100.0 % [83.9, 100.0] n=20"


@pytest.mark.parametrize(
    ("wins", "losses", "p"),
    [
        (0, 0, 1.0),
        (1, 0, 1.0),
        (5, 0, 2 / 32),
        (6, 0, 2 / 64),
        (8, 2, 2 * (1 + 10 + 45) / 1024),
        (5, 5, 1.0),  # twice the tail exceeds 1
    ],
)
def test_mcnemar_by_hand(wins: int, losses: int, p: float) -> None:
    assert mcnemar_p(wins, losses) == p == mcnemar_p(losses, wins)


def test_mcnemar_of_thousands_neither_overflows_nor_rounds_to_nonsense() -> None:
    assert mcnemar_p(2000, 2000) == 1.0
    assert 0.0 < mcnemar_p(2200, 1800) < 1e-8


def test_mcnemar_keeps_its_level() -> None:
    """Under no difference a p-value below 0.05 comes up in at most 5 % of all experiments."""
    for n in (5, 10, 25, 60):
        share = sum(math.comb(n, k) for k in range(n + 1) if mcnemar_p(k, n - k) <= 0.05) / 2**n
        assert share <= 0.05


def test_paired_interval_by_hand() -> None:
    # n = 98: a = 11/100, b = 3/100, half = 1.959964·√((0.14 − 0.0064)/100) = 0.071640
    interval = paired_interval(10, 2, 98)
    assert interval.low == pytest.approx(0.08 - 0.071640, abs=1e-6)
    assert interval.high == pytest.approx(0.08 + 0.071640, abs=1e-6)


def test_paired_interval_has_width_without_disagreement() -> None:
    interval = paired_interval(0, 0, 50)
    assert interval.low == -interval.high and interval.high > 0.04


def test_paired_interval_covers_about_as_often_as_it_says() -> None:
    rng = random.Random(0)
    for p_win, p_loss in [(0.2, 0.05), (0.02, 0.02), (0.3, 0.3)]:
        hits = 0
        for _ in range(1500):
            draws = [rng.random() for _ in range(60)]
            wins = sum(d < p_win for d in draws)
            losses = sum(p_win <= d < p_win + p_loss for d in draws)
            hits += (p_win - p_loss) in paired_interval(wins, losses, 60)
        assert hits / 1500 > 0.93


def outcomes(task: str, text: str) -> Outcomes:
    """``"10"``: seed 0 succeeds, seed 1 fails."""
    return {(task, seed): letter == "1" for seed, letter in enumerate(text)}


def test_compare_counts_pairs() -> None:
    result = compare(outcomes("push", "1111100000"), outcomes("push", "1000010000"))
    assert (result.n, result.wins, result.losses) == (10, 4, 1)
    assert result.difference == pytest.approx(0.3)
    assert result.p_value == 2 * (1 + 5) / 32
    assert result.difference in result.interval
    assert str(result).startswith("+30.0 points [") and "n=10 (4 won, 1 lost) p=0.38" in str(result)


def test_compare_turned_round_changes_only_the_sign() -> None:
    a, b = outcomes("push", "110101"), outcomes("push", "011000")
    there, back = compare(a, b), compare(b, a)
    assert back.difference == -there.difference and back.p_value == there.p_value
    assert back.interval.low == pytest.approx(-there.interval.high)


def test_a_mean_over_runs_is_as_unsure_as_they_differ() -> None:
    """t at 97.5 %: 2.776445 of four degrees of freedom, 12.706205 of one (Student's table)."""
    policies = [0.71, 0.47, 0.64, 0.33, 0.56]  # mean 0.542, s² = 0.08828 / 4
    half = 2.776445 * math.sqrt(0.08828 / 4 / 5)
    found = mean_interval(policies)
    assert (found.low, found.high) == pytest.approx((0.542 - half, 0.542 + half), abs=1e-6)
    assert mean_interval([0.9, 1.0]).low == pytest.approx(0.95 - 12.706205 * 0.05, abs=1e-6)
    assert mean_interval([0.3, 0.3]).low == pytest.approx(0.3)
    rng = random.Random(0)
    draws = [[rng.gauss(1.0, 2.0) for _ in range(5)] for _ in range(4000)]
    held = sum(1.0 in mean_interval(values, 0.9) for values in draws) / 4000
    assert held == pytest.approx(0.9, abs=0.02)
    for values, confidence in (([0.5], 0.95), ([], 0.95), ([0.1, 0.2], 1.0)):
        with pytest.raises(ValueError):
            mean_interval(values, confidence)


def test_pairing_sees_what_two_intervals_do_not() -> None:
    """a solves all that b solves and seven more: the Wilson intervals overlap, the paired test is clear."""
    a = outcomes("push", "1" * 60 + "1" * 7 + "0" * 33)
    b = outcomes("push", "1" * 60 + "0" * 7 + "0" * 33)
    assert total(a).interval().low < total(b).interval().high
    assert compare(a, b).p_value < 0.02 and compare(a, b).interval.low > 0.0


def test_compare_matches_by_task_and_seed_and_not_by_order() -> None:
    a = {("push", 0): True, ("push", 1): False, ("reach", 0): False}
    b = dict(reversed(list(a.items())))
    assert (compare(a, b).wins, compare(a, b).losses) == (0, 0)


def test_unpaired_episodes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"1 episodes have no partner, such as \('push', 2\)"):
        compare(outcomes("push", "111"), outcomes("push", "11"))
    with pytest.raises(ValueError, match="no episodes"):
        compare({}, {})


def test_per_task_and_means() -> None:
    both = {**outcomes("reach", "11"), **outcomes("push", "1000")}
    rates = per_task(both)
    assert list(rates) == ["push", "reach"]
    assert rates["push"] == Rate(successes=1, n=4) and rates["reach"] == Rate(successes=2, n=2)
    assert total(both) == Rate(successes=3, n=6)
    assert task_mean(rates) == pytest.approx(0.625)  # not 3/6: tasks count alike
    assert math.isnan(task_mean({}))
    with pytest.raises(ValueError, match="reach has no episode"):
        task_mean({"reach": Rate(successes=0, n=0)})


def test_nonsense_is_refused() -> None:
    for successes, n in [(-1, 5), (6, 5)]:
        with pytest.raises(ValueError, match="episodes"):
            wilson_interval(successes, n)
        with pytest.raises(ValueError, match="episodes"):
            Rate(successes=successes, n=n)
    for confidence in (0.0, 1.0, 95.0, math.nan):
        with pytest.raises(ValueError, match="confidence"):
            wilson_interval(1, 2, confidence)
    with pytest.raises(ValueError, match="pairs"):
        paired_interval(3, 3, 5)
    with pytest.raises(ValueError, match="wins"):
        mcnemar_p(-1, 2)
