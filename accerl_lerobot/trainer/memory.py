# SPDX-License-Identifier: Apache-2.0
"""Decisions that an off-policy learner draws again and again: a ring of rows, the oldest leave first.

Shapes: B rows, E numbers of the environment state, K executed actions of A dims.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import ENVIRONMENT_STATE, Segment
from accerl_lerobot.policies.teacher import TASK_BITS, task_code

FIRST = 1024
"""Rows that a column has space for at first; doubled when they are full."""


class Memory:
    """Rows of whole episodes; `following` points `n_step` decisions ahead."""

    def __init__(self, capacity: int, gamma: float, n_step: int) -> None:
        self.capacity, self.gamma, self.n_step = capacity, gamma, n_step
        self.total = 0
        """Rows ever added."""
        self._columns: dict[str, np.ndarray] = {}
        self.tasks: list[str] = []

    def __len__(self) -> int:
        return min(self.total, self.capacity)

    def __getitem__(self, name: str) -> np.ndarray:
        """A column, (len, ...).

        ``state`` float32 (E + 16), the environment's, if it offers any, and what stands for the task;
        ``chunk`` float32 (K, A); ``following``, the row `n_step` decisions on; ``reward``, discounted, of
        the decisions before that; ``discount``, of what follows, 0 where the episode ends before;
        ``return``, discounted, of the episode from here on; ``success``, of the episode; ``task``, a place
        in `tasks`; ``observation.*``.
        """
        return self._columns[name][: len(self)]

    def add(self, segment: Segment, chunk: np.ndarray) -> np.ndarray:
        """Adds a whole episode, whose T rows it returns; `chunk`, (T, K, A), was executed, normalised."""
        t = len(segment)
        if segment.origin.decision or not segment.episode or t > self.capacity:
            remedy = f"the memory holds whole episodes of at most algorithm.memory={self.capacity} decisions"
            raise InputError("rollout.segment_length", t, remedy)
        rows = (self.total + np.arange(t)) % self.capacity
        returns = np.zeros(t + 1)
        for i in reversed(range(t)):
            returns[i] = segment.reward[i] + self.gamma * returns[i + 1]
        ahead = np.minimum(self.n_step, t - np.arange(t))
        ends = np.arange(t) + ahead == t
        discount = self.gamma**ahead
        seen = {name: values[:-1] for name, values in segment.observations.items()}
        environment = seen.pop(ENVIRONMENT_STATE, np.empty((t, 0))).reshape(t, -1)
        if segment.task not in self.tasks:
            self.tasks.append(segment.task)
        code = np.broadcast_to(task_code(segment.task), (t, TASK_BITS))
        columns: dict[str, Any] = {
            "state": np.concatenate([environment, code], 1).astype(np.float32),
            "chunk": chunk,
            "reward": (returns[:-1] - discount * returns[np.arange(t) + ahead]).astype(np.float32),
            "discount": np.where(ends, 0.0, discount).astype(np.float32),
            "following": np.where(ends, rows, rows[0] + np.arange(t) + ahead) % self.capacity,
            "return": returns[:-1].astype(np.float32),
            "success": np.full(t, segment.success),
            "task": np.full(t, self.tasks.index(segment.task)),
        }
        self.total += t
        for name, values in (columns | seen).items():
            column = self._columns.get(name, values[:0])
            if len(column) < len(self):
                more = min(max(FIRST, len(self), 2 * len(column)), self.capacity) - len(column)
                column = np.concatenate([column, np.zeros((more, *values.shape[1:]), values.dtype)])
                self._columns[name] = column
            column[rows] = values
        return rows

    def observations(self, rows: np.ndarray) -> tuple[dict[str, np.ndarray], list[str]]:
        """The policy's observations, each (B, ...), and its instructions."""
        seen = {k: v[rows] for k, v in self._columns.items() if k.startswith("observation.")}
        return seen, [self.tasks[i] for i in self._columns["task"][rows]]

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        columns = {name: self[name].copy() for name in self._columns}
        return {"total": self.total, "tasks": list(self.tasks), "columns": columns}

    def restore(self, state: dict[str, Any]) -> None:
        """Resume from `state`."""
        self.total, self.tasks, self._columns = state["total"], list(state["tasks"]), dict(state["columns"])
