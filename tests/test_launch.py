# SPDX-License-Identifier: Apache-2.0
"""The asynchronous engine with the real workers: one run that loses a rollout worker.

Its learning rate is 0: whatever happens to weights, observations and latents leaves every ratio at 1.
"""

import os
import signal
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from accerl_lerobot.engines import Progress
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.evaluation import evaluation_plans
from accerl_lerobot.replay.buffer import lag_bound
from accerl_lerobot.rollout.runner import EpisodeResult
from accerl_lerobot.timeline import read_timeline
from benchmarks.simulated_environment import LatencyConfig
from tests.runs import collect, polls, tiny_run, until, updates
from tests.timeline.folders import adds_up, gaps

UPDATES = 24
DURING = 8


@dataclass
class Story:
    config: RunConfig
    before: list[EpisodeResult]
    history: list[Progress]
    after: list[EpisodeResult] = field(default_factory=list)
    saved: int = -1  # version saved in the middle of training

    @property
    def updates(self) -> list[dict[str, float]]:
        return updates(self.history)

    def episodes(self, group: str) -> list[EpisodeResult]:
        return [e for progress in self.history for e in progress.episodes if e.plan.group == group]


@pytest.fixture(scope="module")
def story(tiny_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory, light_ray: None) -> Story:
    from accerl_lerobot.engines.ray_engine import RayEngine

    directory = tmp_path_factory.mktemp("saved")
    rates = ("lr", "value_lr", "warmup_updates", "value_warmup_updates")
    config = tiny_run(
        tiny_checkpoint,
        env=LatencyConfig(max_steps=16, frame_ms=8.0),
        rollout={"workers": 2, "environments": 3},
        replay={"capacity": 96},
        trainer={"updates": UPDATES} | dict.fromkeys(rates, 0),
        output_dir=str(directory),
    )
    with closing(RayEngine(config, ("match",))) as engine:
        pids = engine.pids()
        engine.plan(evaluation_plans(("match",), 6, "before", filmed=1))
        before = collect(engine, "before", 6)
        engine.train()
        told = Story(config, before, until(engine, 4))
        engine.plan(evaluation_plans(("match",), DURING, "during"))
        told.history.append(engine.poll())
        os.kill(pids["rollout 1"], signal.SIGKILL)
        saved = engine.save(directory / "middle")
        told.saved = saved.version
        told.history.append(replace(told.history[-1], updates=saved.updates, episodes=[]))
        for progress in polls(engine):
            told.history.append(progress)
            if progress.done and len(told.episodes("during")) >= DURING:
                break
        engine.plan(evaluation_plans(("match",), 6, "after"))
        told.after = collect(engine, "after", 6)
    return told


def test_at_learning_rate_zero_every_ratio_is_one_and_all_updates_are_made_once(story: Story):
    assert [u["update"] for u in story.updates] == [float(i + 1) for i in range(UPDATES)]
    assert story.history[-1].version == UPDATES and 4 <= story.saved <= UPDATES
    assert max(u["ratio_max_dev"] for u in story.updates) <= 1e-4
    assert max(abs(u["approx_kl"]) for u in story.updates) <= 1e-8
    assert all(u["ess"] > 0.9999 and u["clip_fraction"] == 0 and u["skipped"] == 0 for u in story.updates)


def test_the_lag_is_bounded_and_the_books_of_replay_balance(story: Story):
    config = story.config
    under_way = config.rollout.workers * config.rollout.environments * config.rollout.segment_length
    bound = lag_bound(
        config.replay, batch_decisions=config.trainer.batch_decisions, in_flight=2 * under_way, pickup=2,
        prefetch=1,
    )  # fmt: skip
    assert 0 < max(u["lag_max"] for u in story.updates) <= bound
    assert all(0 <= u["lag_mean"] <= u["lag_max"] for u in story.updates)
    books = story.history[-1].replay
    for unit in ("segments", "decisions"):
        assert books[f"inserted_{unit}"] == books[f"stored_{unit}"] + books[f"removed_{unit}"]
    assert books["dropped_nonfinite"] == 0
    # What the trainer learned from is what replay handed out: no batch was drawn and then forgotten.
    assert books["trained_decisions"] == sum(u["decisions"] for u in story.updates)
    assert books["trained_decisions"] <= story.config.replay.samples_per_insert * books["inserted_decisions"]


def test_the_worker_that_was_killed_came_back_once_and_counters_never_fall(story: Story):
    assert story.history[-1].rollout["restarts"] == 1.0
    versions = [p.version for p in story.history]
    assert versions == sorted(versions)
    served = [p.inference["version"] for p in story.history if "version" in p.inference]
    assert served == sorted(served) and UPDATES // 2 < served[-1] <= UPDATES
    for name in ("env_steps", "decisions", "episodes", "restarts"):
        values = [p.rollout[name] for p in story.history]
        assert values == sorted(values) and values[-1] > values[0], f"{name} never falls"


def test_every_planned_episode_has_exactly_one_result(story: Story):
    for results, count in ((story.before, 6), (story.episodes("during"), DURING), (story.after, 6)):
        assert sorted(r.plan.index for r in results) == list(range(count))
    explored = [e.plan.seed for e in story.episodes("train")]
    assert 0 < len(set(explored)) == len(explored), "an exploring episode was reported twice"


def test_evaluation_uses_the_weights_of_its_time_and_equal_ones_give_equal_results(story: Story):
    """Batches differ between the two, and the process that ran them may; the episodes must not."""
    assert {r.versions for r in story.before} == {(0, 0)}
    assert {r.versions for r in story.after} == {(UPDATES, UPDATES)}
    assert all(0 < e.versions[0] <= e.versions[1] <= UPDATES for e in story.episodes("during"))
    before, after = (
        sorted((r.plan.index, r.success, r.steps, r.decisions) for r in results)
        for results in (story.before, story.after)
    )
    assert before == after
    assert [r.plan.index for r in story.before if r.frames] == [0]


def test_every_worker_has_left_its_timeline(story: Story):
    timeline = read_timeline(Path(str(story.config.output_dir)))
    assert [row.worker for row in timeline.rows] == [
        "rollout 0",
        "rollout 1",
        "inference",
        "replay",
        "trainer",
    ]
    assert [row.worker for row in timeline.rows if len(gaps(row))] == ["rollout 1"]
    adds_up(timeline)
    spent = timeline.shares()
    assert {"recovery", "compute", "transport", "wait_in"} <= spent["rollout"].keys()
    assert {"compute", "wait_in", "weights"} <= spent["inference"].keys()
    assert {"compute", "wait_in", "transport", "weights", "checkpoint"} <= spent["trainer"].keys()
    assert "checkpoint" in spent["replay"]
