# SPDX-License-Identifier: Apache-2.0
"""Training of a state model beside the one that acts.

Critic, teacher and memory use a model that stands still; its copy here learns. `publish` hands the copy's
weights over, after which remembered states are to be computed anew. `worker` has the same in a process of
its own.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from torch.nn.utils import clip_grad_norm_

from accerl_lerobot.checkpoint.tensors import copied, optimizer_state, restore_optimizer
from accerl_lerobot.errors import step_if_finite
from accerl_lerobot.experience import Observations
from accerl_lerobot.world_model.states import StateModel, Transitions

BATCH = 64  # transitions of a step
WEIGHT_DECAY = 1e-4
CLIP = 10.0  # largest norm of a gradient


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
        return {"count": self.count, "model": copied(self.model), "optimizer": optimizer}

    def restore(self, state: dict[str, Any]) -> None:
        """Resume from `state`."""
        self.count = state["count"]
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
