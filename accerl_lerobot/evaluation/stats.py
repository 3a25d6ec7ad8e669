# SPDX-License-Identifier: Apache-2.0
"""Success rates with their intervals. A rate is never reported without n and an interval.

Fields of evaluation: tasks, times and seeds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Annotated, Any, NamedTuple

import numpy as np
from rich.table import Table

from accerl_lerobot.config.ranges import Range, Section, Steps
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodeResult
from accerl_lerobot.seeds import eval_seed


class Interval(NamedTuple):
    """Both ends as fractions."""

    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class Rate:
    """Successes out of n.

    Example:
        >>> str(Rate(successes=93, n=100))
        '93.0 % [86.3, 96.6] n=100'

    Raises:
        ValueError: more successes than episodes, or fewer than none.
    """

    successes: int
    n: int

    def __post_init__(self) -> None:
        if not 0 <= self.successes <= self.n:
            raise ValueError(f"{self.successes} successes in {self.n} episodes")

    @property
    def value(self) -> float:
        """The observed fraction; NaN for n = 0."""
        return self.successes / self.n if self.n else math.nan

    def interval(self, confidence: float = 0.95) -> Interval:
        """`wilson_interval` of this rate."""
        return wilson_interval(self.successes, self.n, confidence)

    def __str__(self) -> str:
        if self.n == 0:
            return "no episodes"
        low, high = self.interval()
        return f"{100 * self.value:.1f} % [{100 * low:.1f}, {100 * high:.1f}] n={self.n}"


def wilson_interval(successes: int, n: int, confidence: float = 0.95) -> Interval:
    """Wilson's score interval of a proportion (Wilson 1927; Brown, Cai and DasGupta 2001, section 3.1.1).

        z = Φ⁻¹((1 + confidence) / 2),  p = successes / n
        (p + z²/2n ± z √(p(1 − p)/n + z²/4n²)) / (1 + z²/n)

    Unlike p ± z√(p(1 − p)/n) it has width at 0 and at n successes and stays inside [0, 1]. For n = 0 it is
    [0, 1], as nothing is known.

    Raises:
        ValueError: a count or the confidence is out of range.
    """
    if not 0 <= successes <= n:
        raise ValueError(f"{successes} successes in {n} episodes")
    _check_confidence(confidence)
    if n == 0:
        return Interval(0.0, 1.0)
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    p, share = successes / n, z * z / n
    centre = (p + share / 2) / (1 + share)
    half = z * math.sqrt(p * (1 - p) / n + share / (4 * n)) / (1 + share)
    return Interval(0.0 if successes == 0 else centre - half, 1.0 if successes == n else centre + half)


def mean_interval(values: Sequence[float], confidence: float = 0.95) -> Interval:
    """Interval of the mean over runs, by Student's t (1908).

        m ± t · s / √k,  s² = Σ (x − m)² / (k − 1),  t of k − 1 degrees of freedom

    Policies of several seeds differ by more than their episodes do, so treating all their episodes as those
    of one policy would claim too much.

    Args:
        values: one of each run, at least two; the interval is not cut to any range.
        confidence: above 0 and below 1.

    Raises:
        ValueError: fewer than two values, or a confidence out of range.
    """
    if len(values) < 2:
        raise ValueError(f"{len(values)} values: use at least two")
    _check_confidence(confidence)
    from scipy.special import stdtrit

    mean, error = float(np.mean(values)), float(np.std(values, ddof=1)) / math.sqrt(len(values))
    half = float(stdtrit(len(values) - 1, (1 + confidence) / 2)) * error
    return Interval(mean - half, mean + half)


def summarise(results: Sequence[EpisodeResult]) -> dict[str, Any]:
    """Success with its 95 % Wilson interval, in all and per task, as plain JSON types.

    Each task has the first and the last of its ``seeds``, and the ``failed_seeds`` among them.

    Raises:
        ValueError: no episodes.
    """
    if not results:
        raise ValueError("nothing to summarise: no episodes")
    outcomes = {(r.plan.task, r.plan.seed): r.success for r in results}
    tasks = {}
    for name in sorted({task for task, _ in outcomes}):
        seeds = {seed: success for (task, seed), success in outcomes.items() if task == name}
        failed = sorted(seed for seed, success in seeds.items() if not success)
        tasks[name] = {**_rate(seeds.values()), "seeds": [min(seeds), max(seeds)], "failed_seeds": failed}
    return {
        **_rate(outcomes.values()),
        "return_mean": float(np.mean([r.episode_return for r in results])),
        "steps_mean": float(np.mean([r.steps for r in results])),
        "version_min": min(r.versions[0] for r in results),
        "version_max": max(r.versions[1] for r in results),
        "tasks": tasks,
    }


def table(summary: dict[str, Any], title: str) -> Table:
    """`summarise`'s numbers for the terminal."""
    out = Table("task", "success [95 % Wilson]", title=title)
    rows = list(summary["tasks"].items())
    for name, entry in [*rows, ("all", summary)] if len(rows) > 1 else rows:
        out.add_row(name, str(Rate(successes=round(entry["success"] * entry["n"]), n=entry["n"])))
    return out


def _rate(successes: Any) -> dict[str, Any]:
    rate = Rate(successes=sum(map(bool, successes)), n=len(successes))
    return {"success": rate.value, "n": rate.n, "ci95": list(rate.interval())}


def _check_confidence(confidence: float) -> None:
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence {confidence}: use a number between 0 and 1")


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig(Section, section="evaluation"):
    """Success rates before, during and after training; always with LeRobot's own sampler."""

    episodes: Annotated[int, Range("[1, 10000]")] = 100
    """Episodes before and after training, over all tasks; the same starts both times, chosen by the run's
    seed and never trained on."""
    before: bool = True
    """Evaluate before training too; without it there is no video of before and after."""
    every_updates: Steps = 0
    """Evaluate while training, every so many updates; 0 does not."""
    episodes_during: Annotated[int, Range("[1, 1000000]")] = 20
    """Episodes of each evaluation while training."""
    videos: Annotated[int, Range("[0, 1000]")] = 16
    """Episodes filmed, the same before and after."""
    video_size: Annotated[int, Range("[16, 4096]")] = 128
    """Side of the video in pixels."""
    video_every: Annotated[int, Range("[1, 1000]")] = 4
    """Env steps per video frame, of which 20 are shown in a second."""

    @property
    def film(self) -> tuple[int, int]:
        """See `EpisodePlan.film`."""
        return self.video_size, self.video_every


def evaluation_plans(
    tasks: Sequence[str],
    episodes: int,
    group: str,
    *,
    seed: int = 0,
    filmed: int = 0,
    film: tuple[int, int] = (128, 4),
) -> list[EpisodePlan]:
    """`episodes` plans, spread evenly over `tasks`.

    Args:
        tasks: names the world accepts.
        episodes: over all tasks.
        group: label of this evaluation.
        seed: of the run; decides on the starts, see `eval_seed`.
        filmed: how many of the first episodes record frames.
        film: see `EpisodePlan.film`.
    """
    return [
        EpisodePlan(
            task=tasks[i % len(tasks)],
            seed=eval_seed(seed, i // len(tasks)),
            explore=False,
            index=i,
            group=group,
            film=film if i < filmed else None,
        )
        for i in range(episodes)
    ]
