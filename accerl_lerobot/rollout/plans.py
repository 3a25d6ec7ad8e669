# SPDX-License-Identifier: Apache-2.0
"""Which episode a free world runs next: planned evaluations first, then exploring ones.

An exploring episode is a task, each in turn, and a seed of this worker's own (`seeds.py`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any

from accerl_lerobot.rollout.runner import EpisodePlan, RolloutConfig
from accerl_lerobot.seeds import train_seed

STARTS_PER_INCARNATION = 1000
"""By how much a restarted worker skips ahead in its training seeds, so as not to repeat its episodes."""


def budgets(config: RolloutConfig) -> list[int | None]:
    """How many exploring episodes each worker plays; None: no end."""
    if not config.episodes:
        return [None] * config.workers
    return [len(range(w, config.episodes, config.workers)) for w in range(config.workers)]


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
        >>> plans = EpisodePlans(tasks, seed=0)
        >>> runner = RolloutRunner(worlds, lambda: plans.next(exploring=True), ...)
    """

    def __init__(
        self,
        tasks: tuple[str, ...],
        *,
        seed: int,
        worker: int = 0,
        incarnation: int = 0,
        budget: int | None = None,
    ) -> None:
        self._budget = budget
        self._seed, self._worker = seed, worker
        self._starts = incarnation * STARTS_PER_INCARNATION
        self._tasks = tasks
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
        if self._budget is not None:
            self._budget -= 1
        number, self._starts = self._starts, self._starts + 1
        task = self._tasks[(number + self._worker) % len(self._tasks)]
        return EpisodePlan(task=task, seed=train_seed(self._seed, self._worker, number), explore=True)

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
        return {"budget": self._budget, "starts": self._starts, "queued": list(self._queued)}

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from what `state` gave."""
        self._budget, self._starts = state["budget"], state["starts"]
        self._queued.extend(state["queued"])
