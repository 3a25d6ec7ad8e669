# SPDX-License-Identifier: Apache-2.0
"""Groups: what is compared with what, what is thrown away, and that no decision is lost from the books."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import pytest

from accerl_lerobot.experience import Segment
from accerl_lerobot.rollout.groups import (
    STD_EPSILON,
    EpisodeOutcome,
    GroupFilter,
    Groups,
    GroupSlot,
    comparable,
    group_advantages,
    open_limit,
)
from tests.replay.segments import make_segment

WON, LOST = EpisodeOutcome(0.9, True), EpisodeOutcome(-0.3, False)


def advantages_by_hand(returns: Sequence[float]) -> list[float]:
    """The formula, one episode and one term at a time."""
    mean = sum(returns) / len(returns)
    std = math.sqrt(sum((r - mean) ** 2 for r in returns) / len(returns))
    return [(r - mean) / (std + 1e-6) for r in returns]


def test_advantages_by_hand():
    # mean 1, deviations −1, −1, −1, 3; variance 12/4 = 3
    expected = [-0.57735, -0.57735, -0.57735, 1.73205]
    assert group_advantages(np.array([0.0, 0.0, 0.0, 4.0])) == pytest.approx(expected, abs=1e-5)
    assert group_advantages(np.full(5, 0.1)) == pytest.approx([0.0] * 5, abs=1e-9), "and not NaN"


def test_advantages_agree_with_a_slow_oracle():
    rng = np.random.default_rng(0)
    for _ in range(200):
        returns = rng.normal(rng.normal(0, 5), rng.choice([0.01, 1, 50]), int(rng.integers(2, 17)))
        found = group_advantages(returns)
        assert found == pytest.approx(advantages_by_hand(list(returns)), rel=1e-9, abs=1e-12)
        assert abs(found.sum()) < 1e-6 * max(1.0, np.abs(found).max())
        assert (np.argsort(found) == np.argsort(returns)).all()


@pytest.mark.parametrize(
    ("outcomes", "kept_under"),
    [
        ([WON, LOST], {"outcome", "return", "none"}),
        ([WON, EpisodeOutcome(0.8, True)], {"return", "none"}),  # one was faster
        ([LOST, EpisodeOutcome(-0.2, False)], {"return", "none"}),
        ([WON, WON], {"none"}),
        ([LOST, LOST, LOST], {"none"}),
        ([EpisodeOutcome(1.0, True), EpisodeOutcome(1.0, False)], {"none"}),  # every advantage would be 0
        ([EpisodeOutcome(1.0, True), EpisodeOutcome(1.0 + STD_EPSILON / 2, True)], {"none"}),
    ],
)
def test_which_groups_are_worth_learning_from(outcomes, kept_under):
    rules: tuple[GroupFilter, ...] = ("outcome", "return", "none")
    assert {rule for rule in rules if comparable(outcomes, rule)} == kept_under


def segments_of(member: int, count: int = 2) -> list[Segment]:
    return [make_segment(f"m{member}.{i}", n=i + 1) for i in range(count)]


def play(groups: Groups, outcomes: Sequence[EpisodeOutcome | None], order: Sequence[int]) -> list[Segment]:
    """One group whose members end in `order`; what is released."""
    places = [groups.claim() for _ in outcomes]
    assert all(place is not None for place in places)
    released: list[Segment] = []
    for turn, i in enumerate(order):
        place = places[i]
        assert place is not None
        for segment in segments_of(place.member):
            groups.add(place, segment)
        released = groups.end(place, outcomes[i])
        assert turn == len(order) - 1 or released == [], "released before all had ended"
    return released


def test_each_decision_of_an_episode_gets_the_same_advantage():
    groups = Groups(3, worlds=3)
    released = play(groups, [WON, LOST, LOST], (0, 1, 2))
    assert [(s.key, len(s)) for s in released] == [
        (f"m{member}.{i}", i + 1) for member in range(3) for i in range(2)
    ]
    for segment in released:
        assert segment.advantage is not None
        assert segment.advantage.dtype == np.float32 and segment.advantage.shape == (len(segment),)
        # deviations 0.8, −0.4, −0.4 of a group whose std is √(0.96/3)
        expected = (0.8 if segment.key.startswith("m0") else -0.4) / math.sqrt(0.32)
        assert segment.advantage == pytest.approx(expected, rel=1e-5)
    assert (groups.counters.kept, groups.counters.dropped, groups.open, groups.held) == (1, 0, 0, 0)


def test_the_order_in_which_episodes_end_does_not_matter():
    outcomes = [EpisodeOutcome(0.5, True), LOST, EpisodeOutcome(0.7, True), None]
    every = []
    for order in itertools.permutations(range(4)):
        released = play(Groups(4, worlds=4), outcomes, order)
        every.append([(s.key, s.advantage.tolist()) for s in released if s.advantage is not None])
    assert len(every) == 24 and len(every[0]) == 6 and all(one == every[0] for one in every)


def test_an_episode_that_is_thrown_away_leaves_its_group():
    groups = Groups(3, worlds=3)
    released = play(groups, [WON, None, LOST], (1, 0, 2))
    found = {s.key[:2]: float(s.advantage[0]) for s in released if s.advantage is not None}
    assert found == pytest.approx({"m0": 1.0, "m2": -1.0}, abs=1e-5)
    assert (groups.counters.kept, groups.counters.dropped_decisions) == (1, 3)


@pytest.mark.parametrize("outcomes", [[WON, None, None], [None, None, None]])
@pytest.mark.parametrize("rule", ["outcome", "return", "none"])
def test_fewer_than_two_are_no_group(outcomes, rule):
    groups = Groups(3, worlds=3, rule=rule)
    assert play(groups, outcomes, (0, 1, 2)) == []
    assert (groups.counters.kept, groups.counters.dropped, groups.counters.dropped_decisions) == (0, 1, 9)


@pytest.mark.parametrize("outcome", [WON, LOST])
def test_a_group_with_one_outcome_is_dropped_and_counted(outcome):
    groups = Groups(2, worlds=2)
    faster = outcome._replace(episode_return=outcome.episode_return + 0.1)
    assert play(groups, [outcome, faster], (0, 1)) == []
    counted = groups.counters
    assert (counted.kept, counted.dropped) == (0, 1)
    assert (counted.released_decisions, counted.dropped_decisions) == (0, 6)


def test_one_group_is_completed_before_the_next_begins():
    groups = Groups(3, worlds=4)
    assert open_limit(3, 4) == groups.limit == 5
    claimed = [groups.claim() for _ in range(7)]
    assert claimed == [
        *(GroupSlot(0, i) for i in range(3)),
        *(GroupSlot(1, i) for i in range(3)),
        GroupSlot(2, 0),
    ]


def test_at_the_limit_a_world_waits_until_a_group_has_ended():
    groups = Groups(4, worlds=4)
    places = [place for place in (groups.claim() for _ in range(13)) if place is not None]
    assert len(places) == 12 and groups.open == groups.limit == 3
    for place in places[4:7]:
        groups.end(place, WON)
    assert groups.claim() is None
    groups.end(places[7], LOST)
    assert groups.claim() == GroupSlot(3, 0)


def test_abandoned_groups_are_dropped_and_what_follows_of_them_is_ignored():
    groups = Groups(2, worlds=4)
    first, second, lonely = groups.claim(), groups.claim(), groups.claim()
    assert first is not None and second is not None and lonely is not None
    groups.add(first, make_segment("a", 3))
    groups.end(first, WON)
    groups.abandon()
    groups.abandon()
    assert (groups.open, groups.held, groups.counters.dropped) == (0, 0, 2)
    groups.add(second, make_segment("b", 2))
    assert groups.end(second, LOST) == [] and groups.end(lonely, None) == []
    counted = groups.counters
    assert (counted.entered_decisions, counted.dropped_decisions, counted.dropped) == (5, 5, 2)
    assert groups.claim() == GroupSlot(2, 0), "nobody may join a group that was given up"


@pytest.mark.parametrize(("size", "worlds"), [(2, 8), (4, 8), (8, 4), (3, 5), (16, 1)])
@pytest.mark.parametrize("rule", ["outcome", "return", "none"])
def test_the_books_balance_whatever_happens(size, worlds, rule):
    rng = np.random.default_rng(0)
    groups = Groups(size, worlds, rule)
    running: dict[int, GroupSlot] = {}
    entered: dict[str, GroupSlot] = {}
    released: dict[str, Segment] = {}
    outcomes: dict[GroupSlot, EpisodeOutcome | None] = {}
    claimed: list[GroupSlot] = []
    for event in range(4000):
        world = int(rng.integers(worlds))
        if rng.random() < 0.002:
            groups.abandon()
        if world not in running:
            place = groups.claim()
            if place is None:
                assert running, "every world waits"
                continue
            running[world] = place
            claimed.append(place)
        place = running[world]
        if rng.random() < 0.6:
            entered[f"s{event}"] = place
            groups.add(place, make_segment(f"s{event}", int(rng.integers(1, 5))))
        else:
            thrown_away = rng.random() < 0.1
            success = bool(rng.random() < 0.5)
            outcomes[place] = (
                None if thrown_away else EpisodeOutcome(float(success - rng.integers(3) / 4), success)
            )
            for segment in groups.end(running.pop(world), outcomes[place]):
                assert segment.key not in released
                released[segment.key] = segment
        counted = groups.counters
        assert groups.open <= groups.limit
        gone = counted.released_decisions + counted.dropped_decisions
        assert counted.entered_decisions == gone + groups.held
    assert len(set(claimed)) == len(claimed)
    assert counted.kept > 20 and counted.released_decisions == sum(map(len, released.values()))
    assert counted.kept + counted.dropped + groups.open == 1 + max(p.start for p in claimed)
    for key, segment in released.items():
        group = [outcomes[p] for p in claimed if p.start == entered[key].start]
        left = [o.episode_return for o in group if o is not None]
        mine = outcomes[entered[key]]
        assert mine is not None and len(group) == size and segment.advantage is not None
        expected = advantages_by_hand(left)[left.index(mine.episode_return)]
        assert segment.advantage == pytest.approx(expected, rel=1e-4, abs=1e-5)
