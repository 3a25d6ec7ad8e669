# SPDX-License-Identifier: Apache-2.0
"""The simulated environment with latency: as slow as asked, and broken on request."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from accerl_lerobot.envs import make_environment
from benchmarks import simulated_environment
from benchmarks.simulated_environment import LatencyConfig, read_trace

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
