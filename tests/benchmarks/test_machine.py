# SPDX-License-Identifier: Apache-2.0
"""The benchmarks of a user's machine run, and their numbers add up."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.demos import backbone
from benchmarks import gpu, latency, transport
from benchmarks import policy as bench
from benchmarks.latency import BenchLatencyConfig, bench_latency, described
from benchmarks.policy import BenchPolicyConfig
from benchmarks.simulated_environment import LatencyConfig, read_trace
from tests.runs import printed


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
    assert latency.table(result).row_count == 2


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    build = bench.lerobot_config
    sizes = backbone.Sizes(hidden=32, heads=2, kv_heads=1, vision_hidden=16, vision_layers=1, patch=32)
    monkeypatch.setattr(bench, "SMOLVLM2_500M", sizes)

    def shrunk(config: BenchPolicyConfig, directory: Path) -> Any:
        made = build(config, directory)
        made.num_vlm_layers, made.chunk_size, made.n_action_steps, made.num_steps = 2, 4, 4, 2
        made.resize_imgs_with_padding = (64, 64)
        return made

    monkeypatch.setattr(bench, "lerobot_config", shrunk)


@pytest.mark.usefixtures("small")
def test_it_measures_both_precisions_and_a_run_of_one_and_of_two_ranks(tmp_path, monkeypatch):
    asked: list[tuple[str, ...]] = []

    def run(config: gpu.BenchGpuConfig, folder: Path, more: tuple[str, ...]) -> dict[str, Any]:
        asked.append(more)
        return {"rl_s": 3.0, "ratio_max_dev": 1e-6}

    monkeypatch.setattr(gpu, "_run", run)
    config = gpu.BenchGpuConfig(output_dir=str(tmp_path), device="cpu", batch=2, repeats=1)
    result = gpu.bench_gpu(config)
    assert asked == [
        ("--trainer.ranks=1", "--trainer.sharding=ddp"),
        ("--trainer.ranks=2", "--trainer.sharding=zero2"),
    ]
    assert set(result["policies"]) == {"fp32", "bf16"}
    for (precision, found), most in zip(result["policies"].items(), (1e-4, 30.0), strict=True):
        assert 0 < found["parameters"]["trained"] < found["parameters"]["all"]
        assert all(found["seconds"][part]["median"] > 0 for part in ("decide", "score", "update"))
        assert 0 <= found["mismatch"]["mean"] <= found["mismatch"]["max"] <= most, precision
    assert json.loads((tmp_path / "gpu.json").read_text()) == json.loads(json.dumps(result))
    assert "sharding zero2" in printed(gpu.table(result))


def test_all_arms_of_transport_in_turns(light_ray: None, tmp_path: Path):
    folder = tmp_path / "transport"
    config = transport.BenchTransportConfig(
        sizes=("12 KB",), callers=(1, 2), calls=10, rounds=1, output_dir=str(folder)
    )
    result = transport.bench_transport(config)
    assert json.loads((folder / "transport.json").read_text()) == json.loads(json.dumps(result))
    found = {(row["callers"], row["arm"]): row for row in result["results"]}
    assert list(found) == [(callers, arm) for callers in (1, 2) for arm in (transport.RAY, transport.SOCKET)]
    for row in found.values():
        assert len(row["p50_us"]["blocks"]) == len(row["calls_per_s"]["blocks"]) == 2
        assert 0 < row["p50_us"]["min"] <= row["p50_us"]["median"] <= row["p99_us"]["max"]
    assert "socket" in printed(transport.table(result))
