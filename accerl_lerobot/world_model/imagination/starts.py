# SPDX-License-Identifier: Apache-2.0
"""Start states of imagined rollouts: real observations, drawn at resets or anywhere.

Shapes: see `contract.py`; T decisions of a segment.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.experience import Origin, Segment
from accerl_lerobot.world_model.config import ImaginationConfig
from accerl_lerobot.world_model.data import executed_actions, model_arrays
from accerl_lerobot.world_model.model.contract import ActionHistory, WorldModelSpec

EpisodeName = tuple[str, int]
"""Task and seed."""
MAX_UNFINISHED = 1024
"""Episodes that may go on in another segment; of more, such as those of a worker that died, the oldest are
dropped."""


@kind
@dataclass(frozen=True, kw_only=True)
class Start:
    """A real observation, and what led there."""

    frames: np.ndarray
    """uint8 (L, V, H, W, 3), of the model's size, the newest last."""
    robot: np.ndarray
    """float32 (L, S)."""
    actions: np.ndarray
    """float32 (L − 1, K, A), executed between these."""
    commanded_sum: np.ndarray
    """float32 (A,), see `Context`."""
    initial_state: np.ndarray
    """float32 (S,), see `Context`."""
    task: str
    """The instruction."""
    origin: Origin
    history: ActionHistory | None
    """None: the segment began in mid-episode, and what came before is not known."""
    achieved: bool | None
    """True if the real episode achieved the task; None: not known, or not yet."""


@kind
class _Lead(NamedTuple):
    """Summary of the observations before a segment, which may begin in mid-episode."""

    decision: int
    """The segment's first."""
    commanded_sum: np.ndarray
    initial_state: np.ndarray


class StartPool:
    """The newest real decisions; `ImaginationConfig` says how many, and where rollouts start."""

    def __init__(self, spec: WorldModelSpec, config: ImaginationConfig) -> None:
        self.spec, self.config = spec, config
        self._held: deque[_Held] = deque()
        self._leads: dict[EpisodeName, _Lead] = {}
        """Leads to the next segment of episodes that have not ended; the oldest first."""
        self._outcomes: dict[EpisodeName, bool] = {}
        """Outcomes of episodes that have ended, and of which something is held."""
        self._count = 0

    def __len__(self) -> int:
        """Decisions to start at."""
        return self._count

    def add(self, segment: Segment) -> None:
        """Takes a real segment; the oldest ones leave."""
        held = _Held(segment, self.spec)
        self._link(held)
        usable = not self.config.kind.needs_history and len(segment) >= self.spec.context
        if not segment.origin.decision or usable:
            self._held.append(held)
            self._count += len(segment)
        names = [held.name for held in self._held]
        if (segment.terminated or segment.truncated) and held.name in names:
            self._outcomes[held.name] = segment.terminated and segment.success
        while self._held and self._count - len(self._held[0].segment) >= self.config.memory:
            gone = self._held.popleft()
            self._count -= len(gone.segment)
            names.pop(0)
            if gone.name not in names:
                self._outcomes.pop(gone.name, None)

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        held = [(held.segment, held.lead) for held in self._held]
        return {"held": held, "leads": dict(self._leads), "outcomes": dict(self._outcomes)}

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from a `state`."""
        self._held.extend(_Held(segment, self.spec, lead) for segment, lead in state["held"])
        self._leads.update(state["leads"])
        self._count = sum(len(held.segment) for held in self._held)
        self._outcomes = state["outcomes"]

    def _link(self, held: _Held) -> None:
        """Sets the segment's lead, and keeps the lead to the next one."""
        segment, name = held.segment, held.name
        lead = self._leads.pop(name, None)
        if lead is not None and lead.decision == segment.origin.decision:
            held.lead = lead
        if segment.terminated or segment.truncated:
            return
        total = held.lead.commanded_sum + executed_actions(segment.actions, segment.steps).sum(0)
        self._leads[name] = _Lead(segment.origin.decision + len(segment), total, held.lead.initial_state)
        if len(self._leads) > MAX_UNFINISHED:
            self._leads.pop(next(iter(self._leads)))

    def draw(self, count: int, rng: np.random.Generator) -> list[Start]:
        """Draws starts, with repetition.

        Raises:
            ValueError: there are none yet.
        """
        if not self._count:
            raise ValueError("no real experience to start from yet")
        lengths = np.array([len(h.segment) for h in self._held])
        allowed = np.concatenate([h.allowed for h in self._held])
        weights = allowed / max(1, allowed.sum())
        first = np.concatenate([h.first for h in self._held])
        if first.any():
            reset = self.config.start_at_reset_prob
            weights = reset * first / first.sum() + (1 - reset) * weights
        drawn = rng.choice(self._count, size=count, p=weights / weights.sum())
        ends = np.cumsum(lengths)
        of = np.searchsorted(ends, drawn, side="right")
        return [
            self._start(self._held[s], int(i - ends[s] + lengths[s])) for s, i in zip(of, drawn, strict=True)
        ]

    def _start(self, held: _Held, t: int) -> Start:
        segment, spec = held.segment, self.spec
        context = [max(0, t - back) for back in range(spec.context - 1, -1, -1)]
        history, actions = None, executed_actions(segment.actions[:t], segment.steps[:t])
        if not segment.origin.decision:
            history = ActionHistory(segment.origin.task, segment.origin.seed, actions)
        return Start(
            frames=held.frames[context],
            robot=held.robot[context],
            actions=_chunks_before(segment, t, spec.context),
            commanded_sum=held.lead.commanded_sum + actions.sum(0),
            initial_state=held.lead.initial_state,
            task=segment.task,
            origin=segment.origin._replace(decision=segment.origin.decision + t),
            history=history,
            achieved=self._outcomes.get(held.name),
        )


def _chunks_before(segment: Segment, t: int, context: int) -> np.ndarray:
    """Chunks of the decisions before the t-th, zero before the segment began."""
    chunks = np.zeros((context - 1, *segment.actions.shape[1:]), np.float32)
    known = min(t, context - 1)
    if known:
        chunks[-known:] = segment.actions[t - known : t]
    return chunks


class _Held:
    """A segment as arrays of the model; without a `lead` its episode begins with it, as far as is known."""

    def __init__(self, segment: Segment, spec: WorldModelSpec, lead: _Lead | None = None) -> None:
        self.segment, self.name = segment, segment.origin[:2]
        self.first = segment.origin.decision + np.arange(len(segment)) == 0
        self.frames, self.robot = model_arrays(segment.observations, spec)
        nothing = np.zeros(spec.action_dim, np.float32)
        self.lead = lead or _Lead(segment.origin.decision, nothing, self.robot[0])
        # In mid-episode, the context of the first decisions of a segment is not known.
        self.allowed = np.ones(len(segment), bool)
        if segment.origin.decision:
            self.allowed[: spec.context - 1] = False
