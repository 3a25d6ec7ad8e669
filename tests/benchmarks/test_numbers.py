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
from accerl_lerobot.policies.config import PolicyConfig
from benchmarks import async_vs_sync, simulated_environment
from benchmarks.async_vs_sync import ARMS
from benchmarks.async_vs_sync import compare as compare_schedules
from benchmarks.gpu import BenchGpuConfig, bench_gpu
from benchmarks.latency import described
from benchmarks.machinery import MachineryConfig
from benchmarks.samplers import BenchSamplersConfig, bench_samplers
from benchmarks.simulated_environment import LatencyConfig, read_trace
from benchmarks.study import BenchStudyConfig, bench_study, together
from benchmarks.tables import mean_interval
from benchmarks.throughput import Block
from tests.runs import tiny_run


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
    assert mean_interval(policies) == pytest.approx((0.542 - half, 0.542 + half), abs=1e-6)
    assert mean_interval([0.9, 1.0])[0] == pytest.approx(0.95 - 12.706205 * 0.05, abs=1e-6)
    wide = together([{"success": success, "n": 10} for success in (0.2, 0.5, 0.8)])
    assert (wide["successes"], wide["n"], wide["ci95"]) == (15, 30, [0.0, 1.0]), "0.5 ± 0.745"
    alike = together([{"success": 0.5, "n": 10}] * 3)
    wilson = Rate(successes=15, n=30).interval()
    assert alike["ci95"] == [wilson.low, wilson.high], "chance alone would not make them so alike"
    assert together([{"success": 0.2, "n": 10}])["ci95"] == list(Rate(successes=2, n=10).interval())


@pytest.mark.slow
def test_a_study_is_run(tmp_path: Path, tiny_checkpoint: Path):
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(yaml.safe_dump(encode(tiny_run(tiny_checkpoint))))
    folder = tmp_path / "study"
    config = BenchStudyConfig(
        recipe=str(recipe), arms=("--rollout.episodes=8",), seeds=(3,), updates=4, episodes=4,
        output_dir=str(folder),
    )  # fmt: skip
    (cell,) = bench_study(config)["cells"]
    assert (cell["n"], cell["updates"]) == (4, 4) and 0 < cell["episodes_explored"] <= 8
    assert {"study.json", "study.md", "study.png", "rollout.episodes=8-seed3"} < {
        p.name for p in folder.iterdir()
    }


def test_a_type_with_a_likelihood_is_timed_with_and_without_it(tiny_checkpoint: Path):
    config = BenchSamplersConfig(
        policy=PolicyConfig(path=str(tiny_checkpoint), device="cpu"), environments=2, batch=3, repeats=2
    )
    result = bench_samplers(config)
    own, any_type = result["seconds"]["own likelihood"], result["seconds"]["chunk_noise"]
    for part in ("decide_one", "decide", "step"):
        assert len(own[part]["blocks"]) == len(any_type[part]["blocks"]) == 2
        assert result["ratio"][part] == any_type[part]["median"] / own[part]["median"]


def test_durations_by_hand():
    found = described(np.asarray([0.01, 0.01, 0.01, 0.05]))
    assert found["mean"] == pytest.approx(20.0) and found["longest"] == 50.0 and found["n"] == 4
    assert found["p50"] == pytest.approx(10.0) and found["p95"] == pytest.approx(10 + 0.85 * 40)
    assert found["cv"] == pytest.approx(np.sqrt(3) * 10 / 20)


NO_ACTIONS = np.zeros((10, 2), np.float32)


@pytest.fixture
def slept(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Milliseconds of every sleep."""
    sleeps: list[float] = []
    monkeypatch.setattr(simulated_environment, "_wait", lambda delay: sleeps.append(round(1000 * delay, 9)))
    return sleeps


def test_latency_is_slept_and_has_the_mean_asked_for(slept: list[float]):
    environment = make_environment(LatencyConfig(frame_ms=10.0, tolerance=1e-6))
    environment.reset(0, "match")
    environment.step_chunk(NO_ACTIONS)
    assert slept == [10.0, 10.0]
    environment = make_environment(LatencyConfig(frame_ms=3.0, latency_cv=1.0))
    environment.reset(0, "match")
    draws = [environment._delay() for _ in range(20_000)]
    assert np.mean(draws) == pytest.approx(0.003, rel=0.05)
    assert np.std(draws) / np.mean(draws) == pytest.approx(1.0, rel=0.15)


def test_a_trace_is_gone_through_from_some_moment_on_and_scaled(tmp_path: Path, slept: list[float]):
    path = tmp_path / "trace.txt"
    path.write_text("# of an environment\n1.0\n\n2.0  # milliseconds\nreset 30\n6.0\nreset 60\n")
    trace = read_trace(str(path))
    assert trace.decisions.tolist() == [1 / 3, 2 / 3, 2.0] and trace.resets.tolist() == [10.0, 20.0]
    environment = make_environment(
        LatencyConfig(latency_trace=str(path), frame_ms=3.0, max_steps=1000, tolerance=1e-6)
    )
    starts = set()
    for seed in range(20):
        for _ in range(2):  # equal seeds, equal latency
            slept.clear()
            environment.reset(seed, "match")
            for _ in range(6):
                environment.step_chunk(NO_ACTIONS)
            reset, *draws = slept
            assert reset in (30.0, 60.0)
            assert draws[:3] == draws[3:] and sorted(draws[:3]) == [1.0, 2.0, 6.0]
            assert draws[(draws.index(1.0) + 1) % 3] == 2.0
        starts.add(draws[0])
    assert starts == {1.0, 2.0, 6.0}


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_says_so_before_anything_is_measured(tmp_path: Path):
    with pytest.raises(InputError, match="no CUDA device here"):
        bench_gpu(BenchGpuConfig(output_dir=str(tmp_path)))
