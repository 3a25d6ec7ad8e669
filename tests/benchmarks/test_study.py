# SPDX-License-Identifier: Apache-2.0
"""Studies: the runs they compare, and their numbers by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import yaml

from accerl_lerobot.engines.config import RunConfig, encode
from accerl_lerobot.evaluation import Rate
from accerl_lerobot.run import preflight
from benchmarks import study
from benchmarks.study import ALL, BenchStudyConfig, bench_study, together
from benchmarks.tables import mean_interval
from tests.runs import printed, tiny_run


def test_runs_share_the_policy_of_their_start_and_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    runs: dict[str, RunConfig] = {}

    def train(folder: Path, run: RunConfig) -> None:
        runs[folder.name] = run
        success = 0.4 if run.trainer.updates == 0 else 0.9 - 0.1 * run.seed - run.trainer.hold_back / 10
        summary = {"success_after": success, "n_after": 100, "episodes_explored": 30, "lag_mean": 2.0}
        folder.mkdir()
        (folder / "summary.json").write_text(json.dumps(summary | {"env_steps": 9, "updates": 4, "rl_s": 1}))

    monkeypatch.setattr(study, "train", train)
    monkeypatch.setattr(preflight, "check_start", lambda run: None)
    config = BenchStudyConfig(
        recipe="recipes/few_shot.yaml",
        starts=("--env.task=push-v3", "--env.task=door-open-v3"),
        arms=("--algorithm.type=gipo", "--algorithm.type=self_imitation --rollout.episodes=30"),
        settings=("", "--trainer.hold_back=4"),
        seeds=(0, 1),
        output_dir=str(tmp_path),
    )
    result = bench_study(config)

    assert len(runs) == 4 + 16
    for name, run in runs.items():
        assert f"env.task={run.env.task}" in name and name.endswith(f"seed{run.seed}")
        if run.trainer.updates:
            start = tmp_path / f"start-env.task={run.env.task}-seed{run.seed}"
            assert str(run.policy.path).startswith(str(start)) and run.dataset.root == str(start / "demos")
            assert f"algorithm.type={run.algorithm.type}" in name
            assert run.rollout.episodes == (30 if run.algorithm.type == "self_imitation" else 1500)
    (group,) = [
        group
        for group in result["groups"]
        if (group["start"], group["arm"], group["setting"]) == (ALL, config.arms[0], "")
    ]
    # Four values 0.9, 0.8, 0.9, 0.8: their standard error is 0.05 / sqrt(3), and t(3, 0.975) = 3.182.
    assert group["successes"] == 340 and group["by_policy"] == pytest.approx([0.9, 0.8, 0.9, 0.8])
    assert group["ci95"] == pytest.approx((0.85 - 0.0919, 0.85 + 0.0919), abs=1e-3)
    lines = (tmp_path / "study.md").read_text().splitlines()
    assert lines[0] == "| start | arm | SFT | success | --trainer.hold_back=4 |"
    assert lines[2].startswith("| --env.task=push-v3 | --algorithm.type=gipo | 40% | 85.0 % [")
    assert "n=200 (90 80), 30 episodes, lag 2.0 | 45.0 % [" in lines[2]
    assert (tmp_path / "study.png").stat().st_size > 1000 and "all starts" in printed(study.table(result))
    runs.clear()
    assert bench_study(config)["groups"] == json.loads((tmp_path / "study.json").read_text())["groups"]
    assert not runs, "finished runs are kept"


def test_a_mean_over_policies_is_as_unsure_as_they_differ():
    """t at 97.5 %: 2.776445 of four degrees of freedom, 12.706205 of one (Student's table)."""
    policies = [0.71, 0.47, 0.64, 0.33, 0.56]  # mean 0.542, s² = 0.08828 / 4
    half = 2.776445 * math.sqrt(0.08828 / 4 / 5)
    assert mean_interval(policies) == pytest.approx((0.542 - half, 0.542 + half), abs=1e-6)
    assert mean_interval([0.9, 1.0])[0] == pytest.approx(0.95 - 12.706205 * 0.05, abs=1e-6)
    wide = together([{"success": success, "n": 10} for success in (0.2, 0.5, 0.8)])
    assert (wide["successes"], wide["n"], wide["ci95"]) == (15, 30, [0.0, 1.0]), "0.5 ± 0.745"
    alike = together([{"success": 0.5, "n": 10}] * 3)
    wilson = Rate(successes=15, n=30).interval()
    assert alike["ci95"] == [wilson.low, wilson.high], "chance alone would not make them so alike"
    assert together([{"success": 0.2, "n": 10}])["ci95"] == list(Rate(successes=2, n=10).interval())


@pytest.mark.slow
def test_a_study_is_run(tmp_path: Path, tiny_checkpoint: Path):
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(yaml.safe_dump(encode(tiny_run(tiny_checkpoint))))
    folder = tmp_path / "study"
    config = BenchStudyConfig(
        recipe=str(recipe), arms=("--rollout.episodes=8",), seeds=(3,), updates=4, episodes=4,
        output_dir=str(folder),
    )  # fmt: skip
    (cell,) = bench_study(config)["cells"]
    assert (cell["n"], cell["updates"]) == (4, 4) and 0 < cell["episodes_explored"] <= 8
    assert {"study.json", "study.md", "study.png", "rollout.episodes=8-seed3"} < {
        p.name for p in folder.iterdir()
    }
