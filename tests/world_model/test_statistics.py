# SPDX-License-Identifier: Apache-2.0
"""The statistics of validations, against slow sums and numbers by hand."""

from __future__ import annotations

import numpy as np
import pytest

from accerl_lerobot.world_model.rollout_eval import auroc, bootstrap
from accerl_lerobot.world_model.validation import mean_error, sensitivity, skill, squared_errors


def frames(*values: int) -> np.ndarray:
    """One camera, 1×2 pixels, of one colour each."""
    return np.stack([np.full((1, 1, 2, 3), v, np.uint8) for v in values])


def test_errors_are_sums_over_counted_pixels():
    rng = np.random.default_rng(0)
    a, b = (rng.integers(0, 256, (3, 2, 4, 5, 3), dtype=np.uint8) for _ in range(2))
    mask = rng.random((3, 2, 4, 5)) < 0.3
    sums = squared_errors(a, b, mask)
    for m in range(3):
        errors = [
            np.mean([(int(x) - int(y)) ** 2 for x, y in zip(a[m, v, i, j], b[m, v, i, j], strict=True)])
            for v, i, j in zip(*np.nonzero(mask[m]), strict=True)
        ]
        assert sums[m].tolist() == pytest.approx([sum(errors), len(errors)])
    assert mean_error(sums) == pytest.approx(sums[:, 0].sum() / mask.sum())
    assert mean_error(squared_errors(a, b)) == pytest.approx(((a.astype(float) - b) ** 2).mean())


def test_skill_and_sensitivity_by_hand():
    wanted, of = frames(100, 100), np.arange(2)
    model, copy = squared_errors(frames(98, 96), wanted), squared_errors(frames(90, 110), wanted)
    assert skill(model, copy, of)["value"] == pytest.approx(1 - 10 / 100)
    assert sensitivity(model, copy, of)["value"] == pytest.approx(100 / 10)
    assert [*skill(copy, copy, of).values()] == pytest.approx([0, 0, 0])
    assert [*sensitivity(copy, copy, of).values()] == pytest.approx([1, 1, 1])
    exact = squared_errors(wanted, wanted)
    assert {*sensitivity(exact, copy, of).values()} == {np.inf}
    assert {*sensitivity(exact, exact, of).values()} == {1.0}


def test_windows_of_one_episode_are_drawn_together():
    """A hundred copies of ten rows say no more than the ten do."""
    values = np.random.default_rng(0).standard_normal(10)
    ten = bootstrap(np.arange(10), lambda rows: float(values[rows].mean()))
    assert ten["low"] < ten["value"] < ten["high"]
    copies, groups = np.tile(values, 100), np.tile(np.arange(10), 100)
    assert bootstrap(groups, lambda rows: float(copies[rows].mean())) == pytest.approx(ten)
    alone = bootstrap(np.arange(1000), lambda rows: float(copies[rows].mean()))
    assert alone["high"] - alone["low"] < 0.2 * (ten["high"] - ten["low"])


def test_a_statistic_that_is_not_always_there():
    labels = np.array([True] + [False] * 9)
    scores = np.arange(10.0)
    estimate = bootstrap(np.arange(10), lambda rows: auroc(scores[rows], labels[rows]))
    assert estimate["value"] == 0.0 and estimate["low"] == 0.0 <= estimate["high"]
    never = bootstrap(np.arange(10), lambda rows: auroc(scores[rows], np.zeros(len(rows), bool)))
    assert all(np.isnan(value) for value in never.values())


def test_auroc_is_the_share_of_pairs_in_order():
    rng = np.random.default_rng(0)
    scores, labels = rng.integers(0, 6, 40).astype(float), rng.random(40) < 0.4
    pairs = [(a > b) + 0.5 * (a == b) for a in scores[labels] for b in scores[~labels]]
    assert auroc(scores, labels) == pytest.approx(np.mean(pairs))
    assert auroc(np.array([1.0, 2, 3, 4]), np.array([False, False, True, True])) == 1.0
