# SPDX-License-Identifier: Apache-2.0
"""Success rates on fixed seeds with their intervals, and pictures of them.

A rate is never reported without n and an interval.
"""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from rich.table import Table

from accerl_lerobot.config.ranges import Range, Section, Steps
from accerl_lerobot.console import rate
from accerl_lerobot.errors import for_viewing
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodeResult
from accerl_lerobot.seeds import eval_seed

STYLE = {
    "text.parse_math": False, "font.size": 9, "axes.grid": True, "grid.color": "#e9ecf1",
    "axes.spines.top": False, "axes.spines.right": False,
}  # fmt: skip


STEPS = "env steps of online experience"
FILM = 128, 4
"""Side in pixels and env steps per frame of videos, which show 20 frames a second; see `EpisodePlan.film`."""


class Interval(NamedTuple):
    """Both ends as fractions."""

    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class Rate:
    """Successes out of n; as text ``93 % [86, 97] n=100``."""

    successes: int
    n: int

    @property
    def value(self) -> float:
        """The observed fraction; NaN for n = 0."""
        return self.successes / self.n if self.n else math.nan

    def interval(self) -> Interval:
        """Wilson's score interval of 95 % (Wilson 1927; Brown, Cai and DasGupta 2001, section 3.1.1).

            (p + z²/2n ± z √(p(1 − p)/n + z²/4n²)) / (1 + z²/n),  p = successes / n

        Unlike p ± z√(p(1 − p)/n) it has width at 0 and at n successes and stays inside [0, 1]. For n = 0 it
        is [0, 1], as nothing is known.
        """
        from scipy.stats import binomtest

        if self.n == 0:
            return Interval(0.0, 1.0)
        interval = binomtest(self.successes, self.n).proportion_ci(method="wilson")
        return Interval(float(interval.low), float(interval.high))

    def __str__(self) -> str:
        return f"{rate(self.value, self.interval())} n={self.n}"


def rate_of(results: Sequence[EpisodeResult]) -> Rate:
    """Successes among episodes."""
    return Rate(successes=sum(result.success for result in results), n=len(results))


def by_task(results: Sequence[EpisodeResult]) -> dict[str, list[EpisodeResult]]:
    """Task → its episodes, sorted by task."""
    episodes: dict[str, list[EpisodeResult]] = {}
    for result in sorted(results, key=lambda result: result.plan.task):
        episodes.setdefault(result.plan.task, []).append(result)
    return episodes


def summarise(results: Sequence[EpisodeResult]) -> dict[str, Any]:
    """Success with its 95 % Wilson interval, in all and per task, as plain JSON types.

    ``notes`` say why the success of some episodes may not be what happened.
    """
    return _rate(results) | {
        "return_mean": float(np.mean([result.episode_return for result in results])),
        "steps_mean": float(np.mean([result.steps for result in results])),
        "version_min": min(result.versions[0] for result in results),
        "version_max": max(result.versions[1] for result in results),
        "tasks": {name: _rate(episodes) for name, episodes in by_task(results).items()},
        "notes": notes(results),
    }


def notes(results: Sequence[EpisodeResult]) -> list[str]:
    """Each `EpisodeResult.note`, with the number of episodes that have it."""
    counts = Counter(result.note for result in results if result.note)
    return [f"{count} of {len(results)} episodes: {note}" for note, count in counts.items()]


def table(summary: dict[str, Any], title: str) -> Table:
    """`summarise`'s numbers for the terminal."""
    out = Table("task", "success [95 % Wilson]", "episodes", title=title)
    rows = dict(summary["tasks"])
    if len(rows) > 1:
        rows["all"] = summary
    for name, entry in rows.items():
        out.add_row(name, rate(entry["success"], entry["ci95"]), str(entry["n"]))
    return out


def _rate(results: Sequence[EpisodeResult]) -> dict[str, Any]:
    found = rate_of(results)
    return {"success": found.value, "n": found.n, "ci95": list(found.interval())}


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
    episodes_during: Annotated[int, Range("[1, 10000]")] = 20
    """Episodes of each evaluation while training."""
    videos: Annotated[int, Range("[0, 1000]")] = 16
    """Episodes filmed, the same before and after."""


