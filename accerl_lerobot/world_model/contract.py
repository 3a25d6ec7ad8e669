# SPDX-License-Identifier: Apache-2.0
"""The interface of a pixel world model: it starts at real observations and predicts one chunk at a time.

    state = model.begin(context, tasks)
    prediction = model.step(state, actions, seeds)    # .frames, .robot; the next step starts at .state

It learns by `loss`. `pixels.py` has our model, and ``docs/world_model.md`` says how to add another.

States are dicts of tensors with the batch in front. Shapes: B batch, L frames of context, R chunks of a
window, V cameras, H×W pixels, S robot state dims, K env steps of a chunk, A action dims.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, NamedTuple

import torch
from torch import Tensor, nn

from accerl_lerobot.config.parsing import imported
from accerl_lerobot.config.ranges import Range, Section
from accerl_lerobot.experience import task_codes

if TYPE_CHECKING:
    from accerl_lerobot.world_model.config import LearnableModelConfig

State = dict[str, Tensor]  # each (B, ...)
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
    tasks: tuple[str, ...] = ()  # instructions of the episodes it was trained on; empty: unknown


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Predicted observation after a chunk."""

    state: State  # input of the next `LearnableWorldModel.step`
    frames: Tensor  # uint8 (B, V, H, W, 3)
    robot: Tensor  # float32 (B, S), in the environment's units


class Context(NamedTuple):
    """Observations until a rollout starts, a chunk apart, the newest last.

    The episode's beginning is part of it. With relative actions `commanded_sum` tells the place that the
    robot is commanded to be at, and may not have reached yet.
    """

    frames: Tensor  # uint8 (B, L, V, H, W, 3)
    robot: Tensor  # float32 (B, L, S)
    actions: Tensor  # float32 (B, L − 1, K, A), executed between these; zero before the episode began
    first_frame: Tensor  # uint8 (B, V, H, W, 3), of the episode
    first_robot: Tensor  # float32 (B, S), of the episode
    commanded_sum: Tensor  # float32 (B, A), of the actions since the episode began


@dataclass(frozen=True, kw_only=True)
class Windows:
    """A batch of windows. Chunks beyond an episode's end repeat its last frame and its last action."""

    context: Context
    frames: Tensor  # uint8 (B, R, V, H, W, 3), after each chunk
    robot: Tensor  # float32 (B, R, S), after each chunk
    actions: Tensor  # float32 (B, R, K, A)
    steps: Tensor  # int64 (B, R), how many of a chunk's actions lie between its frames; 0 beyond the end
    success: Tensor  # bool (B, R), True if the task was achieved in this chunk
    episode: Tensor  # int64 (B,), index of the episode
    tasks: tuple[str, ...]  # B instructions

    @property
    def known(self) -> Tensor:
        """bool (B, R), True until the episode ended or achieved the task, that chunk included."""
        successes_before = self.success.cumsum(1) - self.success.long()
        return ((self.steps > 0) | self.success) & (successes_before == 0)

    @property
    def known_tasks(self) -> Tensor:
        """float32 (N, 16), `task_codes` of the N chunks that are `known`."""
        codes = torch.from_numpy(task_codes(self.tasks))
        return codes.repeat_interleave(self.known.sum(1), 0)


class LearnableWorldModel(nn.Module):
    """A world model that is trained, see `training.Trainer`; its ``state_dict`` is saved.

    It moves its inputs to its own device: windows, states and actions may be on the CPU.
    """

    def __init__(self, spec: WorldModelSpec, config: LearnableModelConfig) -> None:
        super().__init__()
        self.spec = spec
        self.config = config

    @abstractmethod
    def fit_statistics(self, windows: Windows) -> None:
        """Fits normalisation statistics to many windows, once, before the first loss."""

    @abstractmethod
    def begin(self, context: Context, tasks: Sequence[str]) -> State:
        """Starts B rollouts at their last real observations."""

    @abstractmethod
    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        """Predicts one chunk further from a state, which is not modified.

        Actions are float32 (B, K, A), in the environment's units. All randomness is that of B seeds, so a row
        does not depend on its batch.
        """

    @abstractmethod
    def loss(self, windows: Windows, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        """Loss of a batch of real windows, a scalar, and metrics; all randomness is the generator's."""


def new_model(spec: WorldModelSpec, config: LearnableModelConfig) -> LearnableWorldModel:
    """Builds an untrained model of the class that `config` names."""
    made: LearnableWorldModel = imported(config.make)(spec, config)
    return made


@torch.no_grad()
def replay(model: LearnableWorldModel, windows: Windows, rows_at_once: int = 64) -> Tensor:
    """Frames predicted after each chunk from the executed actions, uint8 (B, R, V, H, W, 3), on the CPU."""
    parts = []
    for rows in torch.arange(len(windows.tasks)).split(rows_at_once):
        context = Context(*(tensor[rows] for tensor in windows.context))
        state = model.begin(context, [windows.tasks[row] for row in rows.tolist()])
        frames = []
        for chunk in range(windows.actions.shape[1]):
            seeds = (rows + 1_000_003 * chunk).tolist()
            prediction = model.step(state, windows.actions[rows, chunk], seeds)
            frames.append(prediction.frames.cpu())
            state = prediction.state
        parts.append(torch.stack(frames, 1))
    return torch.cat(parts)
