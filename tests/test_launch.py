# SPDX-License-Identifier: Apache-2.0
"""The asynchronous engine with the real workers: one run at learning rate 0 that loses a rollout worker.

At rate 0 every policy is the same policy, so whatever happens to weights, observations and latents on their
way through the processes must leave every importance ratio at 1.
"""

import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.engines import Progress
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.evaluation import evaluation_plans
from accerl_lerobot.replay.buffer import ReplayConfig, lag_bound
from accerl_lerobot.rollout.runner import EpisodeResult, RolloutConfig
from accerl_lerobot.timeline import read_timeline
from benchmarks.simulated_environment import LatencyConfig
from tests.runs import collect, polls, tiny_run
from tests.timeline.folders import adds_up, gaps

UPDATES = 24
DURING = 8


@dataclass
class Story:
    """Reports of a run, in order."""

    config: RunConfig
    directory: Path
    before: list[EpisodeResult] = field(default_factory=list)
    after: list[EpisodeResult] = field(default_factory=list)
    history: list[Progress] = field(default_factory=list)
    saved: int = -1  # version saved in the middle of training

    @property
    def updates(self) -> list[dict[str, float]]:
        return [update for progress in self.history for update in progress.updates]

    @property
    def episodes(self) -> list[EpisodeResult]:
        return [episode for progress in self.history for episode in progress.episodes]

    def has(self, group: str) -> int:
        return sum(e.plan.group == group for e in self.episodes)


@pytest.fixture(scope="module")
def story(
    tiny_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory, light_ray: None
) -> Iterator[Story]:
    from accerl_lerobot.engines.ray_engine import RayEngine

    config = tiny_run(
        tiny_checkpoint,
        env=LatencyConfig(max_steps=16, frame_ms=8.0),
        rollout=RolloutConfig(workers=2, environments=3, segment_length=3),
        replay=ReplayConfig(
            capacity=96, min_decisions=16, max_unlearned_decisions=32, samples_per_insert=2.0
        ),
        trainer=TrainerConfig(
            updates=UPDATES,
            batch_decisions=16,
            lr=0.0,
            value_lr=0.0,
            warmup_updates=0,
            value_warmup_updates=0,
        ),
    )
    told = Story(config, tmp_path_factory.mktemp("saved"))
    config = told.config = replace(config, output_dir=str(told.directory))
    engine = RayEngine(config, ("match",))
    try:
        pids = engine.pids()
        engine.plan(evaluation_plans(("match",), 6, "before", filmed=1))
        told.before = collect(engine, "before", 6)
        engine.train()
        planned = killed = False
        for progress in polls(engine):
            told.history.append(progress)
            if progress.done and told.has("during") >= DURING:
                break
            if not planned and progress.version >= 4:
                planned = True
                engine.plan(evaluation_plans(("match",), DURING, "during"))
            elif planned and not killed:
                killed = True
                os.kill(pids["rollout 1"], signal.SIGKILL)
                saved = engine.save(told.directory / "middle")
                told.saved = saved.version
                told.history.append(replace(progress, updates=saved.updates, episodes=[]))
        engine.plan(evaluation_plans(("match",), 6, "after"))
        told.after = collect(engine, "after", 6)
        yield told
    finally:
        engine.close()


def test_all_updates_are_made_and_reported_once(story: Story):
    assert [u["update"] for u in story.updates] == [float(i + 1) for i in range(UPDATES)]
    assert story.history[-1].version == UPDATES and 4 <= story.saved <= UPDATES
    versions = [p.version for p in story.history]
    assert versions == sorted(versions)


def test_at_learning_rate_zero_every_ratio_is_one(story: Story):
    assert max(u["ratio_max_dev"] for u in story.updates) <= 1e-4
    assert max(abs(u["approx_kl"]) for u in story.updates) <= 1e-8
    assert all(u["ess"] > 0.9999 and u["clip_fraction"] == 0 and u["skipped"] == 0 for u in story.updates)


def test_samples_lag_behind_and_the_lag_is_bounded(story: Story):
    config = story.config
    under_way = config.rollout.workers * config.rollout.environments * config.rollout.segment_length
    bound = lag_bound(
        config.replay, batch_decisions=config.trainer.batch_decisions, in_flight=2 * under_way, pickup=2,
        prefetch=1,
    )  # fmt: skip
    lags = [u["lag_max"] for u in story.updates]
    assert 0 < max(lags) <= bound
    assert all(0 <= u["lag_mean"] <= u["lag_max"] for u in story.updates)


def test_the_books_of_replay_balance(story: Story):
    books = story.history[-1].replay
    for unit in ("segments", "decisions"):
        assert books[f"inserted_{unit}"] == books[f"stored_{unit}"] + books[f"removed_{unit}"]
    assert books["dropped_nonfinite"] == 0
    # What the trainer learned from is what replay handed out: no batch was drawn and then forgotten.
    assert books["trained_decisions"] == sum(u["decisions"] for u in story.updates)
    assert books["trained_decisions"] <= story.config.replay.samples_per_insert * books["inserted_decisions"]


def test_the_worker_that_was_killed_came_back_once_and_counters_never_fall(story: Story):
    assert story.history[-1].rollout["restarts"] == 1.0
    served = [p.inference["version"] for p in story.history if "version" in p.inference]
    assert served == sorted(served) and UPDATES // 2 < served[-1] <= UPDATES
    for name in ("env_steps", "decisions", "episodes", "restarts"):
        values = [p.rollout[name] for p in story.history]
        assert values == sorted(values) and values[-1] > values[0], f"{name} never falls"


def test_every_planned_episode_has_exactly_one_result(story: Story):
    for results, count in ((story.before, 6), (story.after, 6)):
        assert sorted(r.plan.index for r in results) == list(range(count))
    during = [e.plan.index for e in story.episodes if e.plan.group == "during"]
    assert sorted(during) == list(range(DURING))
    assert story.has("train") > 0
    explored = [e.plan.seed for e in story.episodes if e.plan.explore]
    assert len(set(explored)) == len(explored), "an exploring episode was reported twice"


def test_evaluation_uses_the_weights_of_its_time_and_equal_ones_give_equal_results(story: Story):
    """Batches differ between the two, and the process that ran them may; the episodes must not."""
    assert {r.versions for r in story.before} == {(0, 0)}
    assert {r.versions for r in story.after} == {(UPDATES, UPDATES)}
    during = [e.versions for e in story.episodes if e.plan.group == "during"]
    assert all(0 < old <= new <= UPDATES for old, new in during)
    before, after = (
        {r.plan.index: (r.success, r.steps, r.decisions) for r in results}
        for results in (story.before, story.after)
    )
    assert before == after
    assert [bool(r.frames) for r in sorted(story.before, key=lambda r: r.plan.index)] == [True] + [False] * 5


def test_every_worker_has_left_its_timeline(story: Story):
    timeline = read_timeline(story.directory)
    rows = {row.worker: row for row in timeline.rows}
    assert list(rows) == ["rollout 0", "rollout 1", "inference", "replay", "trainer"]
    assert [name for name, row in rows.items() if len(gaps(row))] == ["rollout 1"]
    adds_up(timeline)
    spent = timeline.shares()
    assert {"recovery", "compute", "transport", "wait_in"} <= spent["rollout"].keys()
    assert {"compute", "wait_in", "weights"} <= spent["inference"].keys()
    assert {"compute", "wait_in", "transport", "weights", "checkpoint"} <= spent["trainer"].keys()
    assert "checkpoint" in spent["replay"]
