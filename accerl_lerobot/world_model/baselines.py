# SPDX-License-Identifier: Apache-2.0
"""World models to compare with: the best there can be, and two that are worth nothing.

What a policy learns from a copy of the last frame, or from a model that is told other actions, it does not
learn from the world.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from accerl_lerobot.envs.base import ChunkResult, World
from accerl_lerobot.experience import TASK
from accerl_lerobot.world_model.contract import (
    Context,
    Dream,
    History,
    LearnableWorldModel,
    State,
    WorldModel,
    WorldModelSpec,
)
from accerl_lerobot.world_model.frames import seen


class CopyModel(WorldModel):
    """Nothing ever changes.

    Args:
        spec: of the world.
    """

    def __init__(self, spec: WorldModelSpec) -> None:
        self.spec = replace(spec, provides=spec.provides - {"uncertainty"})

    def begin(
        self, context: Context, tasks: Sequence[str], histories: Sequence[History | None] | None = None
    ) -> State:
        """See the base class."""
        return {"frames": context.frames[:, -1], "robot": context.robot[:, -1]}

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Dream:
        """See the base class."""
        unknown = torch.full((len(actions),), torch.nan)
        return Dream(state=state, frames=state["frames"], robot=state["robot"], uncertainty=unknown)


class ShuffledModel(WorldModel):
    """Another model that is told the actions of the dream beside.

    Args:
        model: what dreams.
    """

    def __init__(self, model: WorldModel) -> None:
        self.model, self.spec = model, model.spec

    def begin(
        self, context: Context, tasks: Sequence[str], histories: Sequence[History | None] | None = None
    ) -> State:
        """See the base class."""
        return self.model.begin(context, tasks, histories)

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Dream:
        """See the base class.

        Raises:
            ValueError: there is only one dream, which would be told its own actions.
        """
        if len(actions) < 2:
            raise ValueError("a dream alone can only be told its own actions")
        return self.model.step(state, actions.roll(1, 0), seeds)


def learnt_within(model: WorldModel) -> LearnableWorldModel:
    """The part that learns: the model itself, or the one that a `ShuffledModel` tells the wrong actions."""
    model = model.model if isinstance(model, ShuffledModel) else model
    assert isinstance(model, LearnableWorldModel)  # `ModelKind.learns` says so of no other
    return model


class OracleModel(WorldModel):
    """Simulators that are put where a dream begins, by playing what led there.

    A state holds what was played, so it can be gone on from more than once; a simulator that is there already
    just goes on.

    Args:
        spec: of the world.
        make: a new simulator.
        simulators: kept at most.
    """

    def __init__(self, spec: WorldModelSpec, make: Callable[[], World], simulators: int) -> None:
        self.spec = replace(spec, provides=spec.provides - {"uncertainty"} | {"success"})
        self._make, self._most = make, simulators
        self._at: OrderedDict[bytes, World] = OrderedDict()  # the longest unused first
        self._free: list[World] = []
        self._made = 0
        self.tasks: list[str] = []

    def begin(
        self, context: Context, tasks: Sequence[str], histories: Sequence[History | None] | None = None
    ) -> State:
        """See the base class.

        Raises:
            ValueError: what led to a start is not known.
        """
        if histories is None or any(h is None for h in histories):
            raise ValueError("an oracle needs the history of every start")
        known = [h for h in histories if h is not None]
        self.tasks += sorted({h.task for h in known} - set(self.tasks))
        longest = max(len(h.actions) for h in known)
        played = np.zeros((len(known), longest, self.spec.action_dim), np.float32)
        for row, h in zip(played, known, strict=True):
            row[: len(h.actions)] = h.actions
        return {
            "task": torch.tensor([self.tasks.index(h.task) for h in known]),
            "seed": torch.tensor([h.seed for h in known]),
            "count": torch.tensor([len(h.actions) for h in known]),
            "played": torch.from_numpy(played),
        }

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Dream:
        """See the base class."""
        results = [self._play(state, i, actions[i].numpy()) for i in range(len(actions))]
        count, chunk = state["count"], actions.shape[1]
        room = int(count.max()) + chunk - state["played"].shape[1]
        played = torch.nn.functional.pad(state["played"], (0, 0, 0, max(0, room)))
        for i, n in enumerate(count.tolist()):
            played[i, n : n + chunk] = actions[i]
        names = [name for name in results[0].observation if name != TASK]
        observations = {n: np.stack([np.asarray(r.observation[n]) for r in results]) for n in names}
        frames, robot = seen(observations, self.spec)
        return Dream(
            state={**state, "count": count + chunk, "played": played},
            frames=torch.from_numpy(frames),
            robot=torch.from_numpy(robot),
            uncertainty=torch.full((len(actions),), torch.nan),
            success=torch.tensor([float(r.success) for r in results]),
            done=torch.tensor([r.done for r in results]),
        )

    def close(self) -> None:
        """Closes the simulators."""
        for world in (*self._at.values(), *self._free):
            world.close()
        self._at.clear()
        self._free.clear()

    def _play(self, state: State, row: int, actions: np.ndarray) -> ChunkResult:
        task, seed = self.tasks[int(state["task"][row])], int(state["seed"][row])
        played = state["played"][row, : int(state["count"][row])].numpy()
        world = self._at.pop(_name(task, seed, played), None)
        if world is None:
            world = self._somewhere()
            world.reset(seed, task)
            if len(played):
                world.step_chunk(played)
        result = world.step_chunk(actions)
        if result.done:
            self._free.append(world)
        else:
            self._at[_name(task, seed, np.concatenate([played, actions]))] = world
        return result

    def _somewhere(self) -> World:
        if self._free:
            return self._free.pop()
        if self._made < self._most or not self._at:
            self._made += 1
            return self._make()
        return self._at.popitem(last=False)[1]


def _name(task: str, seed: int, played: np.ndarray) -> bytes:
    return f"{task} {seed} ".encode() + np.ascontiguousarray(played, np.float32).tobytes()
