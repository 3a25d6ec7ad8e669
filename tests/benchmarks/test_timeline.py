# SPDX-License-Identifier: Apache-2.0
"""The bench of the timeline runs, and its numbers fit each other."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from accerl_lerobot.timeline import COMPUTE, TRAINING, WAIT_IN
from benchmarks.timeline import BenchTimelineConfig, bench_timeline, table
from tests.timeline.folders import write_worker


def test_the_cost_of_an_entry_and_of_a_run(tmp_path: Path) -> None:
    write_worker(tmp_path / "run", "driver", [(TRAINING, 10)])
    write_worker(tmp_path / "run", "trainer", 1000 * [(COMPUTE, 0.005), (WAIT_IN, 0.005)])
    config = BenchTimelineConfig(entries=200, repeats=2, folder=str(tmp_path), run=str(tmp_path / "run"))
    result = bench_timeline(config)
    assert (
        json.loads(json.dumps(result)) == json.loads(json.dumps(result)) and result["config"]["repeats"] == 2
    )
    for arm in result["arms"].values():
        assert len(arm["blocks"]) == 4 and 0 < arm["min"] <= arm["median"] <= arm["max"]
    trainer = result["workers"]["trainer"]
    assert trainer["entries_per_s"] == pytest.approx(200, rel=0.01)
    assert trainer["share"] == pytest.approx(trainer["entries_per_s"] * result["arms"]["on"]["median"] / 1e9)
    assert {path.name for path in tmp_path.iterdir()} == {"run"}, "it cleans up after itself"
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(table(result))
    assert "trainer" in console.export_text()
