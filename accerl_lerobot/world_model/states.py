# SPDX-License-Identifier: Apache-2.0
"""State models, which off-policy learning stands on: their interface, and the training of one.

    observations ──encode──► state ──► critic, teacher
         ▲                                │ acts
         └────────── environment ◄────────┘

A type is registered under `config.StateModelConfig`. A type that defines `loss` learns from the run's own
episodes; a type without stays as it is. Critic, teacher and memory use a model that stands still. A
`StateLearner` trains a copy of that model. `publish` hands the copy's weights over, after which remembered
states are to be computed anew. `worker` has the same in a process of its own.

Shapes: B rows, S numbers of a state, K executed actions of A dims.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_

from accerl_lerobot.checkpoint.tensors import copied, optimizer_state, restore_optimizer
from accerl_lerobot.config.parsing import imported
from accerl_lerobot.errors import InputError, step_if_finite
from accerl_lerobot.experience import ENVIRONMENT_STATE, Observations
from accerl_lerobot.world_model.config import StateModelConfig

BATCH = 64  # transitions of a step of the learner
WEIGHT_DECAY = 1e-4
CLIP = 10.0  # largest norm of a gradient


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

    observations: Observations  # the policy's: without ``observation.environment_state``
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


class StateLearner:
    """Gradient steps on a copy of `model`."""

    busy = False
    """True while steps that were submitted are not made yet."""

    def __init__(self, model: StateModel) -> None:
        self.model = copy.deepcopy(model).train()
        learned = [parameter for parameter in self.model.parameters() if parameter.requires_grad]
        self.optimizer = torch.optim.AdamW(
            learned, lr=model.learning_rate, weight_decay=WEIGHT_DECAY, fused=True
        )
        self.count = 0  # steps made
        self._learned = learned
        self._skipped_in_a_row = 0
        self._made: list[dict[str, float]] = []

    @property
    def behind(self) -> int:
        """Steps to submit before critic and teacher begin."""
        return max(0, self.model.first_steps - self.count)

    @property
    def ready(self) -> bool:
        """True once the first steps are made, after which critic and teacher may begin."""
        return self.behind == 0

    def submit(self, transitions: Transitions, numbers: Observations) -> None:
        """Make a step on each `BATCH` of transitions; `numbers` are all that is remembered without images."""
        self.model.fit(numbers)
        transitions = transitions.to(self._learned[0].device)
        for rows in np.arange(len(transitions.tasks)).reshape(-1, BATCH):
            self._made.append(self._step(transitions.rows(rows)))

    def wait(self) -> None:
        """Wait until all that was submitted is made."""

    def collect(self) -> list[dict[str, float]]:
        """Parts of the loss in each step since the last call."""
        made = self._made
        self._made = []
        return made

    def publish(self, model: StateModel) -> None:
        """Copy the weights of now into the model that acts."""
        model.load_state_dict(self.model.state_dict())

    def state(self) -> dict[str, Any]:
        """A copy of all that `restore` needs."""
        optimizer = optimizer_state(self.optimizer)
        return {
            "count": self.count,
            "skipped_in_a_row": self._skipped_in_a_row,
            "model": copied(self.model),
            "optimizer": optimizer,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Resume from `state`."""
        self.count = state["count"]
        self._skipped_in_a_row = state["skipped_in_a_row"]
        self.model.load_state_dict(state["model"])
        restore_optimizer(self.optimizer, state["optimizer"])

    def _step(self, transitions: Transitions) -> dict[str, float]:
        loss, metrics = self.model.loss(transitions)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = clip_grad_norm_(self._learned, CLIP)
        self.count += 1
        self._skipped_in_a_row = step_if_finite(
            self.optimizer,
            "a step of the world model",
            float(loss.detach()),
            float(norm),
            self._skipped_in_a_row,
            "look at the observations and actions of the run, or name another world_model.type",
        )
        return metrics
