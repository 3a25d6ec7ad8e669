# SPDX-License-Identifier: Apache-2.0
"""The lag study: what it compares."""

from __future__ import annotations

import json
from typing import Any

import pytest

from benchmarks import lag as bench
from benchmarks.lag import BenchLagConfig, cells
from benchmarks.study import Results


def a_summary(success: float, *, env_steps: int = 100, lag: float = 1.0) -> dict[str, Any]:
    return {
        "success_after": success, "n_after": 10, "env_steps": env_steps, "decisions": 10, "updates": 4,
        "lag_mean": lag, "lag_max": 5.0, "rl_s": 1.0,
    }  # fmt: skip


@pytest.fixture
def result() -> dict[str, Any]:
    config = BenchLagConfig(algorithms=("gipo", "ppo"), lags=(0, 2), seeds=(3, 4), updates=4, episodes=4)
    success = {"gipo": {0: (0.9, 1.0), 2: (0.5, 0.6)}, "ppo": {0: (0.8, 0.7), 2: (0.0, 0.1)}}
    runs = []
    for cell in cells(config):
        seed, lag = cell.seed, cell.of["lag"]
        share = success[cell.of["algorithm"]][lag][seed - 3]
        runs.append((cell, a_summary(share, env_steps=97 + seed, lag=lag + seed - 3)))
    return bench.compare(config, Results({3: a_summary(0.4), 4: a_summary(0.5)}, runs))


def test_seeds_are_counted_together(result: dict[str, Any]):
    gipo = result["groups"][0]
    assert (gipo["algorithm"], gipo["lag"], gipo["successes"], gipo["n"]) == ("gipo", 0, 19, 20)
    assert gipo["by_seed"] == [0.9, 1.0] and gipo["env_steps"] == 100.5 and gipo["lag_mean"] == 0.5
    assert [(g["successes"]) for g in result["groups"]] == [19, 11, 15, 1]
    assert result["starts"] == {"3": 0.4, "4": 0.5} and len(result["cells"]) == 8
    json.dumps(result)
