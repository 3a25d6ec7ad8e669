# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from accerl_lerobot.engines.config import RunConfig, encode, parse
from accerl_lerobot.evaluation import Rate
from benchmarks import efficiency as bench
from benchmarks.efficiency import BenchEfficiencyConfig, cells
from benchmarks.study import Results, together
from tests.runs import tiny_run


def recipe(tmp_path: Path, checkpoint: Path) -> str:
    path = tmp_path / "recipe.yaml"
    content = encode(tiny_run(checkpoint))
    content["imagination"] |= {"environments": 4, "path": "nowhere"}
    path.write_text(yaml.safe_dump(content))
    return str(path)


def small(tmp_path: Path, checkpoint: Path, **options: Any) -> BenchEfficiencyConfig:
    defaults = {
        "recipe": recipe(tmp_path, checkpoint),
        "output_dir": str(tmp_path / "study"),
        "arms": ("none", "frozen"),
        "budgets": (4, 8),
        "seeds": (3, 4),
        "updates": 4,
        "episodes": 4,
        "decisions": 4,
    }
    return BenchEfficiencyConfig(**{**defaults, **options})


def a_summary(success: float, explored: int = 4) -> dict[str, Any]:
    return {
        "success_after": success, "n_after": 10, "env_steps": 100, "updates": 4, "rl_s": 1.0,
        "episodes_explored": explored, "imagined_episodes": 3,
    }  # fmt: skip


@pytest.fixture
def result(tmp_path: Path, tiny_checkpoint: Path) -> dict[str, Any]:
    config = small(tmp_path, tiny_checkpoint)
    made = cells(config, parse(RunConfig, [f"--config_path={config.recipe}"]))
    success = {("none", 4): 0.1, ("none", 8): 0.5, ("frozen", 4): 0.8, ("frozen", 8): 1.0}
    runs = [
        (cell, a_summary(success[cell.of["arm"], cell.of["budget"]], cell.of["budget"] - (cell.seed == 4)))
        for cell in made
    ]
    return bench.compare(config, Results({3: a_summary(0.2), 4: a_summary(0.4)}, runs))


def test_intervals_are_over_seeds_and_gains_are_of_pairs():
    """By hand: t of two degrees of freedom is 4.303 at 97.5 %, and s of (0.2, 0.5, 0.8) is 0.3."""
    rows, none = (
        [{"seed": seed, "success": x, "n": 10} for seed, x in enumerate(of)]
        for of in ((0.2, 0.5, 0.8), (0.1, 0.5, 0.6))
    )
    found = together(rows)
    assert (found["successes"], found["n"], found["by_seed"]) == (15, 30, [0.2, 0.5, 0.8])
    assert found["ci95"] == (0.0, 1.0), "0.5 ± 0.745"
    close = together([row | {"success": x} for row, x in zip(rows, (0.4, 0.5, 0.6), strict=True)])
    assert close["ci95"] == pytest.approx(
        (0.5 - 4.3027 * 0.1 / 3**0.5, 0.5 + 4.3027 * 0.1 / 3**0.5), abs=1e-4
    )
    alike = together([row | {"success": 0.5} for row in rows])
    wilson = Rate(successes=15, n=30).interval()
    assert alike["ci95"] == (wilson.low, wilson.high), "chance alone would not make them so alike"
    assert together(rows[:1])["ci95"] == tuple(Rate(successes=2, n=10).interval())
    gained = bench.over_none(rows, none[::-1])  # 0.1, 0 and 0.2, by seed
    half = 4.3027 * 0.1 / 3**0.5
    assert gained["gain"] == pytest.approx(0.1)
    assert gained["gain_ci95"] == pytest.approx((0.1 - half, 0.1 + half), abs=1e-4)
    assert bench.over_none(rows, []) == {} == bench.over_none(rows[:1], none[:1])


def test_the_table_and_the_picture(result: dict[str, Any], tmp_path: Path):
    lines = bench.markdown(result).splitlines()
    assert lines[0] == "| imagined | 4 real episodes | 8 real episodes |"
    assert lines[2].startswith(
        "| none | 10.0 % [2.8, 30.1] n=20 (10 10), 4 episodes of 100 env steps, 4 updates | 50.0 % ["
    )
    assert "(80 80), +70.0 points [+40.5, +83.9] over none, 4 episodes" in lines[3]
    assert lines[-1] == "Intervals are 95 %, over seeds where there are several."
    assert bench.table(result).row_count == 2
    bench.draw(tmp_path / "efficiency.png", result)
    assert (tmp_path / "efficiency.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_study_is_run(tmp_path: Path, tiny_checkpoint: Path):
    config = small(tmp_path, tiny_checkpoint, arms=("none",), budgets=(8,), seeds=(3,))
    (cell,) = bench.bench_efficiency(config)["cells"]
    assert (cell["arm"], cell["budget"], cell["n"], cell["updates"]) == ("none", 8, 4, 4)
    assert 0 < cell["episodes_explored"] <= 8
    made = {p.name for p in (tmp_path / "study").iterdir()}
    assert {"efficiency.json", "efficiency.md", "efficiency.png", "none-8-seed3"} < made
