# SPDX-License-Identifier: Apache-2.0
"""Fields of evaluation: tasks, times and seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from accerl_lerobot.config.ranges import Range, Section, Steps
from accerl_lerobot.rollout.runner import EpisodePlan
from accerl_lerobot.seeds import eval_seed


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
