# SPDX-License-Identifier: Apache-2.0
"""From finished episodes to numbers, and the plans they came from."""

from __future__ import annotations

import io
import json

import pytest
from rich.console import Console

from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation.config import EvaluationConfig, evaluation_plans
from accerl_lerobot.evaluation.summary import outcomes, summarise, table
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodeResult
from accerl_lerobot.seeds import DEMO_SEEDS, EVAL_SEEDS, TRAIN_SEEDS


def result(task: str, seed: int, success: bool, versions: tuple[int, int] = (3, 3)) -> EpisodeResult:
    plan = EpisodePlan(task=task, seed=seed, explore=False)
    return EpisodeResult(
        plan=plan,
        success=success,
        episode_return=1.0 if success else -0.5,
        steps=50 if success else 150,
        decisions=15,
        versions=versions,
    )


RESULTS = [
    *(result("door", i, success=i < 8, versions=(3, 5)) for i in range(10)),
    *(result("drawer", i, success=i < 1, versions=(2, 4)) for i in range(10)),
]


class TestSummarise:
    """Plain numbers, by hand."""

    def test_in_all(self) -> None:
        summary = summarise(RESULTS)
        assert (summary["success"], summary["n"]) == (0.45, 20)
        # Wilson, 9 of 20: (p + z²/2n ± z √(p(1 − p)/n + z²/4n²)) / (1 + z²/n) with z = 1.959964
        assert summary["ci95"] == pytest.approx([0.258199, 0.657906], abs=1e-5)
        assert summary["return_mean"] == pytest.approx((9 - 11 * 0.5) / 20)
        assert summary["steps_mean"] == pytest.approx((9 * 50 + 11 * 150) / 20)
        assert (summary["version_min"], summary["version_max"]) == (2, 5)

    def test_per_task(self) -> None:
        tasks = summarise(RESULTS)["tasks"]
        assert list(tasks) == ["door", "drawer"]
        assert [(t["success"], t["n"]) for t in tasks.values()] == [(0.8, 10), (0.1, 10)]
        assert all(t["ci95"][0] < t["success"] < t["ci95"][1] for t in tasks.values())

    def test_says_which_starts_failed(self) -> None:
        task = summarise(RESULTS)["tasks"]["door"]
        assert task["seeds"] == [0, 9] and task["failed_seeds"] == [8, 9]

    def test_is_json(self) -> None:
        summary = summarise(RESULTS)
        assert json.loads(json.dumps(summary)) == summary

    def test_nothing(self) -> None:
        with pytest.raises(ValueError, match="no episodes"):
            summarise([])

    def test_outcomes_pair_by_task_and_seed(self) -> None:
        assert outcomes(RESULTS)["door", 7] and not outcomes(RESULTS)["drawer", 7]


class TestTable:
    """For the terminal."""

    def shown(self, results: list[EpisodeResult]) -> str:
        console = Console(file=io.StringIO(), width=100)
        console.print(table(summarise(results), "policy"))
        return console.file.getvalue()  # type: ignore[attr-defined]

    def test_has_a_row_per_task_and_one_for_all(self) -> None:
        text = self.shown(RESULTS)
        assert "door" in text and "80.0 %" in text and "all" in text and "45.0 %" in text and "n=20" in text

    def test_one_task_needs_no_sum(self) -> None:
        assert "all" not in self.shown(RESULTS[:10])


class TestPlans:
    """Which episodes are run."""

    def test_are_paired_across_evaluations_and_runs(self) -> None:
        before = evaluation_plans(("a", "b"), 10, "before")
        after = evaluation_plans(("a", "b"), 10, "after")
        assert [(p.task, p.seed) for p in before] == [(p.task, p.seed) for p in after]
        assert len({(p.task, p.seed) for p in before}) == 10

    def test_another_seed_has_other_starts(self) -> None:
        seeds = [{p.seed for p in evaluation_plans(("a", "b"), 10, "x", seed=seed)} for seed in (0, 1)]
        assert len(seeds[0]) == len(seeds[1]) == 5 and not seeds[0] & seeds[1]

    def test_smaller_evaluations_are_the_beginning_of_larger_ones(self) -> None:
        few, many = (evaluation_plans(("a", "b"), n, "x") for n in (6, 12))
        assert few == many[:6]

    def test_seeds_are_never_trained_on(self) -> None:
        for plan in evaluation_plans(("a",), 50, "x"):
            assert plan.seed in EVAL_SEEDS
            assert plan.seed not in TRAIN_SEEDS and plan.seed not in DEMO_SEEDS

    def test_tasks_share_evenly(self) -> None:
        plans = evaluation_plans(("a", "b", "c"), 8, "x")
        assert [sum(p.task == t for p in plans) for t in "abc"] == [3, 3, 2]

    def test_do_not_explore_and_are_filmed_first(self) -> None:
        plans = evaluation_plans(("a",), 4, "x", film=2)
        assert not any(p.explore for p in plans)
        assert [p.film for p in plans] == [True, True, False, False]
        assert [p.index for p in plans] == [0, 1, 2, 3] and {p.group for p in plans} == {"x"}


@pytest.mark.parametrize(
    ("field", "value"),
    [("episodes", 0), ("episodes_during", 0), ("video_size", 0), ("video_every", 0), ("videos", -1)],
)
def test_ranges(field: str, value: int) -> None:
    with pytest.raises(InputError, match=f"evaluation.{field}={value}"):
        EvaluationConfig(**{field: value})
