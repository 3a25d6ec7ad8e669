# SPDX-License-Identifier: Apache-2.0
"""Observations are batched as they came."""

from __future__ import annotations

import numpy as np

from accerl_lerobot.policies.base import stack_observations
from tests.policies.tiny import requests


def test_observations_are_stacked_in_the_order_of_the_requests():
    asked = requests(3)
    arrays, tasks = stack_observations(asked)
    assert tasks == [r.observation["task"] for r in asked] and "task" not in arrays
    for key, array in arrays.items():
        assert all(np.array_equal(array[i], r.observation[key]) for i, r in enumerate(asked))
        assert array.dtype == asked[0].observation[key].dtype
