# SPDX-License-Identifier: Apache-2.0
"""The interface of a world model: it begins at a real observation, and goes one action chunk at a time.

    state = model.begin(context, tasks)
    dream = model.step(state, actions, seeds)         # dream.frames, dream.robot; go on from dream.state

One that learns has a `loss` too; `pixels.py` has ours, and ``docs/world_model.md`` says how to bring another.
`kinds.py` has the table of what a run can dream with.

States are dicts of tensors with the batch in front, so that rows can be replaced, repeated and sent away. A
model says in its `spec` what it provides. Whether a frame shows a success is another model's judgement, see
`success.py`.

Shapes: B batch, L frames of context, V cameras, H×W pixels, S robot state dims, K env steps of a chunk, A
action dims.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.checkpoint.safety import brief
from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.config.imports import imported
from accerl_lerobot.errors import InputError

if TYPE_CHECKING:
    from accerl_lerobot.envs.base import World
    from accerl_lerobot.world_model.config import LearnableModelConfig
    from accerl_lerobot.world_model.episodes import Windows
    from accerl_lerobot.world_model.imagination_config import ImaginationConfig

State = dict[str, Tensor]
"""Each (B, ...)."""


def rows(state: State, chosen: Sequence[int] | np.ndarray) -> State:
    """Some of the batch."""
    return {key: tensor[chosen] for key, tensor in state.items()}


def replaced(state: State, at: list[int], fresh: State) -> State:
    """The state with some rows replaced; where a dimension grows with a dream, the shorter is padded."""
    merged = {}
    for key, old in state.items():
        new = fresh[key].to(old.device)
        sides = [max(a, b) for a, b in zip(old.shape[1:], new.shape[1:], strict=True)]
        old, new = (_padded(x, sides) for x in (old, new))
        merged[key] = old.clone()
        merged[key][at] = new
    return merged


def _padded(x: Tensor, sides: list[int]) -> Tensor:
    """At the far end of each dimension but the first."""
    missing = [n for want, have in zip(sides, x.shape[1:], strict=True) for n in (want - have, 0)]
    return torch.nn.functional.pad(x, missing[::-1]) if any(missing) else x


@dataclass(frozen=True, kw_only=True)
class WorldModelSpec:
    """Sizes of a world model, and the world that it is of."""

    cameras: tuple[str, ...]
    """``observation.images.<camera>``, in the order of V."""
    image_size: tuple[int, int]
    """(H, W)."""
    state_dim: int
    """S; 0: it has no ``observation.state``."""
    action_dim: int
    chunk: int
    """K."""
    fps: int
    """Env steps per second of the world, which a dataset's frames must have too."""
    context: int
    """L."""
    provides: frozenset[str]
    """Outputs among pixels, state, uncertainty, success."""
    tasks: tuple[str, ...] = ()
    """Names of the world's tasks; none: it does not say."""


@dataclass(frozen=True, kw_only=True)
class Dream:
    """Predicted observation after a chunk."""

    state: State
    """To go on from."""
    frames: Tensor
    """uint8 (B, V, H, W, 3)."""
    robot: Tensor
    """float32 (B, S), in the world's units."""
    uncertainty: Tensor
    """float32 (B,), ≥ 0; 1 is the 95th percentile on chunks it has learnt from. NaN where it has none."""
    success: Tensor | None = None
    """float32 (B,), P(the task has been achieved); None: a success model has to tell."""
    done: Tensor | None = None
    """bool (B,), whether the episode is over, with a success or without; None: only a success ends it."""


class Context(NamedTuple):
    """Observations until a dream begins, a chunk apart, the newest last. They are the anchor too."""

    frames: Tensor
    """uint8 (B, L, V, H, W, 3)."""
    robot: Tensor
    """float32 (B, L, S)."""
    actions: Tensor
    """float32 (B, L − 1, K, A), made between these; zero where none was made."""
    told: Tensor
    """float32 (B, A), the sum of all actions since the episode began, or since they are known: where a robot
    that is told how far to move is to be, and may not have got to."""
    first: Tensor
    """float32 (B, S), where it was then."""


@kind
class History(NamedTuple):
    """How to get to where a dream begins, for those that can go there."""

    task: str
    """Task of `World.reset`,"""
    seed: int
    """and this too."""
    actions: np.ndarray
    """float32 (t, A), made since."""


class WorldModel(ABC):
    """A world that is imagined."""

    spec: WorldModelSpec

    @abstractmethod
    def begin(
        self, context: Context, tasks: Sequence[str], histories: Sequence[History | None] | None = None
    ) -> State:
        """Starts an imagination.

        Args:
            context: what was seen so far.
            tasks: B instructions.
            histories: what led to each, where that is known.
        """

    @abstractmethod
    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Dream:
        """Goes on by one chunk.

        Args:
            state: of `begin`, or of the last dream; it is not changed.
            actions: float32 (B, K, A), in the world's units.
            seeds: B seeds of the randomness, so that a row does not depend on its batch.
        """


class LearnableWorldModel(nn.Module, WorldModel):
    """One that learns from real experience, see `learn.Learner`; what is saved is its ``state_dict``.

    Where it is, it moves what it is given to: windows are arrays, and states and actions may be on the CPU.

    Args:
        spec: of the world.
        config: its own, which is saved too.
    """

    doubt: Tensor
    """Scalar that its uncertainty is to be divided by; see `trial.calibrate`."""

    def __init__(self, spec: WorldModelSpec, config: LearnableModelConfig) -> None:
        super().__init__()
        self.spec, self.config = spec, config
        self.register_buffer("doubt", torch.tensor(1.0))

    @abstractmethod
    def fit_statistics(self, windows: Windows) -> None:
        """Takes what it normalises by from many windows, once, before the first loss."""

    @abstractmethod
    def loss(self, windows: Windows, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        """Loss of a batch of windows.

        Args:
            windows: of real episodes.
            generator: of all randomness.

        Returns:
            The loss, a scalar, and its parts, by the names that they have in metrics.
        """


def learnable_class(config: LearnableModelConfig) -> type[LearnableWorldModel]:
    """Class that `config` is of.

    Raises:
        InputError: nothing is there, or not what learns.
    """

    def refuse(why: str) -> InputError:
        return InputError("world_model.model.type", config.type, why)

    name = getattr(config, "make", "")
    try:
        made = imported(name)
    except (Exception, SystemExit) as error:  # it is somebody's code
        remedy = f"its config's make is {name!r}, which cannot be imported ({brief(error)}); use module:name"
        raise refuse(remedy) from error
    if not (isinstance(made, type) and issubclass(made, LearnableWorldModel)):
        raise refuse(f"{name} is no subclass of LearnableWorldModel")
    if lacking := sorted(made.__abstractmethods__):
        raise refuse(f"{name} lacks {', '.join(lacking)}")
    return made


def new_learnable(spec: WorldModelSpec, config: LearnableModelConfig) -> LearnableWorldModel:
    """The one that `config` is of, knowing nothing yet.

    Raises:
        InputError: see `learnable_class`; or it does not suit the world.
    """
    return learnable_class(config)(spec, config)


class Means(NamedTuple):
    """Ingredients of a world model of `kinds.KINDS`."""

    config: ImaginationConfig
    """The run's."""
    spec: WorldModelSpec
    """Spec of `learnt`; without that, of all that the real world shows."""
    learnt: LearnableWorldModel | None
    """The one in ``imagination.path``, in inference; None: its kind asks for no folder."""
    simulator: Callable[[], World]
    """A new one of the real world."""
    device: torch.device
    """Where it is to dream."""
