# SPDX-License-Identifier: Apache-2.0
"""The interface of a world model that off-policy learning stands on: observations in, states out.

    observations ──encode──► state ──► critic, teacher
         ▲                                │ acts
         └────────── environment ◄────────┘

A type is registered under `config.StateModelConfig`. One that defines `loss` learns from the run's own
episodes (`state_learner`); one that does not stays as it is.

Shapes: B rows, S numbers of a state, K executed actions of A dims.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.config.parsing import imported
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import ENVIRONMENT_STATE, Observations
from accerl_lerobot.world_model.config import StateModelConfig


class StateSpec(NamedTuple):
    """Sizes of what a state model reads, and of the chunks that its transitions hold."""

    cameras: dict[str, int]  # name → channels C of uint8 images (H, W, C)
    state: int  # numbers of ``observation.state``, of all ``n_obs_steps`` together; 0 where there are none
    environment_state: int  # numbers of ``observation.environment_state``; 0 where there are none
    chunk: tuple[int, int]  # (K, A)
    units: tuple[np.ndarray, np.ndarray] | None = None
    """An action in environment units is the first (A,) plus the second (A,) times the normalised one; None
    where no transition will come."""


class Transitions(NamedTuple):
    """B decisions of remembered episodes; none is the last one of its episode."""

    observations: Observations
    following: Observations  # one decision later
    tasks: Sequence[str]  # instructions
    elapsed: Tensor  # float32 (B,), share of the time limit gone
    chunk: Tensor  # float32 (B, K, A), executed, in the policy's normalised units
    returns: Tensor  # float32 (B,), discounted, of the episode from here on
    success: Tensor  # bool (B,), of the episode

    def rows(self, chosen: np.ndarray) -> Transitions:
        """Copies of some of them."""
        return Transitions(
            observations={name: values[chosen] for name, values in self.observations.items()},
            following={name: values[chosen] for name, values in self.following.items()},
            tasks=[self.tasks[row] for row in chosen],
            elapsed=self.elapsed[chosen],
            chunk=self.chunk[chosen],
            returns=self.returns[chosen],
            success=self.success[chosen],
        )

    def to(self, device: torch.device | str) -> Transitions:
        """The same, with the tensors on a device."""
        fields = self._asdict()
        tensors = {name: value.to(device) for name, value in fields.items() if isinstance(value, Tensor)}
        return self._replace(**tensors)


class StateModel(nn.Module, ABC):
    """A model whose states critic and teacher see.

    Its parameters and buffers are published and saved with the policy's weights.
    """

    size: int
    """Numbers of a state."""
    first_steps = 1000
    """Gradient steps of a model that learns before critic and teacher begin."""
    steps_per_decision = 0.5
    """Gradient steps of a model that learns for each new decision."""
    learning_rate = 1e-3
    """Learning rate of these steps, which AdamW makes."""

    @abstractmethod
    def encode(self, observations: Observations, tasks: Sequence[str], elapsed: np.ndarray) -> Tensor:
        """States, float32 (B, S), on any device; `elapsed` (B,) is the share of the time limit gone."""

    def fit(self, observations: Observations) -> None:
        """Take scales from the numbers of all remembered observations, images left out.

        It is called before the first loss, and again before each part of an update's steps.
        """

    def loss(self, transitions: Transitions) -> tuple[Tensor, dict[str, float]]:
        """Loss, a scalar, and metrics; called once before each gradient step, on the model's own device.

        Randomness is torch's global generator's.
        """
        raise NotImplementedError

    @property
    def learns(self) -> bool:
        """True if it has a `loss`."""
        return type(self).loss is not StateModel.loss


class SimulatorState(StateModel):
    """The simulator's own numbers, which end with the share of the time limit gone."""

    def __init__(self, spec: StateSpec, config: StateModelConfig) -> None:
        super().__init__()
        self.size = spec.environment_state

    def encode(self, observations: Observations, tasks: Sequence[str], elapsed: np.ndarray) -> Tensor:
        numbers = observations[ENVIRONMENT_STATE]
        return torch.from_numpy(numbers.reshape(len(numbers), -1).astype(np.float32))


def can_learn(config: StateModelConfig) -> bool:
    """True if models of this type have a `loss`."""
    return getattr(imported(config.make), "loss", StateModel.loss) is not StateModel.loss


def new_state_model(spec: StateSpec, config: StateModelConfig) -> StateModel:
    """The untrained model that `config` names, which does not learn by itself.

    Raises:
        InputError: it is no `StateModel`, or cannot read what the policy reads.
    """
    model: Any = imported(config.make)(spec, config)
    if not isinstance(model, StateModel):
        hint = f"{config.make} is no accerl_lerobot.world_model.states.StateModel; derive it from that"
        raise InputError("world_model.type", config.type, hint)
    return model.eval()
