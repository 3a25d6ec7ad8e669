# SPDX-License-Identifier: Apache-2.0
"""Pacing under thousands of random and hostile steps: never stuck, over-used, or staler than stated."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.errors import InputError
from accerl_lerobot.replay.buffer import Replay, ReplayConfig, lag_bound
from tests.replay.segments import assert_books_balance, make_segment

CONFIG = ReplayConfig(capacity=100, min_decisions=10, samples_per_insert=2.0, max_unlearned_decisions=30)
WORKERS = 5


def test_a_pace_that_could_stall_or_waste_is_refused():
    config = ReplayConfig(capacity=32, min_decisions=8, max_unlearned_decisions=30)
    config.check(batch_decisions=30, segment_decisions=3)
    with pytest.raises(InputError, match=r"replay\.capacity=32: use at least 33"):
        config.check(batch_decisions=30, segment_decisions=4)
    with pytest.raises(InputError, match=r"replay\.max_unlearned_decisions=30: use at least one batch, 31"):
        config.check(batch_decisions=31, segment_decisions=3)
    reused = replace(CONFIG, samples_per_insert=1.5, max_lag=0)
    with pytest.raises(InputError, match=r"replay\.max_lag=0: .*samples_per_insert=1\.5 .* 1 updates old"):
        reused.check(batch_decisions=8, segment_decisions=4)
    replace(reused, max_lag=1).check(batch_decisions=8, segment_decisions=4)
    replace(reused, samples_per_insert=1.0).check(batch_decisions=8, segment_decisions=4)


def test_lag_bound_by_hand():
    # ⌊2·(30 + 2·12 + 100)/8⌋ − 1 = 37; pickup 4; prefetch 2
    arguments = {"batch_decisions": 8, "in_flight": 12, "pickup": 4, "prefetch": 2}
    assert lag_bound(CONFIG, **arguments) == 4 + 37 + 2
    assert lag_bound(replace(CONFIG, max_lag=9), **arguments) == 9


@dataclass
class Simulation:
    """Workers, a trainer and a publisher that are moved one event at a time; asserts the promises at each.

    A worker decides with the published version, then carries its segment around for as long as the schedule
    likes, within `in_flight`. `gate` says where it waits: before it starts collecting or before it inserts.
    """

    config: ReplayConfig
    batch: int
    longest: int
    publish_every: int
    gate: str
    seed: int

    def __post_init__(self) -> None:
        self.config.check(batch_decisions=self.batch, segment_decisions=self.longest)
        self.rng = np.random.default_rng(self.seed)
        self.replay = Replay(self.config)
        self.in_flight = 2 * WORKERS * self.longest
        pace = {"batch_decisions": self.batch, "in_flight": self.in_flight, "pickup": self.publish_every - 1}
        self.bound = lag_bound(self.config, **pace)
        self.version = self.published = self.worst_lag = self.started = 0
        self.carried: list[tuple[Any, int]] = []  # segments, each with what all had inserted before it

    def begin(self) -> None:
        if len(self.carried) == WORKERS or (self.gate == "begin" and not self.replay.may_insert()):
            return
        n = int(self.rng.integers(1, self.longest + 1))
        segment = make_segment(f"s{self.started}", n, version=self.published)
        self.started += 1
        self.carried.append((segment, self.replay.counters.inserted_decisions))

    def insert(self) -> None:
        """Inserts any segment, or the oldest if that would be carried for longer than assumed."""
        if not self.carried or (self.gate == "insert" and not self.replay.may_insert()):
            return
        since = self.replay.counters.inserted_decisions - self.carried[0][1]
        late = since + sum(len(segment) for segment, _ in self.carried) > self.in_flight
        segment, _ = self.carried.pop(0 if late else int(self.rng.integers(len(self.carried))))
        assert self.replay.insert(segment)

    def update(self) -> None:
        if not self.replay.may_sample(self.batch):
            return
        available = self.replay.available_decisions
        drawn = self.replay.sample(self.batch, self.version, self.rng)
        if not drawn:  # too old ones were retired: that is progress as well
            assert self.replay.available_decisions < available
            return
        assert len({s.key for s in drawn}) == len(drawn)
        assert self.batch <= sum(map(len, drawn)) < self.batch + len(drawn[-1]), "whole ones until enough"
        self.worst_lag = max(self.worst_lag, *(self.version - int(s.version.min()) for s in drawn))
        self.version += 1
        if self.version % self.publish_every == 0:
            self.published = self.version

    def run(self, events: int) -> None:
        """Phases in which one side is favoured, sometimes totally; the favour changes at random."""
        favour, counters = 0.5, self.replay.counters
        for event in range(events):
            if self.rng.random() < 0.02:
                favour = float(self.rng.choice([0.0, 0.05, 0.5, 0.95, 1.0]))
            if self.rng.random() < favour:
                self.update()
            elif self.rng.random() < 0.5:
                self.begin()
            else:
                self.insert()
            assert self.replay.may_insert() or self.replay.may_sample(self.batch), "deadlock"
            most = self.config.samples_per_insert * counters.inserted_decisions
            assert counters.trained_decisions <= most + 1e-6
            assert self.worst_lag <= self.bound <= self.config.max_lag
            if event % 10 == 0:
                assert_books_balance(self.replay)


@pytest.mark.parametrize("gate", ["begin", "insert"])
@pytest.mark.parametrize(
    ("capacity", "warm", "reuse", "ahead", "batch", "longest"),
    [(64, 16, 1.0, 32, 16, 4), (48, 40, 2.0, 8, 8, 9), (200, 1, 3.5, 12, 12, 6), (31, 16, 1.25, 30, 7, 2)],
)
def test_promises_hold_under_hostile_schedules(
    gate: str, capacity: int, warm: int, reuse: float, ahead: int, batch: int, longest: int
):
    pace = {"min_decisions": warm, "samples_per_insert": reuse, "max_unlearned_decisions": ahead}
    config = ReplayConfig(capacity=capacity, max_lag=10_000, **pace)
    for seed in range(2):
        simulation = Simulation(config, batch, longest, publish_every=1 + seed, gate=gate, seed=seed)
        simulation.run(2000)
        assert simulation.version > 15


@pytest.mark.parametrize("max_lag", [0, 1, 4])
def test_a_tight_max_lag_retires_but_never_stalls(max_lag: int):
    pace = {"samples_per_insert": min(2.0, 1.0 + max_lag), "max_unlearned_decisions": 32}
    config = ReplayConfig(capacity=64, min_decisions=16, max_lag=max_lag, **pace)
    simulation = Simulation(config, batch=8, longest=4, publish_every=1, gate="insert", seed=1)
    simulation.run(4000)
    assert simulation.replay.counters.removed_segments > 0
    assert simulation.version > 30 and simulation.worst_lag == max_lag
