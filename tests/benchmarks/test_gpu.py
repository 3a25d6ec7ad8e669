# SPDX-License-Identifier: Apache-2.0
"""The check of what needs a GPU, tried on a CPU with policies and runs that are small."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from accerl_lerobot.errors import InputError
from benchmarks import gpu, policy
from benchmarks.gpu import BenchGpuConfig, bench_gpu, table
from tests.benchmarks.test_machine import small

__all__ = ["small"]


@pytest.mark.usefixtures("small")
def test_it_measures_both_precisions_and_a_run_of_one_and_of_two_ranks(tmp_path, monkeypatch):
    asked: list[tuple[str, ...]] = []

    def run(config: BenchGpuConfig, folder: Path, more: tuple[str, ...]) -> dict[str, Any]:
        asked.append(more)
        return {"rl_s": 3.0, "ratio_max_dev": 1e-6}

    monkeypatch.setattr(gpu, "_run", run)
    config = BenchGpuConfig(output_dir=str(tmp_path), device="cpu", batch=2, repeats=1)
    result = bench_gpu(config)
    assert asked == [
        ("--trainer.ranks=1", "--trainer.sharding=ddp"),
        ("--trainer.ranks=2", "--trainer.sharding=zero2"),
    ]
    assert set(result["policies"]) == {"fp32", "bf16"}
    for (precision, found), most in zip(result["policies"].items(), (1e-4, 30.0), strict=True):
        assert 0 < found["parameters"]["trained"] < found["parameters"]["all"]
        assert list(found["memory_gb"]) == ["built", "decided", "updated"]
        assert all(
            found["seconds"][part]["median"] > 0 for part in ("decide_one", "decide", "score", "update")
        )
        assert 0 <= found["mismatch"]["mean"] <= found["mismatch"]["max"] <= most, precision
    assert "memory, updated" in list(policy.table(found).columns[0].cells)
    assert json.loads((tmp_path / "gpu.json").read_text()) == json.loads(json.dumps(result))
    cells = list(table(result).columns[0].cells)
    assert "SmolVLA, bf16: memory of an update" in cells and "asynchronous run, sharding zero2" in cells


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_says_so_before_anything_is_measured(tmp_path: Path):
    with pytest.raises(InputError, match="no CUDA device here"):
        bench_gpu(BenchGpuConfig(output_dir=str(tmp_path)))
