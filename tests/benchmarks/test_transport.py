# SPDX-License-Identifier: Apache-2.0
"""The transport benchmark runs, and its numbers add up."""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.transport import RAY, SOCKET, BenchTransportConfig, bench_transport, table
from tests.runs import printed


def test_all_arms_in_turns(light_ray: None, tmp_path: Path):
    folder = tmp_path / "transport"
    config = BenchTransportConfig(
        sizes=("12 KB",), callers=(1, 2), calls=10, rounds=1, output_dir=str(folder)
    )
    result = bench_transport(config)
    assert json.loads((folder / "transport.json").read_text()) == json.loads(json.dumps(result))
    found = {(row["callers"], row["arm"]): row for row in result["results"]}
    assert list(found) == [(1, RAY), (1, SOCKET), (2, RAY), (2, SOCKET)]
    for row in found.values():
        assert len(row["p50_us"]["blocks"]) == len(row["calls_per_s"]["blocks"]) == 2
        assert 0 < row["p50_us"]["min"] <= row["p50_us"]["median"] <= row["p99_us"]["max"]
    assert "socket" in printed(table(result))
