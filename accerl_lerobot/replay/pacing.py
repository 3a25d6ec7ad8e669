# SPDX-License-Identifier: Apache-2.0
"""How far rollouts and trainer may run apart: two predicates, and the staleness they imply; whose turn it is.

Everything is counted in decisions. On entering the store each segment gets a number of draws (`draws_for`);
one with draws left is *available*. With batch ≤ max_unlearned_decisions, one of `may_sample` and
`may_insert` holds at any time. Rollouts wait on insert instead of having their segments thrown away later,
because what is thrown away first is what took longest, and those are the failures.

    asynchronous   nobody waits for anybody, within the pace
    overlap        the next batch is collected while one is learned from, and then both wait for each other
    synchronous    a batch is collected, then learned from, then the weights are handed over

The last two are what asynchrony is measured against: the same workers, held back. All environments are
decided for together in them, as by a vectorised environment, so a step takes as long as its slowest
environment.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from accerl_lerobot.config.ranges import Range, Section, Steps
from accerl_lerobot.errors import InputError


@dataclass(frozen=True, kw_only=True)
class ReplayConfig(Section, section="replay"):
    """Size and pace of one replay."""

    capacity: Annotated[int, Range("[1, 100000000]")] = 4096
    """Decisions held at most; the oldest segments leave first. At least `max_unlearned_decisions` plus one
    segment."""
    min_decisions: Annotated[int, Range("[1, 100000000]")] = 256
    """Decisions that must be held before the trainer starts (warm start), from 1 to `capacity`."""
    samples_per_insert: Annotated[float, Range("[1, 1000000]")] = 1.0
    """How often a decision is trained on, on average: collect less rather than throw away."""
    max_lag: Steps = 50
    """A segment whose oldest decision is more updates behind the trainer than this is retired, at least 0.

    A safety net: choose the pace so that `lag_bound` stays below it, and nothing is thrown away. What an
    off-policy algorithm keeps in a memory of its own may be older.
    """
    max_unlearned_decisions: Annotated[int, Range("[1, 100000000]")] = 512
    """Decisions to learn from, each counted as often as it will be, that the rollouts may be ahead of the
    trainer; from one batch to `capacity`. Where environments end their segments together, room for all of
    them keeps both sides busy. It costs lag."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("min_decisions", "max_unlearned_decisions"):
            if getattr(self, name) > self.capacity:
                hint = f"use 1 to capacity, {self.capacity}"
                raise InputError(f"replay.{name}", getattr(self, name), hint)

    def check(self, *, batch_decisions: int, segment_decisions: int) -> None:
        """Refuses a pace that could stall or waste."""
        if self.max_unlearned_decisions < batch_decisions:
            hint = f"use at least one batch, {batch_decisions}, or both sides wait for each other"
            raise InputError("replay.max_unlearned_decisions", self.max_unlearned_decisions, hint)
        # Each of a segment's draws is for another update.
        oldest = math.ceil(self.samples_per_insert) - 1
        if self.max_lag < oldest:
            hint = (
                f"with replay.samples_per_insert={self.samples_per_insert:g} what is drawn last is {oldest} "
                f"updates old at least; use {oldest} or more, rather several times as many"
            )
            raise InputError("replay.max_lag", self.max_lag, hint)
        least = max(self.min_decisions, self.max_unlearned_decisions) + segment_decisions - 1
        if self.capacity < least:
            hint = f"use at least {least}: min_decisions or max_unlearned_decisions, and a segment"
            raise InputError("replay.capacity", self.capacity, hint)

    def may_sample(self, stored: int, available: int, batch_decisions: int) -> bool:
        return stored >= self.min_decisions and available >= batch_decisions

    def may_insert(self, stored: int, available: int) -> bool:
        return stored < self.min_decisions or available < self.max_unlearned_decisions


def draws_for(samples_per_insert: float, n: int, remainder: float) -> tuple[int, float]:
    """How often a new segment of n decisions may be drawn, such that the average is `samples_per_insert`.

    `remainder` is the draws, in decisions, that rounding has withheld so far; the new one is returned too.
    """
    remainder += samples_per_insert * n
    draws = min(math.floor(remainder / n), math.ceil(samples_per_insert))
    return draws, remainder - draws * n


def lag_bound(
    config: ReplayConfig, *, batch_decisions: int, in_flight: int, pickup: int = 0, prefetch: int = 0
) -> int:
    """The largest lag of a decision that is drawn from replay, in updates, for people to read.

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
    decisions = max(config.max_unlearned_decisions, config.min_decisions) + 2 * in_flight + config.capacity
    drawn = math.ceil(config.samples_per_insert) * decisions // batch_decisions - 1
    return min(config.max_lag, pickup + drawn + prefetch)


Schedule = Literal["asynchronous", "overlap", "synchronous"]
ASYNCHRONOUS: Schedule = "asynchronous"
OVERLAP: Schedule = "overlap"
SYNCHRONOUS: Schedule = "synchronous"


@dataclass
class Turns:
    """Order in which rollouts and the trainer may go on.

    Nobody is kept for ever, as long as the trainer lives: where collecting may not go on, a batch is ready or
    learned from, and each is followed by an update; where no batch may be drawn, one is learned from.
    """

    schedule: Schedule = ASYNCHRONOUS
    under_way: int = 0  # batches that the trainer has drawn, and that not every reader has the weights of

    def may_collect(self, ready: bool) -> bool:
        """True if who has brought a segment may go on; `ready`: the pace would let a batch be drawn now."""
        learning = self.under_way > 0
        if self.schedule == SYNCHRONOUS:
            return not (ready or learning)
        return self.schedule == ASYNCHRONOUS or not (ready and learning)

    def may_draw(self) -> bool:
        return self.schedule == ASYNCHRONOUS or self.under_way <= 0
