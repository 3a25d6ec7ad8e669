# SPDX-License-Identifier: Apache-2.0
"""Numbers of benchmarks by hand, small runs of them, and an environment that is as slow as asked."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from accerl_lerobot.engines.config import encode
from accerl_lerobot.envs import make_environment
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation import Rate
from benchmarks import async_vs_sync, gpu, latency, simulated_environment, study, tables
from benchmarks.async_vs_sync import ARMS
from benchmarks.machinery import MachineryConfig
from benchmarks.simulated_environment import LatencyConfig
from benchmarks.throughput import Block
from tests.runs import tiny_run


def block(schedule: str, rate: float, processors: float = 0.2) -> Block:
    return Block(
        schedule=schedule, seconds=1.0, updates=4, decisions_per_s=rate, env_steps_per_s=4 * rate,
        lag_mean=1.0, trainer_waits=0.5, batch_size=2.0, inference_busy=0.5, processors=processors,
    )  # fmt: skip


MACHINE = MachineryConfig(
    environments=10, latency_ms=90.0, decide_ms=4.0, decide_each_ms=0.375, max_batch=8, update_ms=500.0
)


def test_bounds_by_hand():
    """Ten environments of 90 ms: 90 · 17/16 + 4 + 0.375 = 100 ms a decision."""
    assert MACHINE.world_bound == pytest.approx(100.0)
    assert MACHINE.service_bound == pytest.approx(8 / 0.007)
    assert MACHINE.trainer_bound == pytest.approx(40 / 0.5)
    assert MACHINE.bound == pytest.approx(80.0)
    free = MachineryConfig(decide_ms=0.0, decide_each_ms=0.0, update_ms=0.0)
    assert free.service_bound == free.trainer_bound == math.inf
    assert free.bound == free.world_bound


def test_speed_ups_are_of_neighbouring_blocks():
    rates = {"asynchronous": [60.0, 72.0], "overlap": [40.0, 36.0], "synchronous": [20.0, 36.0]}
    blocks = [block(arm, rates[arm][0]) for arm in ARMS]
    blocks += [block(arm, rates[arm][1], processors=0.7) for arm in reversed(ARMS)]
    found = async_vs_sync.compare(MACHINE, blocks)
    assert found["speed_up"]["blocks"] == [3.0, 2.0] and found["speed_up"]["median"] == 2.5
    assert found["speed_up_over_overlap"]["blocks"] == [1.5, 2.0]
    assert found["largest_speed_up"] == pytest.approx(80.0 / 28.0)
    assert found["share_of_largest"]["blocks"] == pytest.approx([0.75, 0.9])
    assert found["processor_bound"]


@pytest.mark.slow
def test_an_engine_is_measured_and_learns(light_ray: None, monkeypatch: pytest.MonkeyPatch):
    machine = MachineryConfig(environments=2, latency_ms=5.0, update_ms=20.0, image_size=16, decide_ms=1.0)
    with machine.open() as engine:
        blocks = [engine.block(arm, 0.2) for arm in ARMS]
    assert all(found.decisions_per_s > 0 and found.updates >= 1 for found in blocks)
    assert blocks[ARMS.index("synchronous")].batch_size == 2.0, "in lock step both environments ask at once"
    monkeypatch.setattr(async_vs_sync, "TRIALS", 4)
    assert 0 <= async_vs_sync.success(2, "synchronous", 0) <= 1


def test_a_mean_over_policies_is_as_unsure_as_they_differ():
    """t at 97.5 %: 2.776445 of four degrees of freedom, 12.706205 of one (Student's table)."""
    policies = [0.71, 0.47, 0.64, 0.33, 0.56]  # mean 0.542, s² = 0.08828 / 4
    half = 2.776445 * math.sqrt(0.08828 / 4 / 5)
    assert tables.mean_interval(policies) == pytest.approx((0.542 - half, 0.542 + half), abs=1e-6)
    assert tables.mean_interval([0.9, 1.0])[0] == pytest.approx(0.95 - 12.706205 * 0.05, abs=1e-6)
    wide = study.together([{"success": success, "n": 10} for success in (0.2, 0.5, 0.8)])
    assert (wide["successes"], wide["n"], wide["ci95"]) == (15, 30, [0.0, 1.0]), "0.5 ± 0.745"
    alike = study.together([{"success": 0.5, "n": 10}] * 3)
    wilson = Rate(successes=15, n=30).interval()
    assert alike["ci95"] == [wilson.low, wilson.high], "chance alone would not make them so alike"
    assert study.together([{"success": 0.2, "n": 10}])["ci95"] == list(Rate(successes=2, n=10).interval())


@pytest.mark.slow
def test_a_study_is_run_whose_weights_are_held_back(tmp_path: Path, tiny_checkpoint: Path):
    recipe, folder = tmp_path / "recipe.yaml", tmp_path / "study"
    recipe.write_text(yaml.safe_dump(encode(tiny_run(tiny_checkpoint))))
    sizes = {"arms": ("--trainer.hold_back=4",), "seeds": (3,), "updates": 14, "episodes": 4}
    config = study.BenchStudyConfig(recipe=str(recipe), output_dir=str(folder), **sizes)
    (cell,) = study.bench_study(config)["cells"]
    assert (cell["n"], cell["updates"]) == (4, 14) and cell["lag_mean"] > 9 * 4 / 14
    assert {"study.json", "study.md", "study.png"} < {path.name for path in folder.iterdir()}


def test_durations_by_hand():
    found = latency.described(np.asarray([0.01, 0.01, 0.01, 0.05]))
    assert found["mean"] == pytest.approx(20.0) and found["longest"] == 50.0 and found["n"] == 4
    assert found["p50"] == pytest.approx(10.0) and found["p95"] == pytest.approx(10 + 0.85 * 40)
    assert found["cv"] == pytest.approx(np.sqrt(3) * 10 / 20)


NO_ACTIONS = np.zeros((10, 2), np.float32)


@pytest.fixture
def slept(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Milliseconds of every sleep, which does not happen."""
    sleeps: list[float] = []
    monkeypatch.setattr(simulated_environment, "_wait", lambda delay: sleeps.append(round(1000 * delay, 9)))
    return sleeps


def test_latency_is_slept_and_has_the_mean_asked_for(slept: list[float]):
    environment = make_environment(LatencyConfig(frame_ms=10.0, tolerance=1e-6))
    environment.reset(0, "match")
    environment.step_chunk(NO_ACTIONS)
    assert slept == [10.0, 10.0]
    sizes = {"image_size": 8, "max_steps": 10_000, "tolerance": 1e-6}
    environment = make_environment(LatencyConfig(frame_ms=3.0, latency_cv=1.0, **sizes))
    environment.reset(0, "match")
    slept.clear()
    for _ in range(5000):
        environment.step_chunk(NO_ACTIONS[:1])
    assert np.mean(slept) == pytest.approx(3.0, rel=0.05)
    assert np.std(slept) / np.mean(slept) == pytest.approx(1.0, rel=0.15)


def test_a_trace_is_gone_through_from_some_moment_on_and_scaled(tmp_path: Path, slept: list[float]):
    path = tmp_path / "trace.txt"
    path.write_text("# of an environment\n1.0\n\n2.0  # milliseconds\nreset 30\n6.0\nreset 60\n")
    trace = simulated_environment.read_trace(str(path))
    assert trace.decisions.tolist() == [1 / 3, 2 / 3, 2.0] and trace.resets.tolist() == [10.0, 20.0]
    environment = make_environment(LatencyConfig(latency_trace=str(path), frame_ms=3.0, tolerance=1e-6))
    seen = []
    for seed in (*range(20), *range(20)):
        slept.clear()
        environment.reset(seed, "match")
        for _ in range(3):
            environment.step_chunk(NO_ACTIONS)
        seen.append(tuple(slept))
    assert seen[:20] == seen[20:], "equal seeds, equal latency"
    resets, *draws = zip(*seen, strict=True)
    assert set(resets) == {30.0, 60.0}
    assert set(zip(*draws, strict=True)) == {(1.0, 2.0, 6.0), (2.0, 6.0, 1.0), (6.0, 1.0, 2.0)}


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_says_so_before_anything_is_measured(tmp_path: Path):
    with pytest.raises(InputError, match="no CUDA device here"):
        gpu.bench_gpu(gpu.BenchGpuConfig(output_dir=str(tmp_path)))
