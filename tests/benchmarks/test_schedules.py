# SPDX-License-Identifier: Apache-2.0
"""Schedules, scaling and throughput: what is made of the numbers, and one small run of it all."""

from __future__ import annotations

import json
import math
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from benchmarks import async_vs_sync
from benchmarks.async_vs_sync import ARMS, BenchAsyncVsSyncConfig, bench_async_vs_sync
from benchmarks.async_vs_sync import compare as compare_schedules
from benchmarks.async_vs_sync import table as schedules_table
from benchmarks.machinery import MachineryConfig
from benchmarks.scaling import BenchScalingConfig, bench_scaling
from benchmarks.throughput import Block
from tests.runs import printed


def block(schedule: str, rate: float, processors: float = 0.2, waits: float = 0.5) -> Block:
    return Block(
        schedule=schedule, seconds=1.0, updates=4, decisions_per_s=rate, env_steps_per_s=4 * rate,
        lag_mean=1.0, trainer_waits=waits, batch_size=2.0, inference_busy=0.5, processors=processors,
    )  # fmt: skip


def test_bounds_by_hand():
    """Ten environments of 90 ms: 90 · 17/16 + 4 + 0.375 = 100 ms a decision."""
    machine = MachineryConfig(
        environments=10, latency_ms=90.0, decide_ms=4.0, decide_each_ms=0.375, max_batch=8, update_ms=500.0
    )
    assert machine.world_bound == pytest.approx(100.0)
    assert machine.service_bound == pytest.approx(8 / 0.007)
    assert machine.trainer_bound == pytest.approx(40 / 0.5)
    assert machine.bound == pytest.approx(80.0)
    free = MachineryConfig(decide_ms=0.0, decide_each_ms=0.0, update_ms=0.0)
    assert free.service_bound == free.trainer_bound == math.inf
    assert free.bound == free.world_bound


def test_speed_ups_are_of_neighbouring_blocks():
    machine = MachineryConfig(
        environments=10, latency_ms=90.0, decide_ms=4.0, decide_each_ms=0.375, update_ms=500.0
    )
    rates = {"asynchronous": [60.0, 72.0], "overlap": [40.0, 36.0], "synchronous": [20.0, 36.0]}
    blocks = [block(arm, rates[arm][0]) for arm in ARMS]
    blocks += [block(arm, rates[arm][1], processors=0.7) for arm in reversed(ARMS)]
    found = compare_schedules(machine, blocks)
    assert found["speed_up"]["blocks"] == [3.0, 2.0] and found["speed_up"]["median"] == 2.5
    assert found["speed_up_over_overlap"]["blocks"] == [1.5, 2.0]
    assert found["largest_speed_up"] == pytest.approx(80.0 / 28.0)
    assert found["share_of_largest"]["blocks"] == pytest.approx([0.75, 0.9])
    assert found["processor_bound"] and len(found["blocks"]) == 6


class FakeEngine(AbstractContextManager["FakeEngine"]):
    """Gives blocks at once, each a decision per second faster than the one before."""

    def __init__(self) -> None:
        self.rate = 10.0

    def __exit__(self, *_: object) -> None: ...

    def block(self, schedule: str, seconds: float) -> Block:
        self.rate += 1.0
        return block(schedule, self.rate)


@pytest.fixture
def fake_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MachineryConfig, "open", lambda config: FakeEngine())
    monkeypatch.setattr(async_vs_sync, "success", lambda updates, arm, seed: 0.5)


def test_a_law_is_measured_forth_and_back_and_written(fake_engine: None, tmp_path: Path):
    trace = tmp_path / "drawers.txt"
    trace.write_text("1\n3\n")
    config = BenchAsyncVsSyncConfig(
        cvs=(), traces=(str(trace),), rounds=1, learning_updates=2, seeds=(0,), output_dir=str(tmp_path)
    )
    result = bench_async_vs_sync(config)
    (law,) = result["laws"]
    assert law["cv"] == 0.5 and law["trace"] == str(trace)
    assert [b["schedule"] for b in law["blocks"]] == [*ARMS, *reversed(ARMS)]
    assert set(result["learning"]["success"]) == set(ARMS)
    assert json.loads((tmp_path / "async_vs_sync.json").read_text()) == json.loads(json.dumps(result))
    assert "0.50 (drawers)" in (tmp_path / "async_vs_sync.md").read_text()
    assert (tmp_path / "async_vs_sync.png").stat().st_size > 1000
    assert "drawers" in printed(schedules_table(result))


def test_scaling_is_measured_forth_and_back(fake_engine: None, tmp_path: Path):
    rows = bench_scaling(BenchScalingConfig(counts=(1, 2), blocks=2, output_dir=str(tmp_path)))["counts"]
    assert [row["environments"] for row in rows] == [1, 2] and rows[0]["efficiency"]["median"] == 1.0
    assert [[b["decisions_per_s"] for b in row["blocks"]] for row in rows] == [[11.0, 11.0]] * 2
    assert rows[1]["efficiency"]["median"] == 0.5
    assert "E(N)" in (tmp_path / "scaling.md").read_text()


@pytest.mark.slow
def test_an_engine_is_measured_and_learns(light_ray: None, monkeypatch: pytest.MonkeyPatch):
    machine = MachineryConfig(environments=2, latency_ms=5.0, update_ms=20.0, image_size=16, decide_ms=1.0)
    with machine.open() as engine:
        blocks = [engine.block(arm, 0.2) for arm in ARMS]
    assert all(found.decisions_per_s > 0 and found.updates >= 1 for found in blocks)
    assert blocks[ARMS.index("synchronous")].batch_size == 2.0, "in lock step both environments ask at once"
    monkeypatch.setattr(async_vs_sync, "TRIALS", 4)
    assert 0 <= async_vs_sync.success(2, "synchronous", 0) <= 1
