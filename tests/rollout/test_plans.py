# SPDX-License-Identifier: Apache-2.0
"""Which episode a free world is given."""

from __future__ import annotations

import itertools

import pytest

from accerl_lerobot.rollout.groups import EpisodeOutcome, GroupSlot
from accerl_lerobot.rollout.plans import (
    STARTS_PER_INCARNATION,
    EpisodePlans,
    budgets,
    incarnation_after,
    whole_groups,
)
from accerl_lerobot.rollout.runner import EpisodePlan, RolloutConfig
from accerl_lerobot.seeds import train_seed
from tests.rollout.worlds import evaluate

TASKS = ("push", "pull", "lift")


def make(worlds: int = 4, worker: int = 0, incarnation: int = 0, **config) -> EpisodePlans:
    return EpisodePlans(
        RolloutConfig(**config), TASKS, seed=3, worlds=worlds, worker=worker, incarnation=incarnation
    )


def take(plans: EpisodePlans, count: int) -> list[EpisodePlan]:
    found = [plans.next(exploring=True) for _ in range(count)]
    return [plan for plan in found if plan is not None]


def test_without_groups_every_episode_has_its_own_seed_and_tasks_take_turns():
    plans = take(make(worker=1), 5)
    assert [p.task for p in plans] == ["pull", "lift", "push", "pull", "lift"]
    assert [p.seed for p in plans] == [train_seed(3, 1, number) for number in range(5)]
    assert all(p.explore and p.place is None for p in plans)


def test_evaluations_go_first_and_nothing_is_explored_before_it_is_time():
    plans = make(group_size=2)
    plans.queue([evaluate(index=0), evaluate(index=1)])
    assert [p.index for p in take(plans, 1)] == [0]
    assert plans.next(exploring=False) == evaluate(index=1)
    assert plans.next(exploring=False) is None
    assert take(plans, 1)[0].place == GroupSlot(0, 0)
    plans.queue([evaluate(index=2)])
    following = take(plans, 2)  # the group goes on where it was
    assert not following[0].explore and following[1].place == GroupSlot(0, 1)


def test_a_group_shares_its_start_and_the_next_group_has_another():
    plans = take(make(group_size=4, worlds=8), 12)
    assert [p.place for p in plans] == [GroupSlot(start, member) for start in range(3) for member in range(4)]
    starts = [{(p.task, p.seed) for p in group} for _, group in itertools.groupby(plans, _start)]
    assert starts == [{(task, train_seed(3, 0, i))} for i, task in enumerate(TASKS)]


def _start(plan: EpisodePlan) -> int:
    assert plan.place is not None
    return plan.place.start


def test_a_world_waits_when_too_many_groups_are_unfinished():
    plans = make(group_size=4, worlds=4)
    assert plans.groups is not None
    unfinished = take(plans, 30)
    assert len(unfinished) == 4 * plans.groups.limit
    for plan in unfinished[:4]:
        assert plan.place is not None
        plans.groups.end(plan.place, EpisodeOutcome(0.0, False))
    assert take(plans, 1)[0].place == GroupSlot(plans.groups.limit, 0)


@pytest.mark.parametrize("group_size", [0, 4])
def test_another_incarnation_repeats_no_seed(group_size):
    seeds = []
    for incarnation in range(3):
        plans = make(incarnation=incarnation, group_size=group_size, worlds=400)
        seeds.append({p.seed for p in take(plans, 400)})
        assert train_seed(3, 0, incarnation * STARTS_PER_INCARNATION) in seeds[-1]
    assert not set.intersection(*seeds) and len(set.union(*seeds)) == 3 * (100 if group_size else 400)


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


@pytest.mark.parametrize("group_size", [0, 2])
def test_no_more_episodes_than_were_paid_for(group_size: int):
    config = RolloutConfig(group_size=group_size, episodes=4)
    plans = EpisodePlans(config, TASKS, seed=3, worlds=8, budget=4)
    assert not plans.spent and len(take(plans, 9)) == 4 and plans.spent
    plans.queue([evaluate(index=0)])
    assert plans.next(exploring=True) == evaluate(index=0), "evaluations are not counted"
    endless = EpisodePlans(config, TASKS, seed=3, worlds=8)
    assert len(take(endless, 9)) >= 8 and not endless.spent


def test_a_budget_is_shared_among_workers_in_whole_groups():
    assert budgets(RolloutConfig(episodes=7, workers=3)) == [3, 2, 2]
    assert budgets(RolloutConfig(episodes=64, workers=3, group_size=8)) == [24, 24, 16]
    assert budgets(RolloutConfig(episodes=8, workers=2, group_size=8)) == [8, 0]
    assert budgets(RolloutConfig(workers=2)) == [None, None]
    assert [whole_groups(n, RolloutConfig(group_size=4)) for n in (0, 1, 4, 5)] == [0, 4, 4, 8]
    assert whole_groups(5, RolloutConfig()) == 5