def evaluation_plans(
    tasks: Sequence[str], episodes: int, group: str, *, seed: int = 0, filmed: int = 0
) -> list[EpisodePlan]:
    """`episodes` plans of an evaluation called `group`, spread evenly over `tasks`; the first are `filmed`.

    The run's `seed` decides on the starts, see `eval_seed`.
    """
    plans = []
    for i in range(episodes):
        start = eval_seed(seed, i // len(tasks))
        film = FILM if i < filmed else None
        task = tasks[i % len(tasks)]
        plans.append(EpisodePlan(task=task, seed=start, explore=False, index=i, group=group, film=film))
    return plans


GAP = 4
BORDER = 5


class Series(NamedTuple):
    """Points of one line, and their intervals if there are any."""

    x: np.ndarray
    y: np.ndarray
    interval: np.ndarray | None = None  # (2, n)


class Chart(NamedTuple):
    """Series over a common x, by their names."""

    title: str
    x_label: str
    series: dict[str, Series]
    share: bool = False
    limit: float | None = None

    @property
    def drawable(self) -> bool:
        return any(np.isfinite(series.y).any() for series in self.series.values())

    def png(self) -> bytes:
        import matplotlib as mpl
        from matplotlib.figure import Figure
        from matplotlib.ticker import PercentFormatter

        buffer = io.BytesIO()
        with mpl.rc_context(STYLE):
            figure = Figure(figsize=(5.2, 2.6), dpi=150, layout="constrained")
            axes = figure.subplots()
            for name, (x, y, interval) in self.series.items():
                axes.plot(x, y, label=name, marker="o" if len(x) < 20 else "")
                if interval is not None:
                    axes.fill_between(x, *interval, alpha=0.2)
            if self.limit is not None:
                axes.axhline(self.limit, color="grey", linestyle="--")
            if self.share:
                axes.set_ylim(-0.03, 1.04)
                axes.yaxis.set_major_formatter(PercentFormatter(1.0))
            axes.set_xlabel(self.x_label)
            axes.legend()
            figure.savefig(buffer, format="png")
        return buffer.getvalue()


def evaluations_over_steps(evaluations: Sequence[dict[str, Any]]) -> Series:
    """Success with its intervals; evaluations are `summarise` results with an ``env_steps`` entry."""
    numbers = sorted((e["env_steps"], e["success"], *e["ci95"]) for e in evaluations)
    steps, success, low, high = np.array(numbers, np.float64).reshape(-1, 4).T
    return Series(steps, success, np.stack([low, high]))


@for_viewing("success_curve.png")
def success_curve(
    path: Path, evaluations: Sequence[dict[str, Any]], training: Sequence[tuple[float, float]]
) -> None:
    """Draws evaluations, and the share of successful exploring episodes, of which `training` has pairs with
    env steps.
    """
    exploring = Series(*np.array(training).reshape(-1, 2).T)
    series = {"while exploring": exploring, "evaluation": evaluations_over_steps(evaluations)}
    path.write_bytes(Chart("success", STEPS, series, share=True).png())


@for_viewing("film")
def write_video(path: Path, rows: Sequence[Sequence[Sequence[np.ndarray]]], fps: int) -> None:
    """Writes rows of clips, of equal width, as MP4; a clip that ends early holds its last frame.

    Frames are uint8 (H, W, 3), all of one height in a row. LeRobot leaves an odd last row or column out.
    """
    from lerobot.utils import io_utils

    length = max(max(map(len, row)) for row in rows)
    frames = []
    for i in range(length + fps):
        lines = []
        for row in rows:
            pictures = [clip[min(i, len(clip) - 1)] for clip in row]
            lines.append(_joined(pictures, axis=1))
        frames.append(_joined(lines, axis=0))
    io_utils.write_video(path, frames, fps)


@for_viewing("film")
def before_after(
    path: Path, before: Sequence[EpisodeResult], after: Sequence[EpisodeResult], fps: int
) -> None:
    """Films the same episodes twice, before training on the left and after it on the right.

    The frame of an episode that has ended is green for a success and red for a failure. Nothing is written
    when no episode was filmed. `before` and `after` are results of the same plans.
    """
    first = _filmed(before)
    second = _filmed(after)
    both = sorted(first.keys() & second.keys())
    if not both:
        return
    blank = np.full_like(first[both[0]].frames[0], 255)
    gap = blank[:, : 2 * GAP]
    columns = math.ceil(math.sqrt(len(both)))
    rows = []
    for start in range(0, len(both), columns):
        indices = both[start : start + columns]
        left = [_with_outcome(first[index]) for index in indices]
        right = [_with_outcome(second[index]) for index in indices]
        missing = [[blank]] * (columns - len(indices))
        rows.append([*left, *missing, [gap], *right, *missing])
    write_video(path, rows, fps)


def _filmed(results: Sequence[EpisodeResult]) -> dict[int, EpisodeResult]:
    """Index in the evaluation → episode that was filmed."""
    return {result.plan.index: result for result in results if result.frames}


def _with_outcome(result: EpisodeResult) -> list[np.ndarray]:
    """Frames of an episode, and the last once more in a frame whose colour tells how it ended."""
    last = result.frames[-1]
    ended = np.empty_like(last)
    ended[:] = (40, 160, 60) if result.success else (200, 40, 40)
    inner = slice(BORDER, -BORDER)
    ended[inner, inner] = last[inner, inner]
    return [*result.frames, ended]


def _joined(pictures: Sequence[np.ndarray], axis: int) -> np.ndarray:
    """Pictures beside (axis 1) or below (axis 0) each other, with a white margin between them."""
    margin = [(0, 0), (0, 0), (0, 0)]
    margin[axis] = (0, GAP)
    parts = [np.pad(picture, margin, constant_values=255) for picture in pictures[:-1]]
    return np.concatenate([*parts, pictures[-1]], axis=axis)
