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
"""Before what was lost is started again; a pause is twice as long as the one before."""


def pause_s(restarts: int) -> float:
    """Seconds before what was lost is started again where that has been done so often in a row already."""
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
    """Finished episodes, exploring and planned ones."""
    rollout: dict[str, float] = field(default_factory=dict)
    """Counters over all rollout workers since the run began."""
    replay: dict[str, float] = field(default_factory=dict)
    inference: dict[str, float] = field(default_factory=dict)
    imagination: dict[str, float] = field(default_factory=dict)
    """Empty where nothing is imagined."""


class WorkerError(RuntimeError):
    """A worker is lost for good, and the engine with it; another one may go on from what was saved."""


class Saved(NamedTuple):
    """Files of one checkpoint."""

    version: int
    """Version of the policy: updates behind it."""
    updates: list[dict[str, float]]
    """Metrics of those updates among them that `Engine.poll` has not reported, and will not any more."""


class Engine(ABC):
    """Worlds, policy and trainer, ready to go; or to go on, from what `save` has written.

    Example:
        >>> engine.plan(evaluation_plans(tasks, 100, "before"))   # runs at once, nothing else does
        >>> engine.train()                                        # planned episodes still go first
        >>> while not (progress := engine.poll()).done: ...
        >>> engine.save(directory)
    """

    @abstractmethod
    def plan(self, plans: list[EpisodePlan]) -> None:
        """Queues episodes that are run before any exploring one; each has one result, which `poll` reports.

        Raises:
            ValueError: an episode of the same group and index has been planned and not been reported yet.
        """

    @abstractmethod
    def train(self) -> None:
        """Starts exploring and learning; both end by themselves after the configured updates."""

    @abstractmethod
    def poll(self) -> Progress:
        """Does or awaits a little work and reports it.

        Raises:
            WorkerError: a worker failed for good; carries its own traceback.
        """

    @abstractmethod
    def save(self, directory: Path) -> Saved:
        """Writes a checkpoint's ``pretrained_model`` and ``training_state``, see `checkpoint`.

        All of it is as it was after one and the same update: no segment that was learnt from later counts as
        learnt from, and no planned episode is reported twice.
        """

    @abstractmethod
    def close(self) -> None:
        """Ends all workers; does not raise, so that it cannot hide why it is called. Safe to call twice."""


def episode_key(plan: EpisodePlan) -> tuple[str, int]:
    """Key of a planned episode."""
    return plan.group, plan.index


def check_new(plans: Sequence[EpisodePlan], outstanding: Container[tuple[str, int]]) -> None:
    """For engines: refuses what `Engine.plan` refuses.

    Raises:
        ValueError: see there.
    """
    keys: set[tuple[str, int]] = set()
    for plan in plans:
        key = episode_key(plan)
        if key in keys or key in outstanding:
            raise ValueError(f"episode {plan.index} of {plan.group!r} is planned twice")
        keys.add(key)
