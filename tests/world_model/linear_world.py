# SPDX-License-Identifier: Apache-2.0
"""A world model that a user might bring: what is seen stays, and the robot moves as a line says.

``--world_model.discover_packages_path=tests.world_model.linear_world --world_model.model.type=linear``
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.config import LearnableModelConfig
from accerl_lerobot.world_model.contract import (
    Context,
    LearnableWorldModel,
    Prediction,
    State,
    Windows,
    WorldModelSpec,
)


@LearnableModelConfig.register_subclass("linear")
@dataclass(frozen=True, kw_only=True)
class LinearModelConfig(LearnableModelConfig):
    """Settings of the model."""

    make = "tests.world_model.linear_world:LinearWorldModel"

    gain: float = 1.0
    """Factor on its motions; > 0."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.gain > 0:
            raise InputError("world_model.model.gain", self.gain, "use a positive number")


class LinearWorldModel(LearnableWorldModel):
    """s′ = s + gain · (W a + b), with a all actions of the chunk that are executed."""

    def __init__(self, spec: WorldModelSpec, config: LinearModelConfig) -> None:
        super().__init__(spec, config)
        self.gain = config.gain
        self.motion = nn.Linear(spec.chunk * spec.action_dim, spec.state_dim)
        self.register_buffer("scale", torch.ones(spec.state_dim))

    def fit_statistics(self, windows: Windows) -> None:
        """The usual size of a motion."""
        moved = windows.robot[:, 0] - windows.context.robot[:, -1]
        self.scale.copy_(moved.std(0).clamp(min=1e-3))

    def begin(self, context: Context, tasks: Sequence[str]) -> State:
        return {"frames": context.frames[:, -1], "robot": context.robot[:, -1]}

    @torch.no_grad()
    def step(self, state: State, actions: Tensor) -> Prediction:
        robot = state["robot"] + self._moved(actions)
        return Prediction(state=state | {"robot": robot}, frames=state["frames"], robot=robot)

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, float]]:
        """Mean squared error of the first motion."""
        moved = windows.robot[:, 0] - windows.context.robot[:, -1]
        error = self._moved(windows.actions[:, 0]) - moved
        loss = (error / self.scale).square().mean()
        return loss, {"motion": loss.item()}

    def _moved(self, actions: Tensor) -> Tensor:
        moved: Tensor = self.gain * self.scale * self.motion(actions.flatten(1))
        return moved
