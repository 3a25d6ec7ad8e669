# SPDX-License-Identifier: Apache-2.0
"""A bounded store of segments, and the pace at which it is filled and drawn from.

    inserted = stored + removed        in segments and in decisions

Removed segments are *evicted* or *retired*: they made room for newer ones, or were older than `max_lag`
allows. A non-finite segment is counted and not inserted.

The pace is counted in decisions. On entering the store each segment gets a number of draws (`draws_for`). A
segment with draws left is *available*. With batch ≤ max_unlearned_decisions, one of `may_sample` and
`may_insert` holds at any time. Rollouts wait on insert instead of having their segments thrown away later:
the oldest segments are thrown away first, and those are of the longest episodes, which failed.

    asynchronous   collecting and learning do not wait for each other, within the pace
    overlap        the next batch is collected while one is learned from, and then both wait for each other
    synchronous    a batch is collected, then learned from, then the weights are handed over

The last two schedules are baselines: the same workers, held back. All environments are decided for together
in them, as by a vectorised environment, so a step takes as long as its slowest environment.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np

from accerl_lerobot.checkpoint.snapshot import State, kind
from accerl_lerobot.config.ranges import Range, Section, Steps
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import REAL, Metrics, Segment, nonfinite
from accerl_lerobot.replay.journal import Journal

REMEMBERED_BATCHES = 1024
"""For `Replay.state`: a trainer draws one batch ahead, and goes on while it is saved."""
BATCH_SHARE = 0.5  # the smallest last batch, as a share of a full one; a smaller rest is not learned from

Schedule = Literal["asynchronous", "overlap", "synchronous"]
ASYNCHRONOUS: Schedule = "asynchronous"
OVERLAP: Schedule = "overlap"
SYNCHRONOUS: Schedule = "synchronous"


@dataclass(frozen=True, kw_only=True)
class ReplayConfig(Section, section="replay"):
    """Size and pace of one replay."""

    capacity: Annotated[int, Range("[1, 100000000]")] = 4096
    """Decisions held at most, those without draws left too; the oldest segments leave first. At least
    `max_unlearned_decisions` plus one segment."""
    min_decisions: Annotated[int, Range("[1, 100000000]")] = 256
    """The trainer waits while fewer decisions are held: at the start, and if many were retired. From 1 to
    `capacity`."""
    samples_per_insert: Annotated[float, Range("[1, 1000000]")] = 1.0
    """How often a decision is trained on, on average: collect less rather than throw away."""
    max_lag: Steps = 50
    """A segment is retired once its oldest decision has a lag of more updates than this, at least 0.

    A safety net: choose the pace so that `lag_bound` stays below it, and nothing is thrown away. What an
    off-policy algorithm keeps in a memory of its own may be older.
    """
    max_unlearned_decisions: Annotated[int, Range("[1, 100000000]")] = 512
    """Rollouts wait while at least so many stored decisions have draws left; from one batch to `capacity`.
    Where environments end their segments together, room for all of them keeps both sides busy. It costs
    lag."""

    @property
    def most_available(self) -> int:
        """Available decisions from which on rollouts wait."""
        return max(self.max_unlearned_decisions, self.min_decisions)

    def check(self, *, batch_decisions: int, segment_decisions: int) -> None:
        """Refuses a pace that could stall or waste."""
        if self.max_unlearned_decisions < batch_decisions:
            hint = f"use at least one batch, {batch_decisions}, or both sides wait for each other"
            raise InputError("replay.max_unlearned_decisions", self.max_unlearned_decisions, hint)
        # Each of a segment's draws is for another update.
        least_age = math.ceil(self.samples_per_insert) - 1
        if self.max_lag < least_age:
            hint = (
                f"with replay.samples_per_insert={self.samples_per_insert:g} what is drawn last is "
                f"{least_age} updates old at least; use {least_age} or more, rather several times as many"
            )
            raise InputError("replay.max_lag", self.max_lag, hint)
        least = self.most_available + segment_decisions - 1
        if self.capacity < least:
            hint = f"use at least {least}: min_decisions or max_unlearned_decisions, and a segment"
            raise InputError("replay.capacity", self.capacity, hint)


def lag_bound(
    config: ReplayConfig, *, batch_decisions: int, in_flight: int, pickup: int = 0, prefetch: int = 0
) -> int:
    """The largest lag of a decision that is drawn from replay, in updates, for people to read.

    `max_lag` is enforced, by `Replay.retire`. The rest follows from the pace, as far as workers keep up.

        lag ≤ min(max_lag, pickup + drawn + prefetch)
        drawn = ⌊⌈samples_per_insert⌉ · (max(max_unlearned_decisions, min_decisions) + 2·in_flight +
        capacity) / batch⌋ − 1

    Between a segment's first decision and its being drawn, each update has drawn a batch out of what was
    available at first, at most max(max_unlearned_decisions, min_decisions) + in_flight, and of what was
    inserted since: in_flight until the segment itself was in, and capacity after that, or it would have been
    evicted. The weights that decided were `pickup` updates old at most, and `prefetch` batches are drawn
    early.

    `in_flight` decisions are inserted by all workers while a segment is made and inserted, one segment of
    each environment if these are about equally fast. One that hangs breaks this; `max_lag` then retires it.
    """
    decisions = config.most_available + 2 * in_flight + config.capacity
    drawn = math.ceil(config.samples_per_insert) * decisions // batch_decisions - 1
    return min(config.max_lag, pickup + drawn + prefetch)


def draws_for(samples_per_insert: float, n: int, remainder: float) -> tuple[int, float]:
    """How often a new segment of n decisions may be drawn, such that the average is `samples_per_insert`.

    `remainder` is the draws, in decisions, that rounding has withheld so far; the new one is returned too.
    """
    remainder += samples_per_insert * n
    draws = min(math.floor(remainder / n), math.ceil(samples_per_insert))
    return draws, remainder - draws * n


@kind
@dataclass(kw_only=True)
class ReplayCounters:
    """Counters since the run began, resumptions included; unused: never trained on."""

    inserted_segments: int = 0
    inserted_decisions: int = 0
    inserted_imagined: int = 0  # the imagined ones of these decisions
    removed_segments: int = 0
    removed_decisions: int = 0
    evicted_unused: int = 0
    retired_unused: int = 0
    dropped_nonfinite: int = 0  # segments refused because they hold a NaN or an infinity
    trained_decisions: int = 0  # drawn by the trainer, repetitions counted
    trained_imagined: int = 0
    unique_decisions: int = 0  # drawn at least once

    def trained(self, entry: Entry, times: int) -> None:
        self.trained_decisions += times * entry.size
        if entry.imagined:
            self.trained_imagined += times * entry.size


@dataclass(eq=False)
class Entry:
    """A stored segment, which may be drawn `draws` times in all.

    Once it is removed, `segment` is None; the counts stay for `Replay.state`.
    """

    segment: Any
    draws: int
    uses: int = 0
    removed_as: str = ""  # ``evicted`` or ``retired``

    def __post_init__(self) -> None:
        self.size = len(self.segment)
        self.oldest_version = int(self.segment.version.min())
        self.imagined = self.segment.source != REAL

    @property
    def available(self) -> bool:
        return self.uses < self.draws


class Replay:
    """Segments in, batches of segments out; no clock, no process, no policy.

    Real segments that are stored are noted in the `journal`.
    """

    def __init__(self, config: ReplayConfig, journal: Journal | None = None) -> None:
        self.config = config
        self.counters = ReplayCounters()
        self.ended = False  # True if no segment will come any more
        self.stored_decisions = 0
        self.available_decisions = 0  # decisions of the segments with draws left
        self._journal = journal
        self._entries: deque[Entry] = deque()  # oldest first
        self._remainder = 0.0
        # Versions of the trainer, and the batches that it drew.
        self._drawn: deque[tuple[int, list[Entry]]] = deque(maxlen=REMEMBERED_BATCHES)

    def may_insert(self) -> bool:
        """True if rollouts should bring another segment now; `insert` does not refuse one too many."""
        if self.stored_decisions < self.config.min_decisions:
            return True
        return self.available_decisions < self.config.max_unlearned_decisions

    def may_sample(self, batch_decisions: int) -> bool:
        """True if the trainer should draw a batch now; `sample` itself does not wait for the warm start.

        Once collection has ended, a share of a batch is enough.
        """
        if self.ended:
            return self.available_decisions >= BATCH_SHARE * batch_decisions
        if self.stored_decisions < self.config.min_decisions:
            return False
        return self.available_decisions >= batch_decisions

    def exhausted(self, batch_decisions: int) -> bool:
        """True if there is no batch and never will be."""
        return self.ended and not self.may_sample(batch_decisions)

    def insert(self, segment: Segment) -> bool:
        """Stores a segment, by reference, and evicts the oldest ones if room is needed.

        A non-finite segment is counted and not stored: False.
        """
        # The runner has checked the numbers of the environment.
        if nonfinite({"log_prob": segment.log_prob, **segment.latent}):
            self.counters.dropped_nonfinite += 1
            return False
        n = len(segment)  # at most the capacity, see `ReplayConfig.check`
        while self.stored_decisions + n > self.config.capacity:
            self._remove(self._entries[0], "evicted")
        draws, self._remainder = draws_for(self.config.samples_per_insert, n, self._remainder)
        entry = Entry(segment, draws)
        self._add(entry)
        self.counters.inserted_segments += 1
        self.counters.inserted_decisions += n
        if entry.imagined:
            self.counters.inserted_imagined += n
        elif self._journal is not None:
            self._journal.write(segment)
        return True

    def sample(self, num_decisions: int, trainer_version: int, rng: np.random.Generator) -> list[Segment]:
        """Retires segments that are too old, then draws whole ones until there are `num_decisions`.

        Those used least come first, none twice; `rng` decides among segments used equally often. Empty, with
        nothing counted as used, if fewer decisions are available. That can happen although `may_sample` held,
        when segments were too old: try again later.
        """
        self.retire(trainer_version)
        if self.ended and self.may_sample(num_decisions):
            num_decisions = min(num_decisions, self.available_decisions)
        if self.available_decisions < num_decisions:
            return []
        available = [entry for entry in self._entries if entry.available]
        shuffled = [available[i] for i in rng.permutation(len(available))]
        drawn: list[Entry] = []
        for entry in sorted(shuffled, key=lambda entry: entry.uses):
            if num_decisions <= 0:
                break
            self._use(entry)
            drawn.append(entry)
            num_decisions -= entry.size
        self._drawn.append((trainer_version, drawn))
        return [entry.segment for entry in drawn]

    def retire(self, trainer_version: int) -> None:
        """Removes segments that are too old for a trainer that has made so many updates."""
        cutoff = trainer_version - self.config.max_lag
        old = [entry for entry in self._entries if entry.oldest_version < cutoff]
        for entry in old:
            self._remove(entry, "retired")

    def metrics(self) -> Metrics:
        stored = {
            "stored_segments": len(self._entries),
            "stored_decisions": self.stored_decisions,
            "available_decisions": self.available_decisions,
        }
        return asdict(self.counters) | stored

    def state(self, version: int | None = None) -> State:
        """All that `restore` needs; see `snapshot`. Shares the segments, which nobody changes.

        Batches drawn for updates after `version` count as not drawn, because the resumed trainer draws again.
        None: the trainer has learned from all.
        """
        unlearned: Counter[Entry] = Counter()
        for drawn_at, batch in self._drawn:
            if version is not None and drawn_at >= version:
                unlearned.update(batch)
        counters = replace(self.counters)
        for entry, times in unlearned.items():
            counters.trained(entry, -times)
            if times == entry.uses:
                counters.unique_decisions -= entry.size
                if entry.removed_as:
                    _count_unused(counters, entry.removed_as)
        entries: list[dict[str, Any]] = []
        for entry in self._entries:
            uses = entry.uses - unlearned[entry]
            entries.append({"segment": entry.segment, "draws": entry.draws, "uses": uses})
        journal = None
        if self._journal is not None:
            journal = self._journal.save()
        return {
            "counters": counters,
            "entries": entries,
            "remainder": self._remainder,
            "ended": self.ended,
            "journal": journal,
        }

    def restore(self, state: State) -> None:
        """Resumes from `state`, before the first insert."""
        self.counters = state["counters"]
        self.ended = state["ended"]
        self._remainder = state["remainder"]
        for entry in state["entries"]:
            self._add(Entry(**entry))
        if self._journal is not None and state["journal"] is not None:
            self._journal.cut(state["journal"])

    def _add(self, entry: Entry) -> None:
        self._entries.append(entry)
        self.stored_decisions += entry.size
        if entry.available:
            self.available_decisions += entry.size

    def _use(self, entry: Entry) -> None:
        self.counters.trained(entry, 1)
        if entry.uses == 0:
            self.counters.unique_decisions += entry.size
        entry.uses += 1
        if not entry.available:
            self.available_decisions -= entry.size

    def _remove(self, entry: Entry, how: str) -> None:
        self._entries.remove(entry)
        self.stored_decisions -= entry.size
        if entry.available:
            self.available_decisions -= entry.size
        entry.segment = None
        entry.removed_as = how
        self.counters.removed_segments += 1
        self.counters.removed_decisions += entry.size
        if entry.uses == 0:
            _count_unused(self.counters, how)


def _count_unused(counters: ReplayCounters, how: str) -> None:
    """Counts a segment that has left without being trained on."""
    if how == "evicted":
        counters.evicted_unused += 1
    else:
        counters.retired_unused += 1
