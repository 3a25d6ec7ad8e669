# SPDX-License-Identifier: Apache-2.0
"""Which task comes next: exact probabilities, and draws that follow them."""

from __future__ import annotations

import numpy as np
import pytest

from accerl_lerobot.rollout.groups import TaskSampler

TASKS = ("easy", "middling", "hard")
CHI_SQUARE_99_9 = 13.82
"""With two degrees of freedom, exceeded once in a thousand."""


def sampler(sampling: str = "failures", window: int = 100, **arguments) -> TaskSampler:
    return TaskSampler(TASKS, sampling, window, **{"seed": (0, 0, 0), **arguments})


def test_uniform_takes_turns_from_where_it_is_told():
    assert sampler("uniform").next() == "easy"
    one = sampler("uniform", first=1001)
    assert [one.next() for _ in range(5)] == ["hard", "easy", "middling", "hard", "easy"]
    one.report("hard", False)
    assert one.next() == "middling", "a failure may not matter here"


def test_probabilities_by_hand():
    one = sampler()
    assert one.probabilities() == pytest.approx([1 / 3] * 3)
    for task, failures, successes in (("easy", 0, 9), ("middling", 2, 1), ("hard", 5, 0)):
        for _ in range(failures):
            one.report(task, False)
        for _ in range(successes):
            one.report(task, True)
    assert one.probabilities() == pytest.approx([1 / 10, 3 / 10, 6 / 10])


def test_only_the_last_episodes_of_each_task_count():
    one = sampler(window=4)
    for _ in range(10):
        one.report("hard", False)
    assert one.probabilities() == pytest.approx([1 / 7, 1 / 7, 5 / 7])
    one.report("easy", False)  # pushes nothing of another task out
    for _ in range(3):
        one.report("hard", True)
    assert one.probabilities() == pytest.approx([2 / 5, 1 / 5, 2 / 5])


@pytest.mark.parametrize("failures", [(0, 0, 0), (0, 3, 12), (40, 0, 100)])
def test_draws_follow_the_probabilities(failures):
    one = sampler()
    for task, count in zip(TASKS, failures, strict=True):
        for _ in range(count):
            one.report(task, False)
    draws = [one.next() for _ in range(6000)]
    weights = np.array([1 + count for count in failures])
    expected = 6000 * weights / weights.sum()
    found = np.array([draws.count(task) for task in TASKS])
    assert ((found - expected) ** 2 / expected).sum() < CHI_SQUARE_99_9


def test_equal_seeds_and_reports_give_equal_tasks_and_other_seeds_do_not():
    def draws(*seed: int) -> list[str]:
        one, found = sampler(seed=seed), []
        for i in range(60):
            found.append(one.next())
            one.report(found[-1], i % 3 == 0)
        return found

    assert draws(1, 2, 0) == draws(1, 2, 0)
    assert len({tuple(draws(*seed)) for seed in ((1, 2, 0), (1, 2, 1), (1, 3, 0), (2, 2, 0))}) == 4
