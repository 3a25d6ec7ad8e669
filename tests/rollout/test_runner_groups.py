# SPDX-License-Identifier: Apache-2.0
"""Groups in a runner: episodes start alike and go on differently, whatever slot and order they run in."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from accerl_lerobot.envs import EnvConfig, MetaWorldConfig, SimulatedConfig, World, make_world
from accerl_lerobot.experience import Decision, Observation, Request, Segment
from accerl_lerobot.replay import decisions_under_way
from accerl_lerobot.rollout.groups import GroupSlot
from accerl_lerobot.rollout.plans import EpisodePlans
from accerl_lerobot.rollout.runner import EpisodeResult, RolloutConfig, RolloutRunner
from tests.rollout.worlds import ScriptedWorld, decide

CONFIG = RolloutConfig(segment_length=2, decision_cost=0.25, group_size=3, time_limit="truncate")


class Fleet:
    """A runner with its own plans; the test says which slot goes on.

    Args:
        worlds: one per slot.
        config: of groups and tasks.
    """

    def __init__(self, worlds: list[World], config: RolloutConfig = CONFIG) -> None:
        self.segments: list[Segment] = []
        self.results: list[EpisodeResult] = []
        self.exploring = True
        self.plans = EpisodePlans(config, worlds[0].spec.tasks, seed=0, worlds=len(worlds))
        self.runner = RolloutRunner(
            worlds, lambda: self.plans.next(self.exploring), config, "r0.0",
            self.segments.append, self.results.append, self.plans.groups,
        )  # fmt: skip
        self.due: dict[int, Request | None] = dict.fromkeys(range(len(worlds)))

    def start(self) -> None:
        """Gives every idle world an episode, if there is one."""
        for slot, request in self.due.items():
            if request is None:
                self.due[slot] = self.runner.start(slot)

    def advance(self, slot: int, decision: Decision | None = None) -> None:
        """One decision in a world; nothing, if it is idle."""
        request = self.due[slot]
        if request is not None:
            self.due[slot] = self.runner.advance(slot, decision or decide(request))


def test_segments_come_all_at_once_when_the_last_of_the_group_has_ended():
    worlds = [ScriptedWorld(4, "success"), ScriptedWorld(6, "failure"), ScriptedWorld(10, "limit")]
    fleet = Fleet(worlds)
    fleet.start()
    for slot, decisions in ((2, 4), (0, 2), (1, 3)):
        for _ in range(decisions):
            fleet.advance(slot)
        fleet.exploring = False
    assert len(fleet.results) == 2 and fleet.segments == []
    fleet.advance(2)
    # Rewards: 4 steps and 2 decisions; 6 and 3; 10 and 5.
    returns = np.array([4 - 0.5, 6 - 0.75, 10 - 1.25])
    expected = (returns - returns.mean()) / returns.std()
    assert [len(s) for s in fleet.segments] == [2, 2, 1, 2, 2, 1]
    for segment, member in zip(fleet.segments, [0, 1, 1, 2, 2, 2], strict=True):
        assert segment.advantage == pytest.approx(expected[member], abs=1e-4)
    assert [bool(s.episode) for s in fleet.segments] == [True, False, True, False, False, True]
    assert [s.terminated for s in fleet.segments] == [True, False, True, False, False, False]
    counted = fleet.runner.counters
    assert (counted.groups_kept, counted.groups_dropped, counted.groups_dropped_decisions) == (1, 0, 0)


def test_a_nan_takes_its_episode_out_of_the_group_and_leaves_the_others():
    worlds = [ScriptedWorld(4), ScriptedWorld(8, nan_at=5), ScriptedWorld(6, "failure")]
    fleet = Fleet(worlds)
    fleet.start()
    fleet.exploring = False
    for slot in (1, 1, 1, 0, 0, 2, 2, 2):
        fleet.advance(slot)
    assert [len(s) for s in fleet.segments] == [2, 2, 1] and len(fleet.results) == 2
    found = {float(s.advantage[0]) for s in fleet.segments if s.advantage is not None}
    assert sorted(found) == pytest.approx([-1, 1], abs=1e-4), "two are left, and they differ"
    counted = fleet.runner.counters
    assert counted.dropped_nonfinite == 1 and counted.groups_dropped_decisions == 2


def test_when_exploring_ends_unfinished_groups_are_dropped_even_if_a_decision_is_under_way():
    fleet = Fleet([ScriptedWorld(8), ScriptedWorld(4, "failure"), ScriptedWorld(4)])
    fleet.start()
    for slot in (0, 0, 1, 1):
        fleet.advance(slot)
    fleet.exploring = False
    fleet.runner.abandon_groups()
    for slot in (0, 0, 2, 2):
        fleet.advance(slot)
    counted = fleet.runner.counters
    assert fleet.segments == [] and counted.groups_kept == 0
    assert fleet.plans.groups is not None and fleet.plans.groups.held == 0
    # Slot 1 had begun an episode of a second group.
    assert (counted.groups_dropped, counted.groups_dropped_decisions) == (2, 4 + 2 + 2)


def assert_equal(one: Observation, other: Observation) -> None:
    assert one.keys() == other.keys()
    for key, value in one.items():
        assert np.array_equal(value, other[key]), key


def noisy(request: Request, actions: int, version: int = 0) -> Decision:
    """Actions drawn from the request's own seed, as a policy's noise is."""
    chunk = np.random.default_rng(request.noise_seed).uniform(-1, 1, (3, actions)).astype(np.float32)
    return Decision(
        chunk=chunk, latent={"x": chunk}, log_prob=np.zeros(1, np.float32), value=0.0, version=version
    )


@pytest.mark.parametrize(
    "env",
    [SimulatedConfig(max_steps=9), MetaWorldConfig(task="drawer-open-v3", max_steps=9, image_size=64)],
    ids=["simulated", "metaworld"],
)
def test_a_group_starts_alike_and_goes_on_differently(env: EnvConfig):
    """Two worlds, four members: each world runs more than one of them, with other episodes before."""
    if env.type == "metaworld":
        pytest.importorskip("metaworld")
    config = RolloutConfig(segment_length=4, group_size=4, group_filter="none")
    fleet = Fleet([make_world(env) for _ in range(2)], config)
    fleet.start()
    for turn in range(3 * 4 + 3):  # episodes of three decisions; the second world runs one ahead
        for slot in (0, 1, 1) if turn == 0 else (0, 1):
            request = fleet.due[slot]
            assert request is not None
            fleet.advance(slot, noisy(request, 2 if env.type == "simulated" else 4))
    fleet.runner.close()
    assert len(fleet.segments) == 8
    starts = []
    for group in (fleet.segments[:4], fleet.segments[4:]):
        first, *others = [{k: v[0] for k, v in s.observations.items()} for s in group]
        for other in others:
            assert_equal(first, other)
        ends = [s.observations["observation.state"][1] for s in group]
        assert all(not np.array_equal(ends[i], ends[j]) for i in range(4) for j in range(i))
        latents = [s.latent["x"] for s in group]
        assert all(not np.array_equal(latents[i], latents[j]) for i in range(4) for j in range(i))
        starts.append(first)
    assert any(not np.array_equal(starts[0][key], starts[1][key]) for key in starts[0])


def noise_by_member(slots: int, order: list[int], groups: int = 2) -> dict[GroupSlot, list[int]]:
    """Noise seeds of each member's decisions when slots advance in `order`, again and again."""
    fleet = Fleet([ScriptedWorld(6) for _ in range(slots)])
    found: dict[GroupSlot, list[int]] = {}
    while len(fleet.results) < 3 * groups + slots:
        fleet.start()
        for slot in order:
            plan, request = fleet.runner._slots[slot].plan, fleet.due[slot]
            assert plan is not None and plan.place is not None and request is not None
            found.setdefault(plan.place, []).append(request.noise_seed)
            fleet.advance(slot)
    return {place: seeds for place, seeds in found.items() if place.start < groups}


