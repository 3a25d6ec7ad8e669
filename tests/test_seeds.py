# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Seed ranges never meet, and evaluation is paired across runs."""

from __future__ import annotations

import itertools

import pytest

from accerl_lerobot.errors import InputError
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
    assert demo_seed(999, 999_999) in DEMO_SEEDS
    assert demo_seed(0, 0) == 0 and demo_seed(2, 5) == 2_000_005
    assert train_seed(99, 999, 9_999) in TRAIN_SEEDS
    assert eval_seed(0) == 2_000_000_000


def test_training_seeds_differ_between_runs_workers_and_episodes():
    places = itertools.product((0, 1, 99), (0, 1, 999), (0, 1, 9_999))
    seeds = [train_seed(*place) for place in places]
    assert len(set(seeds)) == len(seeds)


def test_noise_differs_between_episodes_members_and_decisions():
    corners = (0, 1, 2**32 - 1), (0, 1, 255), (0, 1, 999_999)
    seeds = [noise_seed(*place) for place in itertools.product(*corners)]
    assert len(set(seeds)) == len(seeds) and min(seeds) == 0
    assert noise_seed(7, 0, 5) == 7 * 1_000_003 + 5


@pytest.mark.parametrize("call", [lambda: demo_seed(1_000, 0), lambda: train_seed(100, 0, 0)])
def test_a_run_seed_out_of_range_names_the_field(call):
    with pytest.raises(InputError, match="seed="):
        call()
