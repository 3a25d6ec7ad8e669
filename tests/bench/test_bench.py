# SPDX-License-Identifier: Apache-2.0
"""Durations of a world: its law by hand, and one of known durations, timed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from accerl_lerobot.bench.latency import BenchLatencyConfig, bench_latency, described, table
from accerl_lerobot.console import Console
from accerl_lerobot.envs import SimulatedConfig
from benchmarks.simulated_world import LatencyConfig, read_trace


def test_durations_by_hand():
    found = described(np.asarray([0.01, 0.01, 0.01, 0.05]))
    assert found["mean"] == pytest.approx(20.0) and found["longest"] == 50.0 and found["n"] == 4
    assert found["p50"] == pytest.approx(10.0) and found["p95"] == pytest.approx(10 + 0.85 * 40)
    assert found["cv"] == pytest.approx(np.sqrt(3) * 10 / 20)


def test_a_world_of_known_durations_is_timed(tmp_path: Path):
    """Chunks of two in episodes of four: a reset after each second decision."""
    config = BenchLatencyConfig(
        env=LatencyConfig(task="match,mirror", frame_ms=20.0, max_steps=4, tolerance=1e-6),
        chunk=2,
        decisions=10,
        output_dir=str(tmp_path),
    )
    result = bench_latency(config)
    first, *lines = (tmp_path / "trace.txt").read_text().splitlines()
    assert first == "# match, mirror, chunks of 2, ms"
    assert [line.startswith("reset ") for line in lines] == [False, False, True] * 5
    assert min(float(line.split()[-1]) for line in lines) >= 20.0
    trace = read_trace(result["trace"])
    assert len(trace.decisions) == result["decision_ms"]["n"] == 10
    assert len(trace.resets) == result["reset_ms"]["n"] == 5
    with Console().rich.capture():
        Console().rich.print(table(result))


def test_a_world_that_is_not_reset(tmp_path: Path):
    result = bench_latency(
        BenchLatencyConfig(env=SimulatedConfig(tolerance=1e-6), decisions=2, output_dir=str(tmp_path))
    )
    assert result["reset_ms"] is None
    assert table(result).row_count == 1
