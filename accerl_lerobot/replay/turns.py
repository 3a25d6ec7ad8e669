# SPDX-License-Identifier: Apache-2.0
"""Whose turn it is: collecting and learning in turns, side by side in step, or each on its own.

    asynchronous   nobody waits for anybody, within the pace (`pacing`)
    overlap        the next batch is collected while one is learned from, and then both wait for each other
    synchronous    a batch is collected, then learned from, then the weights are handed over

The last two are what asynchrony is measured against: the same workers, held back. All worlds are decided for
together in them, as by a vectorised environment, so a step takes as long as its slowest world. An inference
service that is lost while it has answered some of them leaves these a decision ahead: from then on some
decisions are an update older than the schedule alone would have them.
"""

from __future__ import annotations

from typing import Literal

Schedule = Literal["asynchronous", "overlap", "synchronous"]
ASYNCHRONOUS: Schedule = "asynchronous"
OVERLAP: Schedule = "overlap"
SYNCHRONOUS: Schedule = "synchronous"


class Turns:
    """Order in which rollouts and the trainer may go on.

    Nobody is kept for ever, as long as the trainer lives: where collecting may not go on, a batch is ready or
    learned from, and each is followed by an update; where no batch may be drawn, one is learned from.
    """

    def __init__(self, schedule: Schedule = ASYNCHRONOUS) -> None:
        self.schedule: Schedule = schedule
        self._drawn = self._learnt = 0

    def may_collect(self, ready: bool) -> bool:
        """True if who has brought a segment may go on.

        Args:
            ready: whether the pace would let a batch be drawn now.
        """
        if self.schedule == SYNCHRONOUS:
            return not (ready or self._learning)
        return self.schedule == ASYNCHRONOUS or not (ready and self._learning)

    def may_draw(self) -> bool:
        """True if the trainer may have its next batch."""
        return self.schedule == ASYNCHRONOUS or not self._learning

    def drawn(self) -> None:
        """The trainer has another batch."""
        self._drawn += 1

    def learnt(self) -> None:
        """It has learned from one, and in turn every reader has the weights."""
        self._learnt += 1

    @property
    def _learning(self) -> bool:
        return self._drawn > self._learnt
