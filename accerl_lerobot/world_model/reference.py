# SPDX-License-Identifier: Apache-2.0
"""Reference models beside a learned one: an oracle, the best there can be, and a placebo.

What a policy gains from a model that gets other actions, it does not gain from the world model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from accerl_lerobot.envs.base import ChunkResult, Environment, EnvironmentSpec
from accerl_lerobot.experience import TASK
from accerl_lerobot.world_model.contract import (
    Context,
    LearnableWorldModel,
    Prediction,
    Reset,
    State,
    WorldModel,
    WorldModelSpec,
)
from accerl_lerobot.world_model.data import model_arrays


class ShuffledModel(WorldModel):
    """Another model that gets the actions of another row."""

    def __init__(self, model: WorldModel) -> None:
        self.model, self.spec = model, model.spec

    def begin(self, context: Context, tasks: Sequence[str], resets: Sequence[Reset] | None = None) -> State:
        return self.model.begin(context, tasks, resets)

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        return self.model.step(state, actions.roll(1, 0), seeds)


def learned_part(model: WorldModel) -> LearnableWorldModel:
    """The model that is trained: the model itself, or the one inside a `ShuffledModel`."""
    model = model.model if isinstance(model, ShuffledModel) else model
    assert isinstance(model, LearnableWorldModel)  # as `ImaginationConfig.learns` says
    return model


class OracleModel(WorldModel):
    """Simulators that are put where a rollout starts: at a reset.

    A state holds the actions since the reset, so it can be continued more than once: the simulator of a row
    just goes on where it is there, and repeats these actions where it is not.
    """

    def __init__(self, environment: EnvironmentSpec, executed: int, make: Callable[[], Environment]) -> None:
        height, width, _ = next(iter(environment.images.values()))
        self.spec = WorldModelSpec(
            cameras=tuple(environment.images), image_size=(height, width), state_dim=environment.state_dim,
            action_dim=environment.action_dim, chunk=executed, fps=environment.fps, context=1,
            tasks=environment.tasks,
        )  # fmt: skip
        self._make, self._longest = make, environment.max_steps + executed
        self._simulators: list[Environment] = []
        self._where: list[bytes] = []

    def begin(self, context: Context, tasks: Sequence[str], resets: Sequence[Reset] | None = None) -> State:
        if resets is None:
            raise ValueError("an oracle needs the reset of every start")
        return {
            "task": torch.tensor([self.spec.tasks.index(reset.task) for reset in resets]),
            "seed": torch.tensor([reset.seed for reset in resets]),
            "count": torch.zeros(len(resets), dtype=torch.long),
            "played": torch.zeros(len(resets), self._longest, self.spec.action_dim),
        }

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        chunk, played = actions.shape[1], state["played"].clone()
        for i, n in enumerate(state["count"].tolist()):
            played[i, n : n + chunk] = actions[i]
        following = {**state, "count": state["count"] + chunk, "played": played}
        results = [self._play(state, i, actions[i].numpy()) for i in range(len(actions))]
        self._where = [_key(following, i) for i in range(len(actions))]
        names = [name for name in results[0].observation if name != TASK]
        observations = {n: np.stack([np.asarray(r.observation[n]) for r in results]) for n in names}
        frames, robot = model_arrays(observations, self.spec)
        return Prediction(
            state=following,
            frames=torch.from_numpy(frames),
            robot=torch.from_numpy(robot),
            uncertainty=torch.full((len(actions),), torch.nan),
            success=torch.tensor([float(r.success) for r in results]),
            done=torch.tensor([r.done for r in results]),
        )

    def close(self) -> None:
        """Closes the simulators."""
        for environment in self._simulators:
            environment.close()

    def _play(self, state: State, row: int, actions: np.ndarray) -> ChunkResult:
        if row == len(self._simulators):
            self._simulators.append(self._make())
        environment = self._simulators[row]
        if row >= len(self._where) or self._where[row] != _key(state, row):
            environment.reset(int(state["seed"][row]), self.spec.tasks[int(state["task"][row])])
            if n := int(state["count"][row]):
                environment.step_chunk(state["played"][row, :n].numpy())
        return environment.step_chunk(actions)


def _key(state: State, row: int) -> bytes:
    return b"".join(state[name][row].numpy().tobytes() for name in ("task", "seed", "count", "played"))
