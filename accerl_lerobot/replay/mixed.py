# SPDX-License-Identifier: Apache-2.0
"""Real and imagined experience side by side, each with its own size and pace.

A batch takes its imagined share from one store and the rest from the other, and is drawn only when both can
give. Two things end that:

* the real episodes that were paid for have all been collected (`end_real`): from then on a batch takes what
  draws they have left, and imagined ones for the rest;
* nothing is imagined, yet or any more (`share` is 0): a batch is real. But where real episodes are counted,
  they are not used up while a world model is learnt that is to imagine from them: as long as there is room
  for more of them, they are let in and there is no batch.

When neither can give, and neither ever will, the replay is *exhausted*.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from accerl_lerobot.experience import REAL, Segment
from accerl_lerobot.replay.buffer import Replay
from accerl_lerobot.replay.journal import Journal
from accerl_lerobot.replay.pacing import ReplayConfig

LEAST = 0.5
"""Share of a batch that is one, when no more will come."""
ROOM = 0.9
"""Share of the real store up to which it is filled without anything being drawn."""


class MixedReplay:
    """Segments in, batches of segments out.

    Args:
        real: size and pace of real experience.
        imagined: of imagined experience.
        share: of a batch's decisions, in [0, 1), that are imagined.
        patient: whether real episodes are counted.
        journal: where real segments that are stored are noted; None: nowhere.
    """

    def __init__(
        self,
        real: ReplayConfig,
        imagined: ReplayConfig,
        share: float,
        patient: bool = False,
        journal: Journal | None = None,
    ) -> None:
        self._patient, self._journal = patient, journal
        self.real, self.imagined, self.share = Replay(real), Replay(imagined), share
        self.real_ended = False
        self.awaited = share > 0
        """True if anything may be imagined later on, although nothing is now."""
        self.held = False
        """True if real episodes, if they are counted, are to wait."""

    def may_insert(self, source: str = REAL) -> bool:
        """True if another segment of this source should be brought now."""
        if source == REAL and self.held and self._patient:
            return False
        return self._of(source).may_insert() or (source == REAL and self._waits)

    def insert(self, segment: Segment) -> bool:
        """See `Replay.insert`."""
        stored = self._of(segment.source).insert(segment)
        if stored and segment.source == REAL and self._journal is not None:
            self._journal.write(segment)
        return stored

    def end_real(self) -> None:
        """No real segment will come any more."""
        self.real_ended = True

    def may_sample(self, batch_decisions: int) -> bool:
        """True if a batch should be drawn now."""
        return self._parts(batch_decisions) is not None

    def exhausted(self, batch_decisions: int) -> bool:
        """True if there is no batch and never will be."""
        hopeless = self.real_ended and not self.share and not self.awaited
        return hopeless and not self.may_sample(batch_decisions)

    def mix(self, share: float, awaited: bool) -> None:
        """From now on, so much of a batch is imagined; `awaited`: or may be later on."""
        self.share, self.awaited = share, awaited

    def hold(self, held: bool) -> None:
        """From now on real episodes are to wait, or not: what is here is to be learnt from first."""
        self.held = held

    def sample(self, num_decisions: int, trainer_version: int, rng: np.random.Generator) -> list[Segment]:
        """See `Replay.sample`: empty, with nothing counted as used, if a part cannot be had."""
        self.real.retire(trainer_version)
        self.imagined.retire(trainer_version)
        parts = self._parts(num_decisions)
        if parts is None:
            return []
        drawn: list[Segment] = []
        for replay, count in zip((self.real, self.imagined), parts, strict=True):
            drawn += replay.sample(count, trainer_version, rng) if count else []
        return drawn

    def state(self, version: int | None = None) -> dict[str, Any]:
        """See `Replay.state`."""
        return {
            "real": self.real.state(version),
            "imagined": self.imagined.state(version),
            "share": self.share,
            "real_ended": self.real_ended,
            "awaited": self.awaited,
            "held": self.held,
            "journal": None if self._journal is None else self._journal.save(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """See `Replay.restore`."""
        self.real.restore(state["real"])
        self.imagined.restore(state["imagined"])
        for name in ("share", "real_ended", "awaited", "held"):
            setattr(self, name, state[name])
        if self._journal is not None and state["journal"] is not None:
            self._journal.cut(state["journal"])

    def metrics(self) -> dict[str, float]:
        """Metrics of the real store by their names; where anything is imagined, of the other one with
        ``imagined_`` before them, and its share.
        """
        if not (self.share or self.awaited or self.imagined.counters.inserted_segments):
            return self.real.metrics()
        imagined = {f"imagined_{k}": v for k, v in self.imagined.metrics().items()}
        return self.real.metrics() | imagined | {"imagined_share": self.share}

    @property
    def _waits(self) -> bool:
        room = self.real.stored_decisions < ROOM * self.real.config.capacity
        return self._patient and self.awaited and not self.share and room

    def _of(self, source: str) -> Replay:
        return self.real if source == REAL else self.imagined

    def _parts(self, batch: int) -> tuple[int, int] | None:
        """Decisions to draw from either store; None if one of them cannot give its part."""
        if self._waits:
            return None
        real = batch - round(self.share * batch)
        if self.real_ended:
            left = self.real.pace.available
            if not self.share:
                # Few episodes may be less than a batch: then they are one.
                return (min(batch, left), 0) if left >= LEAST * batch else None
            real = min(real, left)
        elif real and not self.real.may_sample(real):
            return None
        imagined = batch - real
        if imagined and not self.imagined.may_sample(imagined):
            return None
        return real, imagined
