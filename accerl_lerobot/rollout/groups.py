# SPDX-License-Identifier: Apache-2.0
"""Episodes from equal starts are held back until all of their group have ended, then compared.

    Â = (R − mean) / (std + ε)        GRPO, arXiv 2402.03300

R is the undiscounted return of an episode, decision costs included; mean and std are over the group, and
every decision of an episode gets the same Â. A group that has nothing to compare is thrown away, which is the
dynamic sampling of DAPO, arXiv 2503.14476.

What must hold, in decisions:

    entered = released + dropped + held

An episode that was thrown away itself (its world returned NaN) leaves its group, and the others are compared
without it; a group of which fewer than two are left is thrown away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.experience import Segment

GroupFilter = Literal["outcome", "return", "none"]

STD_EPSILON = 1e-6
"""Added to the standard deviation; returns that differ by less count as equal."""


def group_advantages(returns: np.ndarray) -> np.ndarray:
    """Advantages float64 (n,), with mean 0, from undiscounted returns (n,), n ≥ 2; see the top of the file.

    The standard deviation is that of the group itself (divided by n, not n − 1).
    """
    centred = np.asarray(returns, np.float64) - np.mean(returns)
    return np.asarray(centred / (centred.std() + STD_EPSILON))


@kind
class EpisodeOutcome(NamedTuple):
    """How an episode ended."""

    episode_return: float
    success: bool


@kind
class GroupSlot(NamedTuple):
    """Slot of an episode in a group."""

    start: int
    """Number of the group."""
    member: int
    """0 to the group's size − 1."""


def comparable(outcomes: list[EpisodeOutcome], rule: GroupFilter) -> bool:
    """True if a group of at least two has something to compare."""
    returns = [o.episode_return for o in outcomes]
    if rule == "none":
        return True
    if max(returns) - min(returns) < STD_EPSILON:
        return False
    return rule == "return" or len({o.success for o in outcomes}) == 2


@kind
@dataclass(kw_only=True)
class GroupCounters:
    """Counts of a worker's groups, and of the decisions in them, by their fate."""

    kept: int = 0
    dropped: int = 0
    entered_decisions: int = 0
    released_decisions: int = 0
    dropped_decisions: int = 0


@kind
@dataclass
class Member:
    """An episode of a group, and its segments so far."""

    segments: list[Segment] = field(default_factory=list)
    outcome: EpisodeOutcome | None = None
    ended: bool = False


def open_limit(size: int, worlds: int) -> int:
    """Most groups of `size` that may be unfinished at a time: 2·⌈worlds / size⌉ + 1.

    It bounds the decisions held back. A world that may not begin another group is idle: with half as many
    groups, 7 to 20 % of the time in a simulation with uniformly distributed episode lengths, since every
    group waits for its slowest; with these, under 1 %.
    """
    return 2 * math.ceil(worlds / size) + 1


class Groups:
    """The groups of one rollout worker.

    Places are claimed in order: worlds that become free complete one group before they begin the next. When
    `open_limit` groups are unfinished a world has to wait; at least one episode of each is under way then, so
    the wait ends.

    Example:
        >>> groups = Groups(size=4, worlds=8)
        >>> place = groups.claim()                          # for each episode; None: wait
        >>> groups.add(place, segment)                      # each of its segments
        >>> released = groups.end(place, EpisodeOutcome(0.9, True))  # [] until the last of the group ends

    Args:
        size: episodes per group, at least 2.
        worlds: that episodes run in at the same time.
        rule: which groups are thrown away, see `RolloutConfig.group_filter`.
    """

    def __init__(self, size: int, worlds: int, rule: GroupFilter = "outcome") -> None:
        self.size, self.limit = size, open_limit(size, worlds)
        self.counters = GroupCounters()
        self._rule: GroupFilter = rule
        self._open: dict[int, list[Member]] = {}
        self._newest, self._claimed = -1, size

    @property
    def open(self) -> int:
        """Unfinished groups."""
        return len(self._open)

    @property
    def held(self) -> int:
        """Decisions that wait for the end of their group."""
        members = [m for group in self._open.values() for m in group]
        return sum(len(s) for m in members for s in m.segments)

    def claim(self) -> GroupSlot | None:
        """A place for one more episode, in the group that lacks some, else in a new one; None: wait."""
        if self._claimed == self.size:
            if self.open >= self.limit:
                return None
            self._newest, self._claimed = self._newest + 1, 0
            self._open[self._newest] = [Member() for _ in range(self.size)]
        self._claimed += 1
        return GroupSlot(self._newest, self._claimed - 1)

    def add(self, place: GroupSlot, segment: Segment) -> None:
        """Keeps a segment until its group has ended."""
        self.counters.entered_decisions += len(segment)
        group = self._open.get(place.start)
        if group is None:  # abandoned while a decision of the episode was under way
            self.counters.dropped_decisions += len(segment)
        else:
            group[place.member].segments.append(segment)

    def end(self, place: GroupSlot, outcome: EpisodeOutcome | None) -> list[Segment]:
        """Says how an episode ended; None: it was thrown away.

        Returns:
            If it was the last of its group, and the group is kept, all segments of the group, each with its
            `advantage`, in an order that does not depend on who ended first.
        """
        group = self._open.get(place.start)
        if group is None:
            return []
        member = group[place.member]
        member.outcome, member.ended = outcome, True
        if outcome is None:
            self._drop([member])
        if not all(m.ended for m in group):
            return []
        del self._open[place.start]
        return self._compare(group)

    def abandon(self) -> None:
        """Throws all unfinished groups away; what their episodes still bring is ignored."""
        for group in self._open.values():
            self.counters.dropped += 1
            self._drop(group)
        self._open.clear()
        self._claimed = self.size

    def state(self) -> dict[str, Any]:
        """Everything `restore` needs; see `snapshot`."""
        counters, claim = replace(self.counters), (self._newest, self._claimed)
        return {"counters": counters, "open": dict(self._open), "claim": claim}

    def restore(self, state: dict[str, Any]) -> None:
        """Resumes from what `state` returned."""
        self.counters, self._open = state["counters"], state["open"]
        self._newest, self._claimed = state["claim"]

    def _compare(self, group: list[Member]) -> list[Segment]:
        left = [(m, m.outcome) for m in group if m.outcome is not None]
        outcomes = [outcome for _, outcome in left]
        if len(left) < 2 or not comparable(outcomes, self._rule):
            self.counters.dropped += 1
            self._drop(group)
            return []
        self.counters.kept += 1
        advantages = group_advantages(np.array([o.episode_return for o in outcomes]))
        released = [
            replace(segment, advantage=np.full(len(segment), advantage, np.float32))
            for (member, _), advantage in zip(left, advantages, strict=True)
            for segment in member.segments
        ]
        self.counters.released_decisions += sum(len(s) for s in released)
        return released

    def _drop(self, members: list[Member]) -> None:
        for member in members:
            self.counters.dropped_decisions += sum(len(s) for s in member.segments)
            member.segments = []
