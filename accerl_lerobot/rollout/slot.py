# SPDX-License-Identifier: Apache-2.0
"""One world, and the episode in it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from accerl_lerobot.envs.base import World
from accerl_lerobot.experience import Observation, Origin
from accerl_lerobot.rollout.segments import SegmentBuilder

if TYPE_CHECKING:
    from accerl_lerobot.rollout.runner import EpisodePlan

_STATE = ("plan", "episode_return", "steps", "decisions", "versions", "frames", "chunks")


@dataclass
class Slot:
    """State of one episode under way in `RolloutRunner`."""

    world: World
    plan: EpisodePlan | None = None
    builder: SegmentBuilder | None = None
    episode_return: float = 0.0
    steps: int = 0
    decisions: int = 0
    versions: list[int] = field(default_factory=list)
    frames: list[np.ndarray] = field(default_factory=list)
    chunks: list[np.ndarray] = field(default_factory=list)
    """All that was executed, by which `restore` brings the world back to where it was."""

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        builder = None if self.plan is None or self.builder is None else self.builder.state()
        return {name: getattr(self, name) for name in _STATE} | {"builder": builder}

    def restore(self, state: dict[str, Any], segment_length: int) -> None:
        """Goes on from what `state` gave: the world is brought back by doing again what was done in it.

        Raises:
            RuntimeError: it does not show then what it had shown.
        """
        plan: EpisodePlan | None = state["plan"]
        if plan is None:
            return
        observation = self.world.reset(plan.seed, plan.task)
        for chunk in state["chunks"]:
            observation = self.world.step_chunk(chunk).observation
        self.builder = SegmentBuilder(observation, segment_length, Origin(plan.task, plan.seed, decision=0))
        self.builder.restore(state["builder"])
        if not _equal(observation, self.builder.latest):
            raise RuntimeError(
                f"{plan.task} with seed {plan.seed} does not show again what it had shown after "
                f"{len(state['chunks'])} decisions, so its episodes cannot be gone on with in the middle; "
                "use launch.engine=ray, which begins them anew"
            )
        for name in _STATE:
            setattr(self, name, state[name])


def _equal(one: Observation, other: Observation) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[key], other[key]) for key in one)
