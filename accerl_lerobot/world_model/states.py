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
from accerl_lerobot.experience import ENVIRONMENT_STATE
from accerl_lerobot.world_model.config import StateModelConfig

Observations = dict[str, np.ndarray]
"""Arrays (B, ...) by LeRobot's names, as `experience.Observation` has them, without the instruction."""


class StateSpec(NamedTuple):
    """Sizes of what a state model reads, and of the chunks that its transitions hold."""

    cameras: tuple[str, ...]  # names of uint8 images (H, W, 3)
    state: int  # numbers of ``observation.state``, of all remembered env steps
    environment_state: int  # numbers of ``observation.environment_state``; 0 where there are none
    chunk: tuple[int, int]  # (K, A)


class Transitions(NamedTuple):
    """B decisions of remembered episodes; none is the last one of its episode."""

    observations: Observations
    following: Observations  # one decision later
    tasks: Sequence[str]  # instructions
    elapsed: Tensor  # float32 (B,), share of the time limit gone
    chunk: Tensor  # float32 (B, K, A), executed, in the policy's normalised units
    returns: Tensor  # float32 (B,), discounted, of the episode from here on
    success: Tensor  # bool (B,), of the episode


class StateModel(nn.Module, ABC):
    """A model of what critic and teacher see in place of observations.

    All its tensors are parameters: they are published with the policy's weights and saved with them.
    """

    size: int
    """Numbers of a state."""

    @abstractmethod
    def encode(self, observations: Observations, tasks: Sequence[str], elapsed: np.ndarray) -> Tensor:
        """States, float32 (B, S), where the model is; `elapsed` (B,) is the share of the time limit gone."""

    def fit(self, observations: Observations) -> None:
        """Take scales from all remembered observations; called before the first loss, and now and then."""

    def loss(self, transitions: Transitions) -> tuple[Tensor, dict[str, float]]:
        """Loss, a scalar, and metrics of a step of learning. Randomness is torch's global generator's."""
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


def new_state_model(spec: StateSpec, config: StateModelConfig) -> StateModel:
    """The untrained model that `config` names."""
    model: Any = imported(config.make)(spec, config)
    assert isinstance(model, StateModel)
    return model
