# SPDX-License-Identifier: Apache-2.0
"""Staleness on purpose: weights that are published some updates after they were made.

For studies of what lag does to an algorithm. All else stays as it is, so two runs that differ in
`trainer.hold_back` differ in lag alone.
"""

from __future__ import annotations

from collections import deque

from accerl_lerobot.weights.channel import Tensors


class HeldBack:
    """Keeps weights back until they are old enough; holds as many copies as it keeps back.

    Args:
        updates: how old weights are when they are handed on; 0 hands on at once.
    """

    def __init__(self, updates: int) -> None:
        self.updates = updates
        self._waiting: deque[tuple[int, Tensors]] = deque()

    def push(self, version: int, tensors: Tensors, *, last: bool = False) -> list[tuple[int, Tensors]]:
        """Takes the weights of now and gives those that are due, oldest first; version 0 is always due.

        Args:
            version: updates behind `tensors`, which must not change afterwards.
            tensors: by name.
            last: no update follows, so that nothing is held back any more.
        """
        self._waiting.append((version, tensors))
        due = []
        while self._waiting and (last or self._waiting[0][0] <= max(0, version - self.updates)):
            due.append(self._waiting.popleft())
        return due[-1:] if last else due

    def state(self) -> list[tuple[int, Tensors]]:
        """All that `restore` needs; see `snapshot`."""
        return list(self._waiting)

    def restore(self, state: list[tuple[int, Tensors]]) -> None:
        """Goes on from what `state` gave."""
        self._waiting.extend(state)
