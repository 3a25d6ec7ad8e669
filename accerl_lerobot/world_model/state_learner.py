# SPDX-License-Identifier: Apache-2.0
"""Training of a state model beside the one that acts.

Critic, teacher and memory use a model that stands still; its copy here learns. `publish` hands the copy's
weights over, after which remembered states are to be computed anew.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch

from accerl_lerobot.checkpoint.tensors import copied, optimizer_state, restore_optimizer
from accerl_lerobot.world_model.states import StateModel, Transitions

BATCH = 64  # transitions of a step
LEARNING_RATE, WEIGHT_DECAY, CLIP = 1e-3, 1e-4, 10.0


class StateLearner:
    """Gradient steps on a copy of `model`."""

    def __init__(self, model: StateModel) -> None:
        self.model = copy.deepcopy(model).train()
        learned = [parameter for parameter in self.model.parameters() if parameter.requires_grad]
        self.optimizer = torch.optim.AdamW(learned, lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
        self.count = 0  # steps made

    @property
    def behind(self) -> int:
        """Steps to make before critic and teacher begin."""
        return max(0, self.model.first_steps - self.count)

    def step(self, transitions: Transitions, apply: Callable[..., object]) -> dict[str, float]:
        """Make a step by `BaseUpdate.apply`; returns the loss's parts."""
        loss, metrics = self.model.loss(transitions)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.optimizer.param_groups[0]["params"], CLIP)
        apply(self.optimizer, "a step of the world model", float(loss.detach()), float(norm))
        self.count += 1
        return metrics

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
