# SPDX-License-Identifier: Apache-2.0
"""The transport benchmark runs, and its numbers add up."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from accerl_lerobot.transport.shared_memory import available
from benchmarks.transport import ARMS, FLOORS, SLOT, BenchTransportConfig, bench_transport, table
from tests.light_workers import light_ray

__all__ = ["light_ray"]


@pytest.mark.skipif(not available(), reason="no memfd, epoll and eventfd here")
def test_all_arms_in_turns(light_ray: None, tmp_path: Path):
    folder = tmp_path / "transport"
    config = BenchTransportConfig(
        sizes=("12 KB",), callers=(1, 2), calls=10, rounds=1, output_dir=str(folder)
    )
    result = bench_transport(config)
    assert json.loads((folder / "transport.json").read_text()) == json.loads(json.dumps(result))
    assert (folder / "transport.png").stat().st_size > 1000
    found = {(row["callers"], row["arm"]): row for row in result["results"]}
    assert list(found) == [(1, arm) for arm in (*ARMS, *FLOORS)] + [(2, arm) for arm in ARMS]
    for row in found.values():
        assert len(row["p50_us"]["blocks"]) == len(row["calls_per_s"]["blocks"]) == 2
        assert 0 < row["p50_us"]["min"] <= row["p50_us"]["median"] <= row["p99_us"]["max"]
        assert row["bytes"] == 64 * 64 * 3 + 4 * 4
    assert found[1, SLOT]["of_floor"]["blocks"] == [1.0, 1.0] and "of_floor" not in found[2, ARMS[0]]
    console = Console(width=140, record=True, file=io.StringIO())
    console.print(table(result))
    assert "shared_memory" in console.export_text()
