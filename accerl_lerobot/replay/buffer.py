# SPDX-License-Identifier: Apache-2.0
"""A bounded store of segments, first in first out, that knows what became of each of them.

    inserted = stored + evicted + retired        in segments and in decisions

*evicted* made room for newer ones, *retired* were older than `max_lag` allows. A non-finite segment is
counted but never inserted. The store survives its process: `state` is all of it, as it was before the batches
that a trainer has drawn and not learnt from.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.experience import REAL, Segment
from accerl_lerobot.replay.journal import Journal
from accerl_lerobot.replay.pacing import ReplayConfig, draws_for

DRAWS = 1024
"""Last draws that are remembered, to be taken back in `Replay.state`: a trainer draws one batch ahead, and
goes on while it is saved."""
BATCH_SHARE = 0.5  # share of a batch that is one, when no more will come


@kind
@dataclass(kw_only=True)
class ReplayCounters:
    """Counters since the run began, resumptions included; unused: never trained on."""

    inserted_segments: int = 0
    inserted_decisions: int = 0
    inserted_imagined: int = 0  # those of the decisions that are imagined
    evicted_segments: int = 0
    evicted_decisions: int = 0
    evicted_unused: int = 0
    retired_segments: int = 0
    retired_decisions: int = 0
    retired_unused: int = 0
    dropped_nonfinite: int = 0  # segments refused because they hold a NaN or an infinity
    trained_decisions: int = 0  # drawn by the trainer, repetitions counted
    trained_imagined: int = 0
    unique_decisions: int = 0  # drawn at least once


@dataclass(eq=False)
class _Entry:
    """A segment, which may be drawn `draws` times in all; once it has `left`, only the books of it."""

    segment: Any
    draws: int
    uses: int = 0
    left: str = ""

    def __post_init__(self) -> None:
        self.size, self.oldest = len(self.segment), int(self.segment.version.min())
        self.imagined = self.segment.source != REAL

    @property
    def available(self) -> bool:
        return self.uses < self.draws


class Replay:
    """Segments in, batches of segments out; no clock, no process, no policy.

    Real segments that are stored are noted in the `journal`.
    """

    def __init__(self, config: ReplayConfig, journal: Journal | None = None) -> None:
        self.config, self.counters = config, ReplayCounters()
        self.ended = False  # True if no segment will come any more
        self._journal = journal
        self.stored_decisions = 0
        self.available_decisions = 0  # decisions of the segments with draws left
        self._entries: deque[_Entry] = deque()  # oldest first
        self._remainder = 0.0
        self._drawn: deque[tuple[int, list[_Entry]]] = deque(maxlen=DRAWS)
        """The trainer's version and what it was given, of each of the last draws."""

    @property
    def segments(self) -> list[Segment]:
        return [entry.segment for entry in self._entries]

    def may_insert(self) -> bool:
        """True if rollouts should bring another segment now; `insert` does not refuse one too many."""
        return self.config.may_insert(self.stored_decisions, self.available_decisions)

    def may_sample(self, batch_decisions: int) -> bool:
        """True if the trainer should draw a batch now; `sample` itself does not wait for the warm start.

        Once all segments have come, few decisions may be less than a batch: then they are one.
        """
        if self.ended:
            return self.available_decisions >= BATCH_SHARE * batch_decisions
        return self.config.may_sample(self.stored_decisions, self.available_decisions, batch_decisions)

    def exhausted(self, batch_decisions: int) -> bool:
        """True if there is no batch and never will be."""
        return self.ended and not self.may_sample(batch_decisions)

    def insert(self, segment: Segment) -> bool:
        """Stores a segment, by reference, and evicts the oldest ones if room is needed.

        A non-finite one is counted and not stored: False.
        """
        n = len(segment)  # at most the capacity, see `ReplayConfig.check`
        if not is_finite(segment):
            self.counters.dropped_nonfinite += 1
            return False
        while self.stored_decisions + n > self.config.capacity:
            self._depart(self._entries.popleft(), "evicted")
        draws, self._remainder = draws_for(self.config.samples_per_insert, n, self._remainder)
        self._add(_Entry(segment, draws))
        self.counters.inserted_segments += 1
        self.counters.inserted_decisions += n
        if segment.source == REAL:
            if self._journal is not None:
                self._journal.write(segment)
        else:
            self.counters.inserted_imagined += n
        return True

    def sample(self, num_decisions: int, trainer_version: int, rng: np.random.Generator) -> list[Segment]:
        """Draws the available segments that were used least, in random order; retires those too old first.

        Whole segments are drawn until there are `num_decisions`, none twice; `rng` decides among those used
        equally often. Empty, with nothing counted as used, if fewer decisions are available. That can happen
        although `may_sample` held, when segments were too old: try again later.
        """
        self.retire(trainer_version)
        if self.ended and self.may_sample(num_decisions):
            num_decisions = min(num_decisions, self.available_decisions)
        if self.available_decisions < num_decisions:
            return []
        available = [entry for entry in self._entries if entry.available]
        shuffled = [available[i] for i in rng.permutation(len(available))]
        drawn: list[_Entry] = []
        for entry in sorted(shuffled, key=lambda entry: entry.uses):
            self.counters.trained_decisions += entry.size
            self.counters.trained_imagined += entry.size if entry.imagined else 0
            self.counters.unique_decisions += 0 if entry.uses else entry.size
            entry.uses += 1
            self.available_decisions -= 0 if entry.available else entry.size
            drawn.append(entry)
            num_decisions -= entry.size
            if num_decisions <= 0:
                break
        self._drawn.append((trainer_version, drawn))
        return [entry.segment for entry in drawn]

    def metrics(self) -> dict[str, float]:
        counts = asdict(self.counters) | {"stored_segments": len(self._entries)}
        counts |= {name: getattr(self, name) for name in ("stored_decisions", "available_decisions")}
        return {name: float(count) for name, count in counts.items()}

    def state(self, version: int | None = None) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`. Shares the segments, which nobody changes.

        What the trainer has drawn for updates after `version` counts as not drawn; None: it has learnt from
        all it drew.
        """
        late = [] if version is None else [entries for made, entries in self._drawn if made >= version]
        if late and len(late) == self._drawn.maxlen:
            raise RuntimeError(f"replay has given more than {DRAWS} batches since update {version}")
        back = Counter(entry for entries in late for entry in entries)
        counters = replace(self.counters)
        for entry, count in back.items():
            counters.trained_decisions -= count * entry.size
            counters.trained_imagined -= count * entry.size if entry.imagined else 0
            if count == entry.uses:
                counters.unique_decisions -= entry.size
                if entry.left:
                    vars(counters)[f"{entry.left}_unused"] += 1
        entries = [{"segment": e.segment, "draws": e.draws, "uses": e.uses - back[e]} for e in self._entries]
        journal = None if self._journal is None else self._journal.save()
        state = {"counters": counters, "entries": entries, "remainder": self._remainder}
        return state | {"ended": self.ended, "journal": journal}

    def restore(self, state: dict[str, Any]) -> None:
        """Resumes from `state`, before the first insert."""
        self.counters, self._remainder = state["counters"], state["remainder"]
        self.ended = state["ended"]
        for entry in state["entries"]:
            self._add(_Entry(**entry))
        if self._journal is not None and state["journal"] is not None:
            self._journal.cut(state["journal"])

    def retire(self, trainer_version: int) -> None:
        """Takes out what is too old for a trainer that has made so many updates."""
        cutoff = trainer_version - self.config.max_lag
        for entry in [entry for entry in self._entries if entry.oldest < cutoff]:
            self._entries.remove(entry)
            self._depart(entry, "retired")

    def _add(self, entry: _Entry) -> None:
        self._entries.append(entry)
        self.stored_decisions += entry.size
        self.available_decisions += entry.size if entry.available else 0

    def _depart(self, entry: _Entry, how: str) -> None:
        entry.segment, entry.left = None, how
        self.stored_decisions -= entry.size
        self.available_decisions -= entry.size if entry.available else 0
        counts = vars(self.counters)
        for name, amount in (("segments", 1), ("decisions", entry.size), ("unused", entry.uses == 0)):
            counts[f"{how}_{name}"] += int(amount)


def is_finite(segment: Segment) -> bool:
    """True if no floating-point number of the segment is a NaN or an infinity."""
    arrays = [segment.log_prob, segment.reward, *segment.latent.values(), *segment.observations.values()]
    return all(bool(np.isfinite(a).all()) for a in arrays if np.issubdtype(a.dtype, np.inexact))
