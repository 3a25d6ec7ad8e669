# SPDX-License-Identifier: Apache-2.0
"""The bench of full-size policies, on one small enough for a test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from accerl_lerobot.bench import policy as bench
from accerl_lerobot.bench.policy import BenchPolicyConfig
from accerl_lerobot.demos import backbone


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    build = bench.lerobot_config
    sizes = {"hidden": 32, "heads": 2, "kv_heads": 1, "vision_hidden": 16, "vision_layers": 1, "patch": 32}
    monkeypatch.setattr(bench, "SMOLVLM2_500M", sizes)

    def shrunk(config: BenchPolicyConfig, directory: Path) -> Any:
        made = build(config, directory)
        made.num_vlm_layers, made.chunk_size, made.n_action_steps, made.num_steps = 2, 4, 4, 2
        made.resize_imgs_with_padding = (64, 64)
        return made

    monkeypatch.setattr(bench, "lerobot_config", shrunk)


@pytest.mark.parametrize(("precision", "low", "high"), [("fp32", 0.0, 1e-4), ("bf16", 0.0, 30.0)])
def test_it_measures(small: None, precision: str, low: float, high: float) -> None:
    result = bench.bench_policy(
        BenchPolicyConfig(batch=3, precision=precision, device="cpu", repeats=1, cameras=1)
    )
    assert 0 < result["parameters"]["trained"] < result["parameters"]["all"]
    assert list(result["memory_gb"]) == ["built", "decided", "updated"]
    assert all(result["seconds"][k]["median"] > 0 for k in ("decide_one", "decide", "score", "update"))
    assert low <= result["mismatch"]["mean"] <= result["mismatch"]["max"] <= high
    assert "memory, updated" in list(bench.table(result).columns[0].cells)


def test_the_published_backbone_has_the_published_size(tmp_path: Path) -> None:
    import json

    backbone.write_backbone(tmp_path / "b", **bench.SMOLVLM2_500M)
    text = json.loads((tmp_path / "b" / "config.json").read_text())["text_config"]
    assert (text["hidden_size"], text["intermediate_size"], text["vocab_size"]) == (960, 2560, 49280)
