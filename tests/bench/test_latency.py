# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""What a world takes: its law by hand, and one of known durations, timed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from accerl_lerobot.bench.latency import BenchLatencyConfig, bench_latency, described, table
from accerl_lerobot.console import Console
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.envs.simulated import read_trace
from accerl_lerobot.errors import InputError


def test_a_law_by_hand():
    found = described(np.asarray([0.01, 0.01, 0.01, 0.05]), np.asarray([False, False, False, True]))
    assert found["latency_ms"]["mean"] == pytest.approx(20.0) and found["latency_ms"]["max"] == 50.0
    assert found["latency_ms"]["p50"] == pytest.approx(10.0)
    assert found["cv"] == pytest.approx(np.sqrt(3) * 10 / 20)
    assert found["resets"] == 1 and found["reset_share"] == pytest.approx(0.5)
    assert found["neighbours"] is None  # whatever came before the reset was alike
    turns = described(np.asarray([0.01, 0.03] * 8), np.zeros(16, bool))
    assert turns["neighbours"] == pytest.approx(-1.0) and turns["reset_share"] == 0.0
    every = described(np.asarray([0.01, 0.03]), np.ones(2, bool))
    assert every["resets"] == 2 and every["reset_share"] == 1.0


def test_a_world_of_known_durations_is_timed(tmp_path: Path):
    """Chunks of two in episodes of four: each second decision waits for a reset as well."""
    config = BenchLatencyConfig(
        env=SimulatedConfig(task="match,mirror", frame_ms=20.0, max_steps=4, tolerance=1e-6),
        chunk=2,
        decisions=10,
        output_dir=str(tmp_path),
    )
    result = bench_latency(config)
    text = (tmp_path / "trace.txt").read_text()
    durations = [float(line.split("#")[0]) for line in text.splitlines()[1:]]
    assert len(durations) == 10 and result["resets"] == 5
    assert min(durations[::2]) >= 20.0 and min(durations[1::2]) >= 40.0
    assert read_trace(result["trace"]) == pytest.approx(np.asarray(durations) / np.mean(durations))
    assert text.startswith("# SimulatedConfig, chunks of 2, ms\n") and text.count("# and a reset") == 5
    assert json.loads((tmp_path / "latency.json").read_text()) == json.loads(json.dumps(result))
    assert (tmp_path / "latency.png").stat().st_size > 1000
    assert "their share" in (tmp_path / "latency.md").read_text()
    with Console().rich.capture():
        Console().rich.print(table(result))


@pytest.mark.parametrize("values", [{"chunk": 0}, {"decisions": 1}, {"seed": 100}])
def test_what_cannot_be_timed_is_refused(values: dict):
    with pytest.raises(InputError, match=next(iter(values))):
        BenchLatencyConfig(**values)
