# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks weights``, small."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from accerl_lerobot.errors import InputError
from benchmarks.weights import ARMS, BenchWeightsConfig, bench_weights, table
from tests.runs import printed


def test_all_arms_at_all_sizes(light_ray: None, tmp_path: Path):
    root = tmp_path / "weights"
    config = BenchWeightsConfig(sizes_mb=(1, 2), readers=(1, 2), tensors=3, repeats=2, output_dir=str(root))
    result = bench_weights(config)
    assert json.loads(json.dumps(result)) == json.loads((root / "weights.json").read_text())
    assert len(result["cells"]) == 2 * 2 * len(ARMS)
    for cell in result["cells"]:
        for kind in ("stall", "applied", "pause"):
            assert len(cell[kind]["blocks"]) == 2 and cell[f"{kind}_ms"]["min"] > 0
        assert cell["applied_ms"]["median"] > cell["pause_ms"]["median"]
        assert cell["mb"]["median"] == pytest.approx(cell["size_mb"], rel=0.02)
    shown = printed(table(result))
    assert all(arm in shown and arm in (root / "weights.md").read_text() for arm in ARMS)
    with pytest.raises(InputError, match="^output_dir=.*the folder exists"):
        bench_weights(config)
