# SPDX-License-Identifier: Apache-2.0
"""The transport benchmark runs, and its numbers add up."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from accerl_lerobot.errors import InputError
from accerl_lerobot.transport.memfd import available
from benchmarks.transport import (
    ARMS,
    FLOORS,
    MEMCPY,
    SLOT,
    BenchTransportConfig,
    arrays_of,
    bench_transport,
    decision,
    measure,
    request_of,
    table,
)
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


class PlayedCrowd:
    """Every call takes as many microseconds as the place of its arm says."""

    def __init__(self) -> None:
        self.order: list[str] = []

    def measure(self, arm: str, size: str, callers: int, calls: int) -> tuple[list[list[float]], float]:
        self.order.append(arm)
        us = 1 + (*ARMS, *FLOORS).index(arm)
        return [[us * 1e-6] * calls] * callers, calls * us * 1e-6


def test_blocks_go_forth_and_back_and_the_first_ones_do_not_count():
    crowd, told = PlayedCrowd(), []
    config = BenchTransportConfig(calls=20, rounds=2)
    rows = measure(crowd, config, "301 KB", 1, lambda *said: told.append(said))
    arms = [*ARMS, *FLOORS]
    assert crowd.order == arms + 2 * (arms + arms[::-1]) and [number for number, _ in told] == [1, 2]
    for place, row in enumerate(rows, 1):
        assert row["bytes"] == 301_088
        assert row["p50_us"]["blocks"] == row["p99_us"]["blocks"] == pytest.approx([place] * 4)
        assert row["calls_per_s"]["median"] == pytest.approx(1e6 / place)
        assert row["of_floor"]["median"] == pytest.approx(5 / place)
    crowd.order.clear()
    assert {row["arm"] for row in measure(crowd, config, "12 KB", 8, lambda *_: None)} == set(ARMS)
    assert MEMCPY not in crowd.order, "floors are those of one caller"


def test_what_is_sent_weighs_what_its_name_says():
    assert sum(array.nbytes for array in arrays_of(request_of("301 KB", 0))) == 301_088
    assert sum(array.nbytes for array in arrays_of(request_of("12 KB", 0))) == 12_304
    assert not np.array_equal(*(arrays_of(request_of("12 KB", seed))[0] for seed in (0, 1)))
    assert decision().chunk.shape == (50, 7)


def test_a_folder_that_exists_is_not_written_into(tmp_path: Path):
    with pytest.raises(InputError, match="^output_dir="):
        bench_transport(BenchTransportConfig(output_dir=str(tmp_path)))
