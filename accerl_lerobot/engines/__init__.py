# SPDX-License-Identifier: Apache-2.0
"""The interface of an engine: environments, policy and trainer, as the loop of a run sees them.

`local` has the engine of one process, and `ray_engine` that of many, with the workers it supervises.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from accerl_lerobot.rollout.runner import EpisodePlan, EpisodeResult


@dataclass(kw_only=True)
class Progress:
    """Events since the last poll."""

    version: int  # updates made so far
    done: bool = False  # the trainer has made all its updates
    updates: list[dict[str, float]] = field(default_factory=list)  # metrics of each update
    episodes: list[EpisodeResult] = field(default_factory=list)
    """Finished episodes, both exploring and planned."""
    rollout: dict[str, float] = field(default_factory=dict)
    """Counters over all rollout workers since the run began."""
    replay: dict[str, float] = field(default_factory=dict)
    inference: dict[str, float] = field(default_factory=dict)
    world_model: dict[str, float] = field(default_factory=dict)  # empty where no imagined one learns


class Engine(ABC):
    """Environments, policy and trainer, fresh or restored from what `save` has written.

    Example:
        >>> engine.plan(evaluation_plans(tasks, 100, "before"))   # runs at once, nothing else does
        >>> engine.train()                                        # planned episodes still go first
        >>> while not (progress := engine.poll()).done: ...
        >>> engine.save(directory)
    """

    @abstractmethod
    def plan(self, plans: list[EpisodePlan]) -> None:
        """Queue episodes that are run before any exploring one; `poll` reports one result for each.

        No two of them that are under way have the same group and index.
        """

    @abstractmethod
    def train(self) -> None:
        """Start exploring and learning; both end by themselves after the configured updates."""

    @abstractmethod
    def poll(self) -> Progress:
        """Do or await a little work and report it."""

    @abstractmethod
    def save(self, directory: Path) -> Progress:
        """Write a checkpoint's ``pretrained_model`` and ``training_state``, see `checkpoint`.

        Returns its version, and the metrics of updates that `poll` will not report.
        All parts are of the same update: no segment counts as learned from that was used later, and no
        planned episode is reported twice.
        """

    @abstractmethod
    def close(self) -> None:
        """End all workers. Does not raise, so that it hides no other error. Safe to call twice."""
