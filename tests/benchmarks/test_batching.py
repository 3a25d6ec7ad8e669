# SPDX-License-Identifier: Apache-2.0
"""Rules of batching: what is made of the numbers, and a small run."""

from __future__ import annotations

import json
import math
from collections import Counter
from pathlib import Path

import pytest

from accerl_lerobot.inference.batcher import GRAIN, Batcher, quantile
from benchmarks import batching
from benchmarks.batching import BenchBatchingConfig
from tests.light_workers import light_ray

__all__ = ["light_ray"]


def test_waits_are_counted_by_their_length():
    batcher: Batcher[str] = Batcher(max_batch=8, max_wait_s=1.0)
    for i in range(8):
        batcher.add("a", now=0.0 if i else -0.99)  # one of them has waited for a second
    batcher.take(now=0.01)
    waits = batcher.stats.waits
    assert waits.total() == 8 and len(waits) == 2
    assert quantile(waits, 0.5) == pytest.approx(0.01, rel=GRAIN - 1)
    assert quantile(waits, 0.99) == pytest.approx(1.0, rel=GRAIN - 1)
    assert math.isnan(quantile(Counter(), 0.5))


def test_turns_of_a_rule_are_put_together():
    turns = [
        {"decisions_per_s": [10.0, 30.0], "waits": Counter({-24: 99}), "sizes": Counter({1: 3}),
         "inference_busy": 0.2, "processors": 0.1},
        {"decisions_per_s": [20.0], "waits": Counter({0: 1}), "sizes": Counter({5: 1}),
         "inference_busy": 0.4, "processors": 0.7},
    ]  # fmt: skip
    found = batching.summed(turns)
    assert found["decisions_per_s"]["median"] == 20.0 and found["batch_size"] == 2.0
    assert found["wait_p50_ms"] == found["wait_p99_ms"] == pytest.approx(1000 * GRAIN**-24)
    assert found["batch_sizes"] == {1: 3, 5: 1} and found["processor_bound"]
    assert found["inference_busy"] == pytest.approx(0.3)


def test_a_small_run_of_batching(light_ray: None, tmp_path: Path):
    config = BenchBatchingConfig(
        worlds=2, latency_ms=5.0, image_size=16, decide_ms=1.0, waits_ms=(20.0,), seconds=0.2, blocks=1,
        output_dir=str(tmp_path),
    )  # fmt: skip
    rules = batching.bench_batching(config)["rules"]
    assert list(rules) == ["one at a time", "at most 20 ms"]
    assert set(rules["one at a time"]["batch_sizes"]) == {1}
    assert set(rules["at most 20 ms"]["batch_sizes"]) <= {1, 2} and 2 in rules["at most 20 ms"]["batch_sizes"]
    assert json.loads((tmp_path / "batching.json").read_text())["rules"]
    assert "wait p99" in (tmp_path / "batching.md").read_text()