def test_noise_depends_on_the_member_and_not_on_who_runs_it():
    alone = noise_by_member(1, [0])
    assert set(alone) == {GroupSlot(start, member) for start in range(2) for member in range(3)}
    assert all(len(seeds) == 3 for seeds in alone.values())
    every = [seed for seeds in alone.values() for seed in seeds]
    assert len(set(every)) == len(every), "no two decisions share their noise"
    for slots, order in ((3, [2, 0, 1]), (4, [0, 1, 1, 3, 2]), (2, [1, 1, 1, 0])):
        assert noise_by_member(slots, order) == alone


class Fitful(ScriptedWorld):
    """Episodes of any length up to `longest` decisions."""

    def __init__(self, rng: np.random.Generator, longest: int) -> None:
        super().__init__(steps=2 * longest)
        self.rng, self.longest = rng, longest

    def reset(self, seed: int, task: str) -> Observation:
        short = self.rng.random() < 0.3
        self.steps = 2 * (1 if short else int(self.rng.integers(1, self.longest + 1)))
        return super().reset(seed, task)


@pytest.mark.parametrize(
    ("workers", "worlds", "size"), [(2, 4, 0), (1, 8, 8), (2, 8, 4), (2, 3, 8), (1, 1, 4), (2, 4, 6)]
)
def test_how_long_segments_are_held_back(workers: int, worlds: int, size: int):
    """The premises of `decisions_under_way`, with worlds of equal speed that all go on at every tick.

    A segment's version tells what had been inserted when its first decision was made, and its value when.
    """
    rng = np.random.default_rng(0)
    longest, length, inserted = 10, 4, 0
    config = RolloutConfig(worlds=worlds, segment_length=length, group_size=size, group_filter="none")
    fleets = [Fleet([Fitful(rng, longest) for _ in range(worlds)], config) for _ in range(workers)]
    most, ticks = 0, 0
    for tick in range(500):
        for fleet in fleets:
            fleet.start()
            for slot in rng.permutation(worlds).tolist():
                request = fleet.due[slot]
                if request is not None:
                    decision = replace(decide(request), version=inserted, value=float(tick))
                    fleet.advance(slot, decision)
                for segment in fleet.segments:
                    inserted += len(segment)
                    most = max(most, inserted - int(segment.version.min()))
                    ticks = max(ticks, tick + 1 - int(segment.value.min()))
                fleet.segments.clear()
    counts = {"workers": workers, "worlds": worlds, "segment_length": length}
    under_way = decisions_under_way(**counts, group_size=size, episode_decisions=longest)
    assert ticks <= under_way // (workers * worlds)
    assert under_way / 2 < most <= 2 * under_way
    if size:
        rounds = 1 + math.ceil((size - 1) / worlds)
        assert under_way == workers * worlds * rounds * longest
        assert most > 2 * decisions_under_way(**counts), "the formula without groups would not hold"
