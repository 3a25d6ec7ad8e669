# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""A bounded store of segments, first in first out, that knows what became of each of them.

What must hold, in segments and in decisions:

    inserted = stored + evicted + retired + lost

*evicted* made room for newer ones, *retired* were older than `max_lag` allows, *lost* were held when a
checkpoint was written (counters are saved, segments are not). A duplicate or a non-finite segment is
counted but never inserted.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Segment
from accerl_lerobot.replay import pacing
from accerl_lerobot.replay.pacing import Pace, ReplayConfig

KEY_MEMORY = 65_536
"""How many keys are remembered to recognise a segment that is sent twice, even after it has left the store.

A worker repeats an insert within seconds, thousands of segments at most; remembering all keys would grow
without end.
"""


@dataclass(kw_only=True)
class ReplayCounters:
    """What happened since the run began, resumptions included; in decisions where the name says so."""

    inserted_segments: int = 0
    inserted_decisions: int = 0
    evicted_segments: int = 0
    evicted_decisions: int = 0
    evicted_unused: int = 0
    """Segments evicted before they were ever trained on."""
    retired_segments: int = 0
    retired_decisions: int = 0
    retired_unused: int = 0
    """Segments retired before they were ever trained on."""
    lost_segments: int = 0
    lost_decisions: int = 0
    lost_unused: int = 0
    """Segments lost in a resumption before they were ever trained on."""
    duplicates: int = 0
    """Segments ignored because their key had been seen."""
    dropped_nonfinite: int = 0
    """Segments refused because they hold a NaN or an infinity."""
    trained_decisions: int = 0
    """Drawn by the trainer, repetitions counted."""
    unique_decisions: int = 0
    """Drawn at least once."""
    unspent_draws: int = 0
    """Draws that left with their segments, in decisions: what pacing failed to use."""
    departed_uses: dict[int, int] = field(default_factory=dict)
    """Of the segments that left: times trained on → segments."""


@dataclass(kw_only=True)
class _Entry:
    segment: Segment
    oldest: int
    """The smallest version."""
    draws: int
    """How often it may be drawn in all."""
    uses: int = 0

    @property
    def unspent(self) -> int:
        """Draws left, in decisions."""
        return (self.draws - self.uses) * len(self.segment)


