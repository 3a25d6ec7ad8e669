# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""What is evaluated, how often, on which seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from accerl_lerobot.errors import InputError
from accerl_lerobot.rollout.runner import EpisodePlan
from accerl_lerobot.seeds import eval_seed


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig:
    """Success rates before, during and after training; always with LeRobot's own sampler."""

    episodes: int = 100
    """Episodes before and after training, over all tasks; the same seeds both times, never trained on."""
    before: bool = True
    """Evaluate before training too; without it there is no video of before and after."""
    every_updates: int = 0
    """Evaluate while training, every so many updates; 0 does not."""
    episodes_during: int = 20
    """Episodes of each evaluation while training."""
    videos: int = 4
    """Episodes filmed, the same before and after."""
    video_size: int = 200
    """Side of the video in pixels."""
    video_every: int = 2
    """Env steps per video frame."""

    def __post_init__(self) -> None:
        for name in ("episodes", "episodes_during", "video_size", "video_every"):
            if getattr(self, name) < 1:
                raise InputError(f"evaluation.{name}", getattr(self, name), "use at least 1")
        for name in ("every_updates", "videos"):
            if getattr(self, name) < 0:
                raise InputError(f"evaluation.{name}", getattr(self, name), "use 0 (off) or more")


def evaluation_plans(tasks: Sequence[str], episodes: int, group: str, film: int = 0) -> list[EpisodePlan]:
    """`episodes` plans, spread evenly over `tasks`; episode i of a task has the same seed in every run.

    Args:
        tasks: names the world accepts.
        episodes: over all tasks.
        group: label of this evaluation.
        film: how many of the first episodes record frames.
    """
    return [
        EpisodePlan(
            task=tasks[i % len(tasks)],
            seed=eval_seed(i // len(tasks)),
            explore=False,
            index=i,
            group=group,
            film=i < film,
        )
        for i in range(episodes)
    ]
