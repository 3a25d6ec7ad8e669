# SPDX-License-Identifier: Apache-2.0
"""Both engines leave a timeline in which every moment of every worker is in one state."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import ray

from accerl_lerobot.engine import launch
from accerl_lerobot.engine.config import LaunchConfig
from accerl_lerobot.engine.launch import RayEngine
from accerl_lerobot.engine.local import LocalEngine
from accerl_lerobot.evaluation import evaluation_plans
from accerl_lerobot.inference import worker as inference_worker
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.timeline import TIMELINE
from accerl_lerobot.timeline.read import ABSENT, Timeline, read_parts, read_timeline
from accerl_lerobot.trainer import worker as trainer_worker
from benchmarks.simulated_world import LatencyConfig
from tests.light_workers import LightInference, LightTrainer, light_ray
from tests.runs import collect, drive, tiny_run

__all__ = ["light_ray"]


@pytest.fixture
def light(light_ray: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launch, "POLL_S", 0.1)
    monkeypatch.setattr(inference_worker, "InferenceWorker", LightInference)
    monkeypatch.setattr(trainer_worker, "TrainerWorker", LightTrainer)


def adds_up(timeline: Timeline) -> None:
    for row in timeline.rows:
        there = row.states != ABSENT
        whole = row.times[-1] - row.times[0] - np.diff(row.times)[~there].sum()
        assert row.until(row.times[-1:])[0].sum() == pytest.approx(whole, rel=1e-9) and whole > 0
    for own in timeline.shares().values():
        assert sum(own.values()) == pytest.approx(1.0)


def test_the_asynchronous_engine(light: None, tmp_path: Path) -> None:
    """Its rollout and replay workers are real; one is started again."""
    config = tiny_run(
        Path("nowhere"),
        env=LatencyConfig(max_steps=16, frame_ms=4.0),
        rollout=RolloutConfig(workers=2, worlds=2, segment_length=3),
        output_dir=str(tmp_path),
    )
    begun = time.monotonic_ns()
    engine = RayEngine(config, ("match",))
    try:
        ready = time.monotonic_ns()
        engine.plan(evaluation_plans(("match",), 4, "before"))
        collect(engine, "before", 4)
        engine.train()
        drive(engine)
        ray.kill(next(iter(engine._rollouts.workers())).actor)
        engine.plan(evaluation_plans(("match",), 8, "after"))
        collect(engine, "after", 8)
        asked = time.monotonic_ns()
        engine._replay.call("metrics", timeout=60)
    finally:
        engine.close()
    ended = time.monotonic_ns()
    timeline = read_timeline(tmp_path)
    adds_up(timeline)
    rows = {row.worker: row for row in timeline.rows}
    assert list(rows) == ["rollout 0", "rollout 1", "replay"]
    assert (rows["rollout 0"].states == ABSENT).sum() == 1 and ABSENT not in rows["rollout 1"].states
    found = read_timeline(tmp_path).shares()
    assert {"recovery", "compute", "transport", "wait_in"} <= found["rollout"].keys()
    assert found["replay"].keys() == {"recovery", "compute", "wait_in"}
    # The whole life of replay is in it, from before it was ready to when it was asked last.
    (part,) = (part for part in read_parts(tmp_path / TIMELINE) if part.worker == "replay")
    first = part.begins.clock_ns
    assert begun < first < ready
    assert asked < first + int(rows["replay"].times[-1] - rows["replay"].times[0]) < ended


def test_the_engine_in_one_process_is_one_row(tiny_checkpoint: Path, tmp_path: Path) -> None:
    launch = LaunchConfig(engine="local")
    engine = LocalEngine(tiny_run(tiny_checkpoint, output_dir=str(tmp_path), launch=launch), ("match",))
    try:
        engine.train()
        drive(engine)
        engine.save(tmp_path / "saved")
    finally:
        engine.close()
    assert (tmp_path / "episodes.jsonl").stat().st_size
    timeline = read_timeline(tmp_path)
    adds_up(timeline)
    assert [row.worker for row in timeline.rows] == ["local"]
    assert timeline.shares()["local"].keys() == {"recovery", "compute", "wait_in", "checkpoint"}
