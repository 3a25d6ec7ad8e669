# SPDX-License-Identifier: Apache-2.0
"""Where dreams begin: real observations, drawn anywhere or where the critic was surprised.

NumPy only, but for pictures of another size. Shapes: see `contract.py`; T decisions of a segment.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.experience import Origin, Segment
from accerl_lerobot.world_model.contract import History, WorldModelSpec
from accerl_lerobot.world_model.frames import executed, seen

Name = tuple[str, int]
"""Name of an episode: its task and its seed."""
UNDER_WAY = 1024
"""Episodes that may go on in another segment; of those left behind by a worker that died, the oldest go."""


@kind
@dataclass(frozen=True, kw_only=True)
class Start:
    """A real observation, and what led there."""

    frames: np.ndarray
    """uint8 (L, V, H, W, 3), of the model's size, the newest last."""
    robot: np.ndarray
    """float32 (L, S)."""
    actions: np.ndarray
    """float32 (L − 1, K, A), made between these."""
    told: np.ndarray
    """float32 (A,), see `Context`,"""
    first: np.ndarray
    """and this, (S,), too."""
    task: str
    """The instruction."""
    origin: Origin
    history: History | None
    """None: where the segment began in mid-episode, what came before is not known."""
    achieved: bool | None
    """True if the real episode achieved the task within the horizon; None: it is not known, or not yet."""


@kind
class _Lead(NamedTuple):
    """Observations before a segment, which may begin in mid-episode."""

    decision: int
    """The segment's first."""
    told: np.ndarray
    """float32 (A,), the sum of all actions before, as far back as they are known,"""
    first: np.ndarray
    """and where the robot was then, float32 (S,)."""


