# SPDX-License-Identifier: Apache-2.0
"""Which episode a free world runs next: planned evaluations first, then exploring ones.

An exploring episode is a task, each in turn, a seed of this worker's own (`seeds.py`) and, where episodes are
compared with each other, a place in a group (`groups.py`): the episodes of a group share task and seed, so
they start alike, and their exploration noise differs.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from typing import Any

from accerl_lerobot.rollout.groups import Groups
from accerl_lerobot.rollout.runner import EpisodePlan, RolloutConfig
from accerl_lerobot.seeds import train_seed

STARTS_PER_INCARNATION = 1000
"""By how much a restarted worker skips ahead in its training seeds, so as not to repeat its episodes."""


def budgets(config: RolloutConfig) -> list[int | None]:
    """How many exploring episodes each worker plays, in whole groups; None: no end."""
    if not config.episodes:
        return [None] * config.workers
    size = max(1, config.group_size)
    return [size * len(range(w, config.episodes // size, config.workers)) for w in range(config.workers)]


def whole_groups(episodes: int, config: RolloutConfig) -> int:
    """At least so many: a group that was under way when its worker died is played anew."""
    size = max(1, config.group_size)
    return size * math.ceil(episodes / size)


def incarnation_after(incarnation: int, starts: int) -> int:
    """Number of the process that takes a worker's place, such that it meets none of its seeds again.

    Args:
        incarnation: of the one before.
        starts: where that one was in its seeds when it last said so; it may have gone on since.
    """
    return max(incarnation, (starts + STARTS_PER_INCARNATION // 2) // STARTS_PER_INCARNATION) + 1


class EpisodePlans:
    """The episodes of one worker, in order.

    Example:
        >>> plans = EpisodePlans(config, tasks, seed=0, worlds=8)
        >>> runner = RolloutRunner(worlds, lambda: plans.next(exploring=True), ..., groups=plans.groups)
    """

    def __init__(
        self,
        config: RolloutConfig,
        tasks: tuple[str, ...],
        *,
        seed: int,
        worlds: int,
        worker: int = 0,
        incarnation: int = 0,
        budget: int | None = None,
    ) -> None:
        self._budget = budget
        self.groups: Groups | None = None
        if config.group_size:
            self.groups = Groups(config.group_size, worlds, config.group_filter)
        self._seed, self._worker = seed, worker
        self._starts = incarnation * STARTS_PER_INCARNATION
        self._tasks = tasks
        self._start = ("", 0)
        # Filled and emptied on different threads: appending to and popping from a deque is atomic.
        self._queued: deque[EpisodePlan] = deque()

    def queue(self, plans: Iterable[EpisodePlan]) -> None:
        """Plans evaluation episodes."""
        self._queued.extend(plans)

    def next(self, exploring: bool) -> EpisodePlan | None:
        """The episode that a free world is to run; None: it has to wait."""
        if self._queued:
            return self._queued.popleft()
        if not exploring or self.spent:
            return None
        plan = self._explore()
        if plan is not None and self._budget is not None:
            self._budget -= 1
        return plan

    @property
    def starts(self) -> int:
        """Where it is in the worker's seeds."""
        return self._starts

    @property
    def spent(self) -> bool:
        """True if every exploring episode has been handed out."""
        return self._budget is not None and self._budget <= 0

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        return {
            "budget": self._budget,
            "starts": self._starts,
            "start": self._start,
            "queued": list(self._queued),
            "groups": None if self.groups is None else self.groups.state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from what `state` gave."""
        self._budget, self._starts, self._start = state["budget"], state["starts"], state["start"]
        self._queued.extend(state["queued"])
        if self.groups is not None:
            self.groups.restore(state["groups"])

    def _explore(self) -> EpisodePlan | None:
        if self.groups is None:
            task, seed = self._new_start()
            return EpisodePlan(task=task, seed=seed, explore=True)
        place = self.groups.claim()
        if place is None:
            return None
        if place.member == 0:
            self._start = self._new_start()
        task, seed = self._start
        return EpisodePlan(task=task, seed=seed, explore=True, place=place)

    def _new_start(self) -> tuple[str, int]:
        """A task, and a seed that no episode of this worker has had."""
        number, self._starts = self._starts, self._starts + 1
        task = self._tasks[(number + self._worker) % len(self._tasks)]
        return task, train_seed(self._seed, self._worker, number)
