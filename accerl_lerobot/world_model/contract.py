# SPDX-License-Identifier: Apache-2.0
"""The interface of a world model: it starts at a real observation and predicts one action chunk at a time.

    state = model.begin(context, tasks)
    prediction = model.step(state, actions, seeds)    # .frames, .robot; the next step starts at .state

A learned one has a `loss` too; `pixels.py` has ours, and ``docs/world_model.md`` says how to add another.
Success is classified by another model, see `learners.py`.

States are dicts of tensors with the batch in front, so that rows can be selected; their other
sizes stay the same from step to step.

Shapes: B batch, L frames of context, V cameras, H×W pixels, S robot state dims, K env steps of a chunk, A
action dims.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.config.parsing import imported
from accerl_lerobot.config.ranges import Range, Section

if TYPE_CHECKING:
    from accerl_lerobot.world_model.config import LearnableModelConfig

State = dict[str, Tensor]  # each (B, ...)


def select_rows(state: State, chosen: Sequence[int] | np.ndarray) -> State:
    """Selects rows of the batch."""
    return {key: tensor[chosen] for key, tensor in state.items()}


Size = Annotated[int, Range("[1, 1000000]")]


@dataclass(frozen=True, kw_only=True)
class WorldModelSpec(Section, section="spec"):
    """Sizes of a world model, and the environment it models."""

    cameras: tuple[str, ...]  # ``observation.images.<camera>``, in the order of V
    image_size: tuple[Size, Size]  # (H, W)
    state_dim: Annotated[int, Range("[0, 1000000]")]  # S; 0: there is no ``observation.state``
    action_dim: Size
    chunk: Size  # K
    fps: Size  # env steps per second, which a dataset must have too
    context: Size  # L
    tasks: tuple[str, ...] = ()  # names of the environment's tasks; empty: unknown


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Predicted observation after a chunk."""

    state: State  # input of the next `WorldModel.step`
    frames: Tensor  # uint8 (B, V, H, W, 3)
    robot: Tensor  # float32 (B, S), in the environment's units
    uncertainty: Tensor  # float32 (B,), ≥ 0; 1: the 95th percentile on training data; NaN: the model has none


class Context(NamedTuple):
    """Observations until a rollout starts, a chunk apart, the newest last, which is the anchor too.

    With relative actions `commanded_sum` is where the robot is commanded to be, and may not be yet.
    """

    frames: Tensor  # uint8 (B, L, V, H, W, 3)
    robot: Tensor  # float32 (B, L, S)
    actions: Tensor  # float32 (B, L − 1, K, A), executed between these; zero where none was
    commanded_sum: Tensor  # float32 (B, A), of the actions since the episode began, or since they are known
    initial_state: Tensor  # float32 (B, S), the robot's state where that sum begins


def context_of(windows: Windows, rows: slice = slice(None)) -> Context:
    """A world model's context at the first frame of some windows."""
    length = windows.context
    return Context(
        frames=torch.from_numpy(windows.frames[rows, :length]),
        robot=torch.from_numpy(windows.state[rows, :length]),
        actions=torch.from_numpy(windows.before[rows]),
        commanded_sum=torch.from_numpy(windows.commanded_sum[rows]),
        initial_state=torch.from_numpy(windows.initial_state[rows]),
    )


class WorldModel(ABC):
    """A model that predicts observations from actions."""

    spec: WorldModelSpec

    @abstractmethod
    def begin(self, context: Context, tasks: Sequence[str]) -> State:
        """Starts B rollouts at their last real observations."""

    @abstractmethod
    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        """Predicts one chunk further from a state, which is not modified.

        Actions are float32 (B, K, A), in the environment's units. All randomness is that of B seeds, so a row
        does not depend on its batch.
        """


@dataclass(frozen=True, kw_only=True)
class Windows:
    """A batch of windows. Chunks beyond an episode's end repeat its last frame and are not `valid`."""

    frames: np.ndarray  # uint8 (B, L + R, V, H, W, 3): context, the first frame last, one after each chunk
    anchor: np.ndarray  # uint8 (B, V, H, W, 3), some chunks before the first, where a rollout began
    state: np.ndarray  # float32 (B, L + R, S), at each of the frames
    before: np.ndarray  # float32 (B, L − 1, K, A), actions within the context; zero where none was executed
    commanded_sum: np.ndarray  # float32 (B, A), the sum of the actions before the window's first frame
    initial_state: np.ndarray  # float32 (B, S), the robot's state when the episode began
    actions: np.ndarray  # float32 (B, R, K, A), zero where none was executed
    steps: np.ndarray  # int64 (B, R), how many of a chunk's actions lie between its frames; 0 beyond the end
    success: np.ndarray  # bool (B, R), True if the task was achieved in this chunk
    episode: np.ndarray  # int64 (B,), index of the episode
    task: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def valid(self) -> np.ndarray:
        """bool (B, R), True if the chunk's frame is at least one step later than the one before."""
        return self.steps > 0

    @property
    def context(self) -> int:
        """L."""
        return self.before.shape[1] + 1


class LearnableWorldModel(nn.Module, WorldModel):
    """A world model that is trained, see `learners.Learner`; its ``state_dict`` is what is saved.

    It moves its inputs to its own device: windows are arrays, and states and actions may be on the CPU.
    """

    uncertainty_scale: Tensor
    """Scalar that the uncertainty is divided by, see `validation.fit_uncertainty_scale`."""

    def __init__(self, spec: WorldModelSpec, config: LearnableModelConfig) -> None:
        super().__init__()
        self.spec, self.config = spec, config
        self.register_buffer("uncertainty_scale", torch.tensor(1.0))

    @abstractmethod
    def fit_statistics(self, windows: Windows) -> None:
        """Fits normalisation statistics to many windows, once, before the first loss."""

    @abstractmethod
    def loss(self, windows: Windows, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        """Loss of a batch of real windows, a scalar, and metrics; all randomness is the generator's."""


def new_model(spec: WorldModelSpec, config: LearnableModelConfig) -> LearnableWorldModel:
    """Builds an untrained model of the class that `config` names."""
    made: LearnableWorldModel = imported(config.make)(spec, config)
    return made