class StartPool:
    """The newest real decisions.

    Args:
        spec: of the world model.
        memory: decisions held at least, as long as there were so many.
        horizon: decisions of a dream; None: to the end.
        beginnings: share of dreams that begin where an episode began.
        keyframes: share of the others that begin where |r + V(next) − V| was large.
        whole: whether only starts are given whose history is known.
    """

    def __init__(
        self,
        spec: WorldModelSpec,
        *,
        memory: int,
        horizon: int | None,
        beginnings: float,
        keyframes: float,
        whole: bool = False,
    ) -> None:
        self.spec, self.memory, self.horizon = spec, memory, horizon
        self.beginnings, self.keyframes = beginnings, keyframes
        self._whole = whole
        self._held: deque[_Held] = deque()
        self._leads: dict[Name, _Lead] = {}
        """To what comes next of an episode that has not ended; the oldest first."""
        self._outcomes: dict[Name, bool] = {}
        """Outcomes of episodes that have ended, and of which something is held."""
        self.ended = 0
        """Episodes that have ended so far."""
        self.told = False
        """True if there is a beginning of an episode that has ended; kept, as another thread reads it."""
        self._count = 0

    def __len__(self) -> int:
        """Decisions to begin at."""
        return self._count

    def add(self, segment: Segment) -> None:
        """Takes a real segment; the oldest ones leave."""
        held = _Held(segment, self.spec)
        self._follow(held)
        if not segment.origin.decision or not (self._whole or len(segment) < self.spec.context):
            self._held.append(held)
            self._count += len(segment)
        names = [held.name for held in self._held]
        name = segment.origin[:2]
        if (segment.terminated or segment.truncated) and name in names:
            self._outcomes[name] = segment.terminated and segment.success
            self.ended += 1
        while self._held and self._count - len(self._held[0].segment) >= self.memory:
            gone = self._held.popleft()
            self._count -= len(gone.segment)
            names.pop(0)
            if gone.name not in names:
                self._outcomes.pop(gone.name, None)
        self.told = self._is_told()

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        held = [(held.segment, held.lead) for held in self._held]
        outcomes = dict(self._outcomes)
        return {"held": held, "leads": dict(self._leads), "outcomes": outcomes, "ended": self.ended}

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from what `state` gave."""
        self._held.extend(_Held(segment, self.spec, lead) for segment, lead in state["held"])
        self._leads.update(state["leads"])
        self._count = sum(len(held.segment) for held in self._held)
        self._outcomes, self.ended = state["outcomes"], state["ended"]
        self.told = self._is_told()

    def _follow(self, held: _Held) -> None:
        """Lets a segment know what led to it, and keeps what it leads to."""
        segment, name = held.segment, held.name
        lead = self._leads.pop(name, None)
        if lead is not None and lead.decision == segment.origin.decision:
            held.lead = lead
        if segment.terminated or segment.truncated:
            return
        told = held.lead.told + executed(segment.actions, segment.steps).sum(0)
        self._leads[name] = _Lead(segment.origin.decision + len(segment), told, held.lead.first)
        if len(self._leads) > UNDER_WAY:
            self._leads.pop(next(iter(self._leads)))

    def _is_told(self) -> bool:
        return any(held.first.any() and held.name in self._outcomes for held in self._held)

    def draw(self, count: int, rng: np.random.Generator, told: bool = False) -> list[Start]:
        """So many starts, with repetition.

        Args:
            count: how many.
            rng: draws them.
            told: only beginnings of episodes of which it is known how they ended.

        Raises:
            ValueError: there are none yet.
        """
        if not self._count or (told and not self.told):
            raise ValueError("no real experience to dream from yet")
        lengths = np.array([len(h.segment) for h in self._held])
        allowed = np.concatenate([h.allowed for h in self._held])
        surprise = np.concatenate([h.surprise for h in self._held]) * allowed
        even = allowed / max(1, allowed.sum())
        key = surprise / surprise.sum() if surprise.sum() > 0 else even
        chances = self.keyframes * key + (1 - self.keyframes) * even
        first = np.concatenate([h.first for h in self._held])
        if first.any():
            chances = self.beginnings * first / first.sum() + (1 - self.beginnings) * chances
        if told:
            chances = np.concatenate([h.first * (h.name in self._outcomes) for h in self._held]).astype(float)
        drawn = rng.choice(self._count, size=count, p=chances / chances.sum())
        ends = np.cumsum(lengths)
        of = np.searchsorted(ends, drawn, side="right")
        return [
            self._start(self._held[s], int(i - ends[s] + lengths[s])) for s, i in zip(of, drawn, strict=True)
        ]

    def _start(self, held: _Held, t: int) -> Start:
        segment, spec = held.segment, self.spec
        context = [max(0, t - back) for back in range(spec.context - 1, -1, -1)]
        history, actions = None, executed(segment.actions[:t], segment.steps[:t])
        if not segment.origin.decision:
            history = History(segment.origin.task, segment.origin.seed, actions)
        left = len(segment) - t
        achieved: bool | None = None
        if self.horizon is None:
            achieved = self._outcomes.get(segment.origin[:2])
        elif left >= self.horizon or segment.terminated or segment.truncated:
            achieved = segment.terminated and segment.success and left <= self.horizon
        return Start(
            frames=held.frames[context],
            robot=held.robot[context],
            actions=_before(segment, t, spec.context),
            told=held.lead.told + actions.sum(0),
            first=held.lead.first,
            task=segment.task,
            origin=segment.origin._replace(decision=segment.origin.decision + t),
            history=history,
            achieved=achieved,
        )


def _before(segment: Segment, t: int, context: int) -> np.ndarray:
    """Chunks of the decisions before the t-th, zero before the segment began."""
    made = np.zeros((context - 1, *segment.actions.shape[1:]), np.float32)
    known = min(t, context - 1)
    if known:
        made[-known:] = segment.actions[t - known : t]
    return made


class _Held:
    """A segment, as the model sees it; without a `lead` its episode begins with it, as far as is known."""

    def __init__(self, segment: Segment, spec: WorldModelSpec, lead: _Lead | None = None) -> None:
        self.segment, self.name = segment, segment.origin[:2]
        self.first = segment.origin.decision + np.arange(len(segment)) == 0
        self.frames, self.robot = seen(segment.observations, spec)
        nothing = np.zeros(spec.action_dim, np.float32)
        self.lead = lead or _Lead(segment.origin.decision, nothing, self.robot[0])
        # V of a last observation that nothing was decided on is not known: the V before stands for it.
        following = np.append(segment.value[1:], 0.0 if segment.terminated else segment.value[-1])
        self.surprise = np.abs(segment.reward + following - segment.value).astype(np.float64)
        # In mid-episode, what came before the first decisions of a segment is not known.
        self.allowed = np.ones(len(segment), bool)
        if segment.origin.decision:
            self.allowed[: spec.context - 1] = False
