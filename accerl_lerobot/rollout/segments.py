# SPDX-License-Identifier: Apache-2.0
"""From decisions to segments: the bookkeeping of one episode, without any process around it."""

from __future__ import annotations

from typing import Any

import numpy as np

from accerl_lerobot.experience import REAL, TASK, Decision, Observation, Origin, Segment


class SegmentBuilder:
    """Collects the decisions of one episode and cuts them into segments of at most `length` decisions."""

    def __init__(self, observation: Observation, length: int, origin: Origin, source: str = REAL) -> None:
        self.length, self.origin, self.source = length, origin, source
        self.observations = [observation]
        self.decisions: list[Decision] = []
        self.actions: list[np.ndarray] = []
        self.rewards: list[float] = []
        self.steps: list[int] = []

    @property
    def latest(self) -> Observation:
        """The observation that the next decision is about."""
        return self.observations[-1]

    @property
    def full(self) -> bool:
        return len(self.decisions) >= self.length

    def state(self) -> dict[str, Any]:
        return dict(vars(self))

    def restore(self, state: dict[str, Any]) -> None:
        vars(self).update(state)

    def add(
        self, decision: Decision, actions: np.ndarray, reward: float, steps: int, following: Observation
    ) -> None:
        self.decisions.append(decision)
        self.actions.append(actions)
        self.rewards.append(reward)
        self.steps.append(steps)
        self.observations.append(following)

    def cut(
        self,
        key: str,
        terminated: bool = False,
        success: bool = False,
        episode: dict[str, float] | None = None,
    ) -> Segment:
        """Hands out what was collected as one segment and goes on from its last observation."""
        keys = [k for k in self.observations[0] if k != TASK]
        names = self.decisions[0].latent.keys()
        segment = Segment(
            observations={k: np.stack([np.asarray(o[k]) for o in self.observations]) for k in keys},
            task=str(self.observations[0][TASK]),
            latent={k: np.stack([d.latent[k] for d in self.decisions]) for k in names},
            log_prob=np.stack([d.log_prob for d in self.decisions]).astype(np.float32),
            actions=np.stack(self.actions).astype(np.float32),
            reward=np.array(self.rewards, np.float32),
            version=np.array([d.version for d in self.decisions], np.int64),
            steps=np.array(self.steps, np.int64),
            terminated=terminated,
            success=success,
            key=key,
            source=self.source,
            origin=self.origin,
            episode=episode or {},
        )
        self.origin = self.origin._replace(decision=self.origin.decision + len(self.decisions))
        self.observations = [self.latest]
        self.decisions, self.actions, self.rewards, self.steps = [], [], [], []
        return segment
