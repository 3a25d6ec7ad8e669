# SPDX-License-Identifier: Apache-2.0
"""Guard that compares dreams with reality: the kill switch.

Each real outcome is held against the share of dreams that succeed when it is told. Of a real episode that has
just ended, both are of nearly the same policy, and one that has learnt is not taken for a world model that
flatters; the outcome of the episode that a dream began in may be older.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

from accerl_lerobot.checkpoint.snapshot import kind


@kind
@dataclass
class DreamCounters:
    """Counters of dreams so far."""

    dreams: int = 0
    """That have ended."""
    decisions: int = 0
    successes: int = 0
    doubted: int = 0
    """Dreams that ended before something too uncertain."""


class KillSwitch:
    """Says when dreams succeed too much more often than reality.

    Args:
        gap: largest difference of the two shares of successes.
        window: dreams over which theirs is taken; before there are so many, nothing is said.
        outcomes: real ones, over which the difference is taken; nor is it before there are so many.
    """

    def __init__(self, gap: float, window: int, outcomes: int) -> None:
        self.gap, self.tripped = gap, False
        self._dreams: deque[bool] = deque(maxlen=window)
        self._pairs: deque[tuple[float, bool]] = deque(maxlen=outcomes)
        # Kept as numbers: they are also read on another thread.
        self._share = self._imagined = self._real = float("nan")

    def dreamt(self, success: bool) -> None:
        """Takes note of how a dream has ended."""
        self._dreams.append(success)
        self._share = sum(self._dreams) / len(self._dreams)

    def lived(self, success: bool) -> None:
        """Takes note of a real outcome; one that no dreams stand beside is not counted."""
        if len(self._dreams) < (self._dreams.maxlen or 0):
            return
        self._pairs.append((self._share, success))
        count = len(self._pairs)
        self._imagined = sum(share for share, _ in self._pairs) / count
        self._real = sum(real for _, real in self._pairs) / count
        if count == self._pairs.maxlen and self._imagined - self._real > self.gap:
            self.tripped = True

    def reset(self) -> None:
        """Another world model dreams now; what the last one promised counts on, unless that was too much."""
        self._dreams.clear()
        self._share = float("nan")
        if self.tripped:
            self._pairs.clear()
            self._imagined = self._real = float("nan")
        self.tripped = False

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        shown = (self._share, self._imagined, self._real, self.tripped)
        return {"dreams": list(self._dreams), "pairs": list(self._pairs), "shown": shown}

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from what `state` gave."""
        self._dreams.extend(state["dreams"])
        self._pairs.extend(state["pairs"])
        self._share, self._imagined, self._real, self.tripped = state["shown"]

    @property
    def share(self) -> float:
        """Share of successes among the newest dreams; NaN before there are any."""
        return self._share

    @property
    def shares(self) -> tuple[float, float]:
        """Shares of successes, imagined and real, at the same times; NaN before there are any."""
        return self._imagined, self._real
