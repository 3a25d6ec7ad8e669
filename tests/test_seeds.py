# SPDX-License-Identifier: Apache-2.0
"""Seed ranges never meet, and evaluation is paired across runs."""

from __future__ import annotations

import itertools

from accerl_lerobot.seeds import (
    DEMO_SEEDS,
    EVAL_SEEDS,
    TRAIN_SEEDS,
    demo_seed,
    eval_seed,
    noise_seed,
    train_seed,
)


def test_ranges_are_disjoint_and_fit_32_bits():
    ranges = [DEMO_SEEDS, TRAIN_SEEDS, EVAL_SEEDS]
    for one, other in itertools.pairwise(ranges):
        assert one.stop <= other.start
    assert ranges[-1].stop <= 2**32


def test_seeds_stay_in_their_range_at_the_corners():
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
