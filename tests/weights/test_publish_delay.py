# SPDX-License-Identifier: Apache-2.0
"""Weights that are published late."""

from __future__ import annotations

import numpy as np
import pytest

from accerl_lerobot.weights.publisher import PublishDelay


def published(updates: int, every: int, until: int) -> dict[int, list[int]]:
    """Update → versions published then."""
    delay = PublishDelay(updates)
    found = {}
    for version in range(0, until + 1, every):
        due = delay.push(version, {"w": np.full(1, version)}, last=version == until)
        assert all(int(tensors["w"][0]) == number for number, tensors in due)
        found[version] = [number for number, _ in due]
    return found


def test_nothing_is_delayed_by_default():
    assert published(0, 1, 3) == {0: [0], 1: [1], 2: [2], 3: [3]}


def test_each_version_comes_so_many_updates_late_and_the_last_at_once():
    assert published(2, 1, 6) == {0: [0], 1: [], 2: [], 3: [1], 4: [2], 5: [3], 6: [6]}


@pytest.mark.parametrize(("updates", "every"), [(3, 2), (4, 3), (1, 5)])
def test_a_version_is_published_with_the_first_publication_that_finds_it_old_enough(updates: int, every: int):
    acting = 0
    for version, due in list(published(updates, every, 10 * every).items())[:-1]:
        assert all(number <= max(0, version - updates) for number in due)
        acting = due[-1] if due else acting
        assert acting == max(0, (version - updates) // every * every)
