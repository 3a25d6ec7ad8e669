# SPDX-License-Identifier: Apache-2.0
"""The interface of a world model: it starts at a real observation and predicts one action chunk at a time.

    state = model.begin(context, tasks)
    prediction = model.step(state, actions, seeds)    # .frames, .robot; the next step starts at .state

A learned one has a `loss` too; `pixels.py` has ours, and ``docs/world_model.md`` says how to add another.
`registry.py` has what a run can imagine with. Success is classified by another model, see
`learners.py`.

States are dicts of tensors with the batch in front, so that rows can be selected and replaced.

Shapes: B batch, L frames of context, V cameras, H×W pixels, S robot state dims, K env steps of a chunk, A
action dims.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.checkpoint.safety import brief
from accerl_lerobot.config.parsing import imported
from accerl_lerobot.errors import InputError

if TYPE_CHECKING:
    from accerl_lerobot.world_model.config import LearnableModelConfig
    from accerl_lerobot.world_model.data import Windows

State = dict[str, Tensor]
"""Each (B, ...)."""


def select_rows(state: State, chosen: Sequence[int] | np.ndarray) -> State:
    """Selects rows of the batch."""
    return {key: tensor[chosen] for key, tensor in state.items()}


def replace_rows(state: State, at: list[int], fresh: State) -> State:
    """Replaces rows of the batch; where a dimension grows with a rollout, the shorter tensor is padded."""
    merged = {}
    for key, old in state.items():
        new = fresh[key].to(old.device)
        sides = [max(a, b) for a, b in zip(old.shape[1:], new.shape[1:], strict=True)]
        old, new = (_padded(x, sides) for x in (old, new))
        merged[key] = old.clone()
        merged[key][at] = new
    return merged


def _padded(x: Tensor, sides: list[int]) -> Tensor:
    """Pads at the far end of each dimension but the first."""
    missing = [n for want, have in zip(sides, x.shape[1:], strict=True) for n in (want - have, 0)]
    return torch.nn.functional.pad(x, missing[::-1]) if any(missing) else x


@dataclass(frozen=True, kw_only=True)
class WorldModelSpec:
    """Sizes of a world model, and the environment it models."""

    cameras: tuple[str, ...]
    """``observation.images.<camera>``, in the order of V."""
    image_size: tuple[int, int]
    """(H, W)."""
    state_dim: int
    """S; 0: there is no ``observation.state``."""
    action_dim: int
    chunk: int
    """K."""
    fps: int
    """Env steps per second, which a dataset must have too."""
    context: int
    """L."""
    provides: frozenset[str]
    """Outputs among pixels, state, uncertainty, success."""
    tasks: tuple[str, ...] = ()
    """Names of the environment's tasks; empty: unknown."""


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Predicted observation after a chunk."""

    state: State
    """Input of the next `WorldModel.step`."""
    frames: Tensor
    """uint8 (B, V, H, W, 3)."""
    robot: Tensor
    """float32 (B, S), in the environment's units."""
    uncertainty: Tensor
    """float32 (B,), ≥ 0; 1 is the 95th percentile on training data. NaN where the model has none."""
    success: Tensor | None = None
    """float32 (B,), P(the task has been achieved); None: a success model has to say."""
    done: Tensor | None = None
    """bool (B,), True where the episode is over, with a success or without; None: only a success ends it."""


class Context(NamedTuple):
    """Observations until a rollout starts, a chunk apart, the newest last. They are the anchor too."""

    frames: Tensor
    """uint8 (B, L, V, H, W, 3)."""
    robot: Tensor
    """float32 (B, L, S)."""
    actions: Tensor
    """float32 (B, L − 1, K, A), executed between these; zero where none was."""
    commanded_sum: Tensor
    """float32 (B, A), sum of the actions since the episode began, or since they are known. With relative
    actions this is where the robot is commanded to be, and may not be yet."""
    initial_state: Tensor
    """float32 (B, S), the robot's state where that sum begins."""


class Reset(NamedTuple):
    """Arguments of the `World.reset` at which a rollout starts, for models that repeat it."""

    task: str
    seed: int


class WorldModel(ABC):
    """A model that predicts observations from actions."""

    spec: WorldModelSpec

    @abstractmethod
    def begin(self, context: Context, tasks: Sequence[str], resets: Sequence[Reset] | None = None) -> State:
        """Starts B rollouts at their last real observations, or at resets of the environment."""

    @abstractmethod
    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        """Predicts one chunk further.

        Args:
            state: of `begin`, or of the last prediction; not modified.
            actions: float32 (B, K, A), in the environment's units.
            seeds: B seeds of the randomness, so that a row does not depend on its batch.
        """


class LearnableWorldModel(nn.Module, WorldModel):
    """A world model that is trained, see `learners.Learner`; its ``state_dict`` is what is saved.

    It moves its inputs to its own device: windows are arrays, and states and actions may be on the CPU.
    """

    uncertainty_scale: Tensor
    """Scalar that the uncertainty is divided by, see `validate.fit_uncertainty_scale`."""

    def __init__(self, spec: WorldModelSpec, config: LearnableModelConfig) -> None:
        super().__init__()
        self.spec, self.config = spec, config
        self.register_buffer("uncertainty_scale", torch.tensor(1.0))

    @abstractmethod
    def fit_statistics(self, windows: Windows) -> None:
        """Fits normalisation statistics to many windows, once, before the first loss."""

    @abstractmethod
    def loss(self, windows: Windows, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        """Loss of a batch of real windows; all randomness is the generator's.

        Returns:
            The loss, a scalar, and its parts by their names in metrics.
        """


def learnable_class(config: LearnableModelConfig) -> type[LearnableWorldModel]:
    """Imports the class of `config`, which is made from a `WorldModelSpec` and the config.

    Raises:
        InputError: it cannot be imported, or is not a complete `LearnableWorldModel`.
    """

    def refuse(why: str) -> InputError:
        return InputError("world_model.model.type", config.type, why)

    name = getattr(config, "make", "")
    try:
        made = imported(name)
    except (Exception, SystemExit) as error:  # third-party code
        remedy = f"its config's make is {name!r}, which cannot be imported ({brief(error)}); use module:name"
        raise refuse(remedy) from error
    if not (isinstance(made, type) and issubclass(made, LearnableWorldModel)):
        raise refuse(f"{name} is no subclass of LearnableWorldModel")
    if lacking := sorted(made.__abstractmethods__):
        raise refuse(f"{name} lacks {', '.join(lacking)}")
    return made
