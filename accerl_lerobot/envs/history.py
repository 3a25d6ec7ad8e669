# SPDX-License-Identifier: Apache-2.0
"""Observation history for policies that look back: the last observations of any world, oldest first.

LeRobot's ``n_obs_steps`` counts env steps, not decisions, so the last states of a chunk are looked at one by
one; all before them are passed without a picture, as always.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from accerl_lerobot.envs.base import ChunkResult, World, checked_actions
from accerl_lerobot.experience import Observation


class HistoryWorld(World):
    """A world whose observations hold its last states, in a dimension of `length` in front of each array.

    An episode begins with copies of its first observation, as in LeRobot's own queues. Should the world cut
    an episode short of ``spec.max_steps``, the last observation stands for those that were not looked at.

    Args:
        world: what is observed; closed with this one.
        length: observations, at least 2.
    """

    def __init__(self, world: World, length: int) -> None:
        self._world, self.spec = world, world.spec
        self._seen: deque[Observation] = deque(maxlen=length)
        self._length, self._left = length, 0

    def reset(self, seed: int, task: str) -> Observation:
        """See the base class."""
        self._seen.extend([self._world.reset(seed, task)] * self._length)
        self._left = self.spec.max_steps
        return self._observation()

    def step_chunk(self, actions: np.ndarray) -> ChunkResult:
        """See the base class."""
        actions = checked_actions(actions, self.spec)
        steps = min(len(actions), self._left) or len(actions)  # after the end, the world itself complains
        unseen = max(0, steps - self._length + 1)
        parts = ([actions[:unseen]] if unseen else []) + [actions[i : i + 1] for i in range(unseen, steps)]
        results: list[ChunkResult] = []
        for part in parts:
            results.append(self._world.step_chunk(part))
            self._seen.append(results[-1].observation)
            if results[-1].done:
                break
        last, taken = results[-1], sum(r.steps for r in results)
        if results[0].steps > 1:  # some were passed unseen; `length` follow, unless it was cut
            self._seen.extend([self._seen[-1]] * (self._length - len(results)))
        self._left -= taken
        return ChunkResult(
            observation=self._observation(),
            rewards=np.concatenate([r.rewards for r in results]),
            terminated=last.terminated,
            truncated=last.truncated,
            success=last.success,
            info=last.info,
        )

    def render(self, height: int, width: int) -> np.ndarray:
        """See the base class."""
        return self._world.render(height, width)

    def close(self) -> None:
        """See the base class."""
        self._world.close()

    def _observation(self) -> Observation:
        newest = self._seen[-1]
        return {
            key: np.stack([np.asarray(o[key]) for o in self._seen])
            if isinstance(value, np.ndarray)
            else value
            for key, value in newest.items()
        }
