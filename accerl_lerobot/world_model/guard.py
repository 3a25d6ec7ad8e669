# SPDX-License-Identifier: Apache-2.0
"""Counters of imagined rollouts, and the kill switch that compares them with reality. Free of torch.

Each real outcome is compared with the success rate of imagined rollouts at that time. As both are of nearly
the same policy, a policy that improves does not trip the switch.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

from accerl_lerobot.checkpoint.snapshot import kind

IMAGINATION = "imagination"
"""Name of the worker that imagines, and of its state."""
WORLD_LEARNING = "world learning"
"""Name of the worker that trains the world model."""


@kind
@dataclass
class ImaginationCounters:
    """Counters of imagined rollouts so far."""

    rollouts: int = 0
    """Ended rollouts."""
    decisions: int = 0
    successes: int = 0
    uncertain: int = 0
    """Rollouts that ended before a prediction that was too uncertain."""


class KillSwitch:
    """Trips when imagined rollouts succeed too much more often than real episodes.

    Args:
        max_gap: largest difference of the two success rates.
        window: imagined rollouts over which their rate is taken; until it is full, nothing is compared.
        outcomes: real outcomes over which the difference is taken; the same holds for them.
    """

    def __init__(self, max_gap: float, window: int, outcomes: int) -> None:
        self.max_gap, self.tripped = max_gap, False
        self._rollouts: deque[bool] = deque(maxlen=window)
        self._pairs: deque[tuple[float, bool]] = deque(maxlen=outcomes)
        # Kept as numbers, as they are read on another thread too.
        self._share = self._imagined = self._real = float("nan")

    def add_imagined(self, success: bool) -> None:
        """Takes the outcome of an imagined rollout."""
        self._rollouts.append(success)
        self._share = sum(self._rollouts) / len(self._rollouts)

    def add_real(self, success: bool) -> None:
        """Takes a real outcome; it does not count before the window is full."""
        if len(self._rollouts) < (self._rollouts.maxlen or 0):
            return
        self._pairs.append((self._share, success))
        count = len(self._pairs)
        self._imagined = sum(share for share, _ in self._pairs) / count
        self._real = sum(real for _, real in self._pairs) / count
        if count == self._pairs.maxlen and self._imagined - self._real > self.max_gap:
            self.tripped = True

    def reset(self) -> None:
        """Starts again for another world model; unless it has tripped, pairs of the last one still count."""
        self._rollouts.clear()
        self._share = float("nan")
        if self.tripped:
            self._pairs.clear()
            self._imagined = self._real = float("nan")
        self.tripped = False

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        shares = (self._share, self._imagined, self._real, self.tripped)
        return {"rollouts": list(self._rollouts), "pairs": list(self._pairs), "shares": shares}

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from a `state`."""
        self._rollouts.extend(state["rollouts"])
        self._pairs.extend(state["pairs"])
        self._share, self._imagined, self._real, self.tripped = state["shares"]

    @property
    def share(self) -> float:
        """Success rate of the newest imagined rollouts; NaN before there are any."""
        return self._share

    @property
    def shares(self) -> tuple[float, float]:
        """Success rates, imagined and real, at the same times; NaN before there are any."""
        return self._imagined, self._real
