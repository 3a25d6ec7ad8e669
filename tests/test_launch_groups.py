# SPDX-License-Identifier: Apache-2.0
"""The asynchronous engine with groups of equal starts, and with the loss of a worker that holds some back.

At learning rate 0, so that ratios must be 1. Were a segment without an advantage to reach the trainer, the
run would end with an error.
"""

from __future__ import annotations

import os
import signal
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from accerl_lerobot.algorithms import GIPOConfig
from accerl_lerobot.engine.config import RunConfig
from accerl_lerobot.engine.loop import Progress
from accerl_lerobot.evaluation import evaluation_plans
from accerl_lerobot.replay import ReplayConfig, decisions_under_way, lag_bound
from accerl_lerobot.rollout.groups import open_limit
from accerl_lerobot.rollout.runner import EpisodeResult, RolloutConfig
from accerl_lerobot.trainer.config import TrainerConfig
from benchmarks.simulated_world import LatencyConfig
from tests.runs import collect, polls, tiny_run

pytestmark = pytest.mark.slow

UPDATES = 40
WORLDS = 4
SIZE = 3
EVALUATED = 8


@dataclass
class Story:
    """Reports of a run, in order."""

    config: RunConfig
    history: list[Progress] = field(default_factory=list)
    after: list[EpisodeResult] = field(default_factory=list)

    @property
    def updates(self) -> list[dict[str, float]]:
        return [update for progress in self.history for update in progress.updates]

    @property
    def explored(self) -> list[EpisodeResult]:
        return [e for progress in self.history for e in progress.episodes if e.plan.explore]


@pytest.fixture(scope="module")
def story(tiny_checkpoint: Path) -> Iterator[Story]:
    from accerl_lerobot.engine.launch import RayEngine

    config = tiny_run(
        tiny_checkpoint,
        env=LatencyConfig(task="match,mirror", max_steps=16, frame_ms=8.0),
        rollout=RolloutConfig(
            workers=2,
            worlds=WORLDS,
            segment_length=3,
            group_size=SIZE,
            group_filter="return",
        ),
        replay=ReplayConfig(capacity=96, min_decisions=16, ahead=32, samples_per_insert=2.0),
        algorithm=GIPOConfig(advantage="group", value_coef=0.0),
        trainer=TrainerConfig(updates=UPDATES, batch_decisions=16, lr=0.0, value_lr=0.0, warmup_updates=0),
    )
    told = Story(config)
    engine = RayEngine(config, ("match", "mirror"))
    try:
        pids = engine.pids()
        engine.train()
        killed = False
        for progress in polls(engine):
            told.history.append(progress)
            if progress.done:
                break
            if not killed and progress.version >= 4:
                killed = True
                os.kill(pids["rollout 1"], signal.SIGKILL)
        engine.plan(evaluation_plans(("match", "mirror"), EVALUATED, "after"))
        told.after = collect(engine, "after", EVALUATED)
        told.history.append(engine.poll())
        yield told
    finally:
        engine.close()


def test_all_updates_are_made_on_segments_of_their_own_policy(story: Story):
    assert [u["update"] for u in story.updates] == [float(i + 1) for i in range(UPDATES)]
    assert max(u["ratio_max_dev"] for u in story.updates) <= 1e-4


def test_the_episodes_of_a_group_share_seed_and_task_and_no_place(story: Story):
    places = Counter((e.plan.seed, e.plan.place) for e in story.explored)
    assert max(places.values()) == 1
    groups: dict[int, list[EpisodeResult]] = {}
    for episode in story.explored:
        groups.setdefault(episode.plan.seed, []).append(episode)
    assert all(
        len({(e.plan.task, e.plan.place.start) for e in g if e.plan.place}) == 1 for g in groups.values()
    )
    complete = [g for g in groups.values() if len(g) == SIZE]
    assert len(complete) >= 10
    # Members do differ: their noise does.
    assert any(len({e.episode_return for e in g}) > 1 for g in complete)


def test_a_lost_worker_loses_its_unfinished_groups_and_nothing_else(story: Story):
    """Groups may be incomplete at its last report, and at the two last reports at the end; no others."""
    last = story.history[-1]
    assert last.rollout["restarts"] == 1.0
    sizes = Counter(e.plan.seed for e in story.explored)
    assert sum(size < SIZE for size in sizes.values()) <= 3 * open_limit(SIZE, WORLDS)
    assert last.replay["duplicates"] == 0
    for name in ("groups_kept", "groups_dropped", "groups_dropped_decisions", "decisions"):
        values = [p.rollout.get(name, 0.0) for p in story.history]
        assert values == sorted(values), name
    assert last.rollout["groups_kept"] > 0
    assert sorted(r.plan.index for r in story.after) == list(range(EVALUATED))


def test_held_back_segments_are_within_the_bound_of_their_age(story: Story):
    config, rollout = story.config, story.config.rollout
    under_way = decisions_under_way(
        workers=rollout.workers,
        worlds=rollout.worlds,
        segment_length=rollout.segment_length,
        group_size=SIZE,
        episode_decisions=4,
    )
    bound = lag_bound(config.replay, batch_decisions=16, in_flight=2 * under_way, pickup=2, prefetch=1)
    assert 0 < max(u["lag_max"] for u in story.updates) <= bound
