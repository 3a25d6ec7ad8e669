# SPDX-License-Identifier: Apache-2.0
"""Which episode a free world is given."""

from __future__ import annotations

from accerl_lerobot.rollout.runner import (
    EpisodePlan,
    EpisodePlans,
    RolloutConfig,
    budgets,
    incarnation_after,
)
from accerl_lerobot.seeds import train_seed
from tests.rollout.worlds import evaluate

TASKS = ("push", "pull", "lift")


def make(worker: int = 0, incarnation: int = 0, budget: int | None = None) -> EpisodePlans:
    return EpisodePlans(TASKS, seed=3, worker=worker, incarnation=incarnation, budget=budget)


def take(plans: EpisodePlans, count: int) -> list[EpisodePlan]:
    found = [plans.next(exploring=True) for _ in range(count)]
    return [plan for plan in found if plan is not None]


def test_every_episode_has_its_own_seed_and_tasks_take_turns():
    plans = take(make(worker=1), 5)
    assert [p.task for p in plans] == ["pull", "lift", "push", "pull", "lift"]
    assert [p.seed for p in plans] == [train_seed(3, 1, number) for number in range(5)]
    assert all(p.explore for p in plans)


def test_evaluations_go_first_and_nothing_is_explored_before_it_is_time():
    plans = make()
    plans.queue([evaluate(index=0), evaluate(index=1)])
    assert [p.index for p in take(plans, 1)] == [0]
    assert plans.next(exploring=False) == evaluate(index=1)
    assert plans.next(exploring=False) is None
    assert take(plans, 1)[0].explore


def test_not_even_where_the_one_before_has_played_thousands():
    incarnation, seen = 0, set()
    for count in (1, 400, 990, 1010, 0, 1499):
        plans = make(incarnation=incarnation)
        said = count - 30  # the last episodes were begun after it had been asked
        seeds = {plan.seed for plan in take(plans, max(0, said))}
        starts = plans.starts
        seeds |= {plan.seed for plan in take(plans, min(count, 30))}
        assert len(seeds) == count and not seeds & seen
        seen |= seeds
        incarnation = incarnation_after(incarnation, starts)
    assert incarnation == 9


def test_no_more_episodes_than_were_paid_for():
    plans = make(budget=4)
    assert not plans.spent and len(take(plans, 9)) == 4 and plans.spent
    plans.queue([evaluate(index=0)])
    assert plans.next(exploring=True) == evaluate(index=0), "evaluations are not counted"
    endless = make()
    assert len(take(endless, 9)) == 9 and not endless.spent


def test_a_budget_is_shared_among_workers():
    assert budgets(RolloutConfig(episodes=7, workers=3)) == [3, 2, 2]
    assert budgets(RolloutConfig(episodes=1, workers=2)) == [1, 0]
    assert budgets(RolloutConfig(workers=2)) == [None, None]
