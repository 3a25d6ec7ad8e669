# SPDX-License-Identifier: Apache-2.0
"""The interface of an engine: the asynchronous one (`launch`) or the one-process one (`local`)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Container, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from accerl_lerobot.rollout.runner import EpisodePlan, EpisodeResult

LONGEST_PAUSE_S = 8.0


def pause_s(restarts: int) -> float:
    """Seconds to wait before another restart; twice as long each time, up to `LONGEST_PAUSE_S`."""
    return min(2.0 ** (restarts - 1), LONGEST_PAUSE_S) if restarts else 0.0


@dataclass(kw_only=True)
class Progress:
    """Events since the last poll."""

    version: int
    """Updates made so far."""
    done: bool = False
    """The trainer has made all its updates."""
    updates: list[dict[str, float]] = field(default_factory=list)
    """Metrics of each update."""
    episodes: list[EpisodeResult] = field(default_factory=list)
    """Finished episodes, both exploring and planned."""
    rollout: dict[str, float] = field(default_factory=dict)
    """Counters over all rollout workers since the run began."""
    replay: dict[str, float] = field(default_factory=dict)
    inference: dict[str, float] = field(default_factory=dict)
    imagination: dict[str, float] = field(default_factory=dict)
    """Empty where nothing is imagined."""


class WorkerError(RuntimeError):
    """A worker is lost for good, and the engine with it; another engine can resume from a checkpoint."""


class Saved(NamedTuple):
    """Files of one checkpoint."""

    version: int
    """Version of the policy: updates behind it."""
    updates: list[dict[str, float]]
    """Metrics of updates that `Engine.poll` has not reported and will not report."""


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

        Raises:
            ValueError: an episode of the same group and index has been planned and not been reported yet.
        """

    @abstractmethod
    def train(self) -> None:
        """Start exploring and learning; both end by themselves after the configured updates."""

    @abstractmethod
    def poll(self) -> Progress:
        """Do or await a little work and report it.

        Raises:
            WorkerError: a worker failed for good; carries its own traceback.
        """

    @abstractmethod
    def save(self, directory: Path) -> Saved:
        """Write a checkpoint's ``pretrained_model`` and ``training_state``, see `checkpoint`.

        All parts are of the same update: no segment counts as learned from that was used later, and no
        planned episode is reported twice.
        """

    @abstractmethod
    def close(self) -> None:
        """End all workers. Does not raise, so that it hides no other error. Safe to call twice."""


def episode_key(plan: EpisodePlan) -> tuple[str, int]:
    """Key of a planned episode."""
    return plan.group, plan.index


def check_new(plans: Sequence[EpisodePlan], outstanding: Container[tuple[str, int]]) -> None:
    """Check the argument of `Engine.plan`.

    Raises:
        ValueError: see there.
    """
    keys: set[tuple[str, int]] = set()
    for plan in plans:
        key = episode_key(plan)
        if key in keys or key in outstanding:
            raise ValueError(f"episode {plan.index} of {plan.group!r} is planned twice")
        keys.add(key)