class Replay:
    """Segments in, batches of segments out; no clock, no process, no policy.

    Example:
        >>> replay = Replay(ReplayConfig(capacity=4096, min_decisions=256, samples_per_insert=2.0))
        >>> if replay.may_insert():
        ...     replay.insert(segment)  # again with the same key: ignored
        >>> if replay.may_sample(256):
        ...     segments = replay.sample(256, trainer_version=17, rng=np.random.default_rng(0))
    """

    def __init__(self, config: ReplayConfig) -> None:
        self.config = config
        self.counters = ReplayCounters()
        self._entries: OrderedDict[str, _Entry] = OrderedDict()  # oldest first
        self._keys: OrderedDict[str, None] = OrderedDict()
        self._stored = 0
        self._available = 0
        self._carry = 0.0

    @property
    def stored_decisions(self) -> int:
        return self._stored

    @property
    def stored_segments(self) -> int:
        return len(self._entries)

    @property
    def pace(self) -> Pace:
        """What the predicates of `pacing` look at."""
        return Pace(stored=self._stored, available=self._available)

    def may_insert(self) -> bool:
        """Whether rollouts should bring another segment now; `insert` does not refuse one too many."""
        return pacing.may_insert(self.config, self.pace)

    def may_sample(self, batch_decisions: int) -> bool:
        """Whether the trainer should draw a batch now; `sample` itself does not wait for the warm start."""
        return pacing.may_sample(self.config, self.pace, batch_decisions)

    def insert(self, segment: Segment) -> bool:
        """Stores a segment and evicts the oldest ones if room is needed.

        Args:
            segment: kept by reference; the caller must not change it any more.

        Returns:
            Whether it was stored: False for a key seen before and for a non-finite segment, which are
            counted.

        Raises:
            InputError: the segment alone is longer than the capacity.
        """
        n = len(segment)
        if n > self.config.capacity:
            raise InputError("replay.capacity", self.config.capacity, f"use at least {n}, a segment's length")
        if segment.key in self._keys or segment.key in self._entries:
            self.counters.duplicates += 1
            return False
        if not is_finite(segment):
            self.counters.dropped_nonfinite += 1
            return False
        self._keys[segment.key] = None
        if len(self._keys) > KEY_MEMORY:
            self._keys.popitem(last=False)
        while self._stored + n > self.config.capacity:
            self._depart(next(iter(self._entries)), "evicted")
        draws, self._carry = pacing.entitle(self.config.samples_per_insert, n, self._carry)
        self._entries[segment.key] = _Entry(segment=segment, oldest=int(segment.version.min()), draws=draws)
        self._stored += n
        self._available += n
        self.counters.inserted_segments += 1
        self.counters.inserted_decisions += n
        return True

    def sample(self, num_decisions: int, trainer_version: int, rng: np.random.Generator) -> list[Segment]:
        """Draws the available segments that were used least, in random order; retires those too old first.

        A segment that has been drawn as often as its share of ``samples_per_insert`` allows stays in the
        store, but is not available any more.

        Args:
            num_decisions: how many decisions are wanted; whole segments are drawn until there are at least
                that many.
            trainer_version: updates made so far. No segment with a decision more than ``max_lag`` behind is
                drawn.
            rng: decides among segments used equally often.

        Returns:
            The segments, none twice; empty, with nothing counted as used, if fewer decisions are available.
            That can happen although `may_sample` held, when segments were too old: try again later.

        Raises:
            ValueError: `num_decisions` is below 1.
        """
        if num_decisions < 1:
            raise ValueError(f"sample of {num_decisions} decisions: ask for at least 1")
        self.retire(trainer_version)
        if self._available < num_decisions:
            return []
        available = [e for e in self._entries.values() if e.unspent]
        shuffled = [available[i] for i in rng.permutation(len(available))]
        drawn: list[Segment] = []
        collected = 0
        for entry in sorted(shuffled, key=lambda e: e.uses):
            self._use(entry)
            drawn.append(entry.segment)
            collected += len(entry.segment)
            if collected >= num_decisions:
                break
        return drawn

    def uses_histogram(self) -> dict[int, int]:
        """Times trained on → segments, over all ever inserted, ascending."""
        counts = dict(self.counters.departed_uses)
        for entry in self._entries.values():
            counts[entry.uses] = counts.get(entry.uses, 0) + 1
        return dict(sorted(counts.items()))

    def metrics(self) -> dict[str, float]:
        """Everything worth logging, by name."""
        flat = {k: float(v) for k, v in asdict(self.counters).items() if k != "departed_uses"}
        flat["stored_segments"], flat["stored_decisions"] = float(self.stored_segments), float(self._stored)
        flat["available_decisions"] = float(self._available)
        return flat

    def state(self) -> dict[str, Any]:
        """The counters as a resumption will find them: what is held now counts as lost. Plain JSON types."""
        shadow = Replay(self.config)
        shadow.counters = ReplayCounters(**asdict(self.counters))
        shadow._entries = self._entries.copy()
        for key in self._entries:
            shadow._depart(key, "lost")
        uses = {str(k): v for k, v in shadow.uses_histogram().items()}
        return {**asdict(shadow.counters), "departed_uses": uses}

    def restore(self, state: dict[str, Any]) -> None:
        """Continues the counters of an earlier run.

        Args:
            state: from `state`, possibly by way of a JSON file.

        Raises:
            RuntimeError: something has been inserted already.
        """
        if self.counters != ReplayCounters():
            raise RuntimeError("restore before the first insert")
        uses = {int(k): int(v) for k, v in state["departed_uses"].items()}
        self.counters = ReplayCounters(**{**state, "departed_uses": uses})

    def retire(self, trainer_version: int) -> None:
        """Takes out what is too old for a trainer that has made so many updates."""
        cutoff = trainer_version - self.config.max_lag
        for key in [k for k, e in self._entries.items() if e.oldest < cutoff]:
            self._depart(key, "retired")

    def _use(self, entry: _Entry) -> None:
        n = len(entry.segment)
        self.counters.trained_decisions += n
        self.counters.unique_decisions += n if entry.uses == 0 else 0
        entry.uses += 1
        if not entry.unspent:
            self._available -= n

    def _depart(self, key: str, how: str) -> None:
        """Takes a segment out and books it under ``<how>_*``."""
        entry = self._entries.pop(key)
        n, counters = len(entry.segment), self.counters
        self._stored -= n
        self._available -= n if entry.unspent else 0
        for name, amount in (("segments", 1), ("decisions", n), ("unused", int(entry.uses == 0))):
            setattr(counters, f"{how}_{name}", getattr(counters, f"{how}_{name}") + amount)
        counters.unspent_draws += entry.unspent
        counters.departed_uses[entry.uses] = counters.departed_uses.get(entry.uses, 0) + 1


def is_finite(segment: Segment) -> bool:
    """Whether no floating-point number of the segment is a NaN or an infinity."""
    arrays = [segment.log_prob, segment.value, segment.reward, *segment.latent.values()]
    arrays += segment.observations.values()
    arrays += [] if segment.advantage is None else [segment.advantage]
    return all(bool(np.isfinite(a).all()) for a in arrays if np.issubdtype(a.dtype, np.inexact))
