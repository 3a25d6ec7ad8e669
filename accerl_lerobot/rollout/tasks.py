# SPDX-License-Identifier: Apache-2.0
"""Which task an exploring episode is about.

    uniform    each in turn
    failures   p(task) ∝ 1 + failures among its last `window` exploring episodes

The second is the dynamic weighted resampling of AcceRL, arXiv 2603.18464: a task that always succeeds is
still explored now and then, and what the policy forgets counts again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

TaskSampling = Literal["uniform", "failures"]


class TaskSampler:
    """The tasks of one rollout worker's exploring episodes, the same for equal seeds and reports.

    Example:
        >>> sampler = TaskSampler(("door-open-v3", "drawer-open-v3"), "failures", window=100, seed=(0, 0, 0))
        >>> task = sampler.next()
        >>> sampler.report(task, success=False)

    Args:
        tasks: names, each once.
        sampling: see the top of this file.
        window: episodes of each task that are remembered.
        seed: of the draws.
        first: which task is the first in turn, counted on beyond the last.
    """

    def __init__(
        self, tasks: Sequence[str], sampling: TaskSampling, window: int, seed: Sequence[int], first: int = 0
    ) -> None:
        self._tasks, self._turn = tuple(tasks), first
        self._sampling: TaskSampling = sampling
        self._rng = np.random.default_rng(list(seed))
        self._failed: dict[str, deque[bool]] = {task: deque(maxlen=window) for task in tasks}

    def probabilities(self) -> np.ndarray:
        """float64 (tasks,), what `failures` draws the next task by."""
        weights = np.array([1 + sum(self._failed[task]) for task in self._tasks], np.float64)
        return np.asarray(weights / weights.sum())

    def next(self) -> str:
        """The task of the next episode, or of the next group of episodes."""
        if self._sampling == "uniform":
            self._turn += 1
            return self._tasks[(self._turn - 1) % len(self._tasks)]
        return self._tasks[int(self._rng.choice(len(self._tasks), p=self.probabilities()))]

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        failed = {task: list(recent) for task, recent in self._failed.items()}
        return {"turn": self._turn, "rng": self._rng, "failed": failed}

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from what `state` gave."""
        self._turn, self._rng = state["turn"], state["rng"]
        for task, recent in state["failed"].items():
            self._failed[task].extend(recent)

    def report(self, task: str, success: bool) -> None:
        """Counts one finished exploring episode."""
        self._failed[task].append(not success)
