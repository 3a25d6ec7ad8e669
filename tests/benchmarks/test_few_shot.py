# SPDX-License-Identifier: Apache-2.0
"""The few-shot study: what it compares, and how its numbers are put together by hand."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from benchmarks import study as studies
from benchmarks.few_shot import BenchFewShotConfig, bench_few_shot
from benchmarks.records import mean_interval
from benchmarks.study import Results, Study


def a_summary(success: float, episodes: int = 0) -> dict[str, Any]:
    counts = {"episodes_explored": episodes, "env_steps": 150 * episodes, "rl_s": 1.0}
    return {"success_after": success, "n_after": 100} | counts


def test_runs_of_a_task_share_its_policy_and_its_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    seen: list[Study] = []

    def run(study: Study, console: studies.Console) -> Results:
        seen.append(study)
        after = {"chunk_critic": 0.9, "self_imitation": 0.5}
        cells = [(c, a_summary(after[c.of["algorithm"]] - 0.1 * c.seed, episodes=30)) for c in study.cells]
        return Results({seed: a_summary(0.4) for seed in study.config.seeds}, cells)

    monkeypatch.setattr(Study, "run", run)
    config = BenchFewShotConfig(
        tasks=("push-v3", "door-open-v3"), seeds=(0, 1), explored=30, output_dir=str(tmp_path)
    )
    result = bench_few_shot(config)

    for study, task in zip(seen, config.tasks, strict=True):
        assert len(study.runs) == 4
        for cell, run_config in zip(study.cells, study.runs, strict=True):
            assert run_config.env.task == task and run_config.rollout.episodes == 30
            assert run_config.algorithm.type == cell.of["algorithm"] and run_config.seed == cell.seed
            assert run_config.policy.path.startswith(str(study.start(cell.seed)))
            assert run_config.trainer.updates * run_config.trainer.batch_decisions >= 30 * 20
        assert all(start.env.task == task for start in study.starts.values())

    by_name = {name: group["success"] for name, group in result["means"].items()}
    assert by_name == pytest.approx({"sft": 0.4, "chunk_critic": 0.85, "self_imitation": 0.45})
    # Four values 0.9, 0.8, 0.9, 0.8: their standard error is 0.05 / sqrt(3), and t(3, 0.975) = 3.182.
    low, high = result["means"]["chunk_critic"]["ci95"]
    assert (low, high) == pytest.approx((0.85 - 0.0919, 0.85 + 0.0919), abs=1e-3)
    table = (tmp_path / "few_shot.md").read_text().splitlines()
    assert len(table) == 2 + 8
    assert table[2] == "| push-v3 | 0 | chunk_critic | 40% [31%, 50%] | 90% [83%, 94%] | 30 | 4,500 |"
    assert (tmp_path / "few_shot.png").stat().st_size > 5000 and (tmp_path / "few_shot.json").is_file()


def test_a_mean_over_runs_is_as_unsure_as_they_differ():
    """t at 97.5 %: 2.776445 of four degrees of freedom, 12.706205 of one (Student's table)."""
    policies = [0.71, 0.47, 0.64, 0.33, 0.56]  # mean 0.542, s² = 0.08828 / 4
    half = 2.776445 * math.sqrt(0.08828 / 4 / 5)
    found = mean_interval(policies)
    assert found == pytest.approx((0.542 - half, 0.542 + half), abs=1e-6)
    assert mean_interval([0.9, 1.0])[0] == pytest.approx(0.95 - 12.706205 * 0.05, abs=1e-6)
    assert mean_interval([0.3, 0.3])[0] == pytest.approx(0.3)
