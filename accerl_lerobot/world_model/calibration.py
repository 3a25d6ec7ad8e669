# SPDX-License-Identifier: Apache-2.0
"""A success threshold by which dreams of the policy end in a success as often as what it lives through.

Set on dreams with the actions that were made, a threshold is too low for a policy that looks at what is
dreamt and acts on it. How much too low can be measured where a dream begins at the beginning of a real
episode: the policy has played that one, and how it ended is known.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from accerl_lerobot.world_model.agreement import even_threshold

LEAST = 0.5


class Calibration:
    """Collects dreams that nothing is learnt from, until there are enough.

    Args:
        dreams: how many; 0: none are wanted.
        ended: real episodes that must have ended before, as those that end first succeed.
    """

    def __init__(self, dreams: int, ended: int = 1) -> None:
        self._wanted, self._ended, self._real_ended = dreams, ended, False
        self._pairs: list[tuple[bool, float]] = []
        self._done = dreams == 0
        self.threshold: float | None = None
        """Threshold that was found; None: nothing yet, or nothing at all."""

    def end_real(self) -> None:
        """No real episode will come any more; of those that were counted, some may have been lost."""
        self._real_ended = True

    def wants(self, told: bool) -> bool:
        """True if dreams are wanted: not where no real episode has ended, or ever will.

        Args:
            told: whether there is the beginning of one that has.
        """
        return not self._done and (told or not self._real_ended)

    def waits(self, ended: int, told: bool) -> bool:
        """True if dreams are wanted, and must not begin yet.

        Args:
            ended: real episodes that have.
            told: see `wants`.
        """
        return self.wants(told) and not (told and (self._real_ended or ended >= self._ended))

    def add(self, achieved: bool, highest: float) -> None:
        """Takes a dream: how the episode ended that it begins with, and the highest P(success) in it."""
        self._pairs.append((achieved, highest))

    def complete(self) -> bool:
        """Sets the threshold, at least `LEAST`, once there are enough dreams; whether there are.

        Where all episodes ended alike there is none that could be told from them.
        """
        if self._done or len(self._pairs) < self._wanted:
            return False
        real, said = (np.array(column)[None] for column in zip(*self._pairs, strict=True))
        self.threshold = max(LEAST, even_threshold(real, said)) if real.any() and not real.all() else None
        self._done = True
        return True

    def reset(self) -> None:
        """Another model dreams."""
        self._pairs, self.threshold, self._done = [], None, self._wanted == 0

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        return {"pairs": list(self._pairs), "threshold": self.threshold, "done": self._done}

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from what `state` gave."""
        self._pairs = [tuple(pair) for pair in state["pairs"]]
        self.threshold, self._done = state["threshold"], state["done"]
