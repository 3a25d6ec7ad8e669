# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.paired_eval import agreement, even_threshold, matthews, mmrv, pearson, spearman


def outcomes(rates: list[float], count: int = 20) -> np.ndarray:
    """Successes of each policy's first episodes, so many each."""
    return np.arange(count)[None] < np.array(rates)[:, None] * count


def test_rollouts_that_are_reality_agree_in_everything():
    real = outcomes([0.1, 0.3, 0.5, 0.9])
    found = {name: estimate["value"] for name, estimate in agreement(real, real).items()}
    assert found == pytest.approx(
        {"pearson": 1, "spearman": 1, "mmrv": 0, "bias": 0, "slope": 1, "mcc": 1}, abs=1e-12
    )


def test_rollouts_that_flatter_keep_the_order():
    real, imagined = outcomes([0.1, 0.2, 0.3]), outcomes([0.6, 0.8, 1.0])
    found = {name: estimate["value"] for name, estimate in agreement(real, imagined).items()}
    assert found["spearman"] == pytest.approx(1) and found["mmrv"] == 0
    assert found["bias"] == pytest.approx(0.6) and found["slope"] == pytest.approx(0.5)
    # 2 of 20 succeed in reality, 12 in rollouts, the 2 among them: (2·8 − 0·10)/√(12·8·2·18).
    first = matthews(real[0], imagined[0])
    assert first == pytest.approx(16 / math.sqrt(12 * 8 * 2 * 18))
    # Of the last policy rollouts never fail: it is left out.
    assert found["mcc"] == pytest.approx((first + matthews(real[1], imagined[1])) / 2)


def test_correlations_by_hand():
    x, y = np.array([1.0, 2, 3, 4]), np.array([2.0, 1, 4, 3])
    assert pearson(x, y) == pytest.approx(0.6) == spearman(x, y)
    assert spearman(np.array([1.0, 10, 100]), np.array([1.0, 2, 3])) == pytest.approx(1)
    # Ranks 1.5, 1.5, 3 beside 1, 2, 3.
    assert spearman(np.array([5.0, 5, 7]), np.array([1.0, 2, 3])) == pytest.approx(math.sqrt(3) / 2)
    assert math.isnan(pearson(np.ones(3), np.arange(3.0)))


def test_violations_weigh_what_they_cost():
    """Rollouts swap the first two of 0.1, 0.2 and 0.9: each is wrong by 0.1, the third by nothing."""
    assert mmrv(np.array([0.1, 0.2, 0.9]), np.array([0.5, 0.4, 0.8])) == pytest.approx(0.2 / 3)
    assert mmrv(np.array([0.1, 0.2, 0.9]), np.array([0.9, 0.4, 0.1])) == pytest.approx((0.8 + 0.7 + 0.8) / 3)


def test_the_threshold_at_which_rollouts_succeed_as_often():
    said = np.array([[0.2, 0.9, 0.7, 0.99], [0.95, 0.1, 0.8, 0.6]])
    real = np.array([[False, True, False, True], [True, False, False, False]])
    least = even_threshold(real, said)
    assert least == pytest.approx((0.9 + 0.8) / 2) and (said > least).sum() == 3
    assert even_threshold(np.zeros((2, 4), bool), said) == pytest.approx((1 + 0.99) / 2)
    assert even_threshold(np.ones((2, 4), bool), said) == pytest.approx(0.1 / 2)
    tied = np.array([[1.0, 1.0, 1.0, 0.5]])
    least = even_threshold(np.array([[True, True, False, False]]), tied)
    assert least == pytest.approx(0.75) and (tied > least).sum() == 3, (
        "two would be none or all three of them"
    )
