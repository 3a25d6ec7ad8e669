# SPDX-License-Identifier: Apache-2.0
"""Rules of batching: what is made of the numbers, and a small run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import batching
from benchmarks.batching import BenchBatchingConfig


def test_turns_of_a_rule_are_put_together():
    turns = [
        {"decisions_per_s": [10.0, 30.0], "batches": 3.0, "observations": 3.0, "waited_s": 0.1,
         "inference_busy": 0.2, "processors": 0.1},
        {"decisions_per_s": [20.0], "batches": 1.0, "observations": 5.0, "waited_s": 0.3,
         "inference_busy": 0.4, "processors": 0.7},
    ]  # fmt: skip
    found = batching.summed(turns)
    assert found["decisions_per_s"]["median"] == 20.0 and found["batch_size"] == 2.0
    assert found["wait_mean_ms"] == pytest.approx(50.0) and found["processor_bound"]
    assert found["inference_busy"] == pytest.approx(0.3)


def test_a_small_run_of_batching(light_ray: None, tmp_path: Path):
    config = BenchBatchingConfig(
        environments=2, latency_ms=5.0, image_size=16, decide_ms=1.0, waits_ms=(20.0,), seconds=0.2, blocks=1,
        output_dir=str(tmp_path),
    )  # fmt: skip
    rules = batching.bench_batching(config)["rules"]
    assert list(rules) == ["one at a time", "at most 20 ms"]
    assert rules["one at a time"]["batch_size"] == pytest.approx(1.0)
    assert 1.0 < rules["at most 20 ms"]["batch_size"] <= 2.0
    assert json.loads((tmp_path / "batching.json").read_text())["rules"]
    assert "mean wait" in (tmp_path / "batching.md").read_text()
