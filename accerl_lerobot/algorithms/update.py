# SPDX-License-Identifier: Apache-2.0
"""The base of all updates: one optimiser around one adapter, its learning rate, and steps left out."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import nn

from accerl_lerobot.algorithms import AlgorithmConfig, ranks
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.algorithms.probe import CRITIC_PREFIX
from accerl_lerobot.checkpoint.snapshot import State
from accerl_lerobot.checkpoint.tensors import optimizer_state, restore_optimizer
from accerl_lerobot.config.parsing import imported
from accerl_lerobot.errors import step_if_finite
from accerl_lerobot.experience import Metrics, Segment
from accerl_lerobot.policies.teacher import TEACHER_PREFIX

logger = logging.getLogger(__name__)

STD_EPSILON = 1e-6  # added to a standard deviation: numbers that are all equal become 0, not noise


def make_update(adapter: Any, algorithm: AlgorithmConfig, config: TrainerConfig) -> BaseUpdate:
    """The updates that belong to an algorithm. A policy that does not look at its images is warned of."""
    if not adapter.sees():
        hint = "train it with a lower learning rate or a longer warm-up (sft.policy.scheduler_warmup_steps)"
        logger.warning("policy.path: the policy acts the same whatever its images show; %s", hint)
    return imported(algorithm.update)(adapter, algorithm, config)


class BaseUpdate(ABC):
    """The optimiser around one adapter, and what the updates of all algorithms share."""

    def __init__(self, adapter: Any, algorithm: Any, config: TrainerConfig) -> None:
        ranks.prepare(adapter, config)
        self.adapter = adapter
        self.algorithm = algorithm
        self.config = config
        self.version = 0  # updates made
        self.skipped = 0
        self._skipped_in_a_row = 0
        self._policy: list[nn.Parameter] = []
        self._value: list[nn.Parameter] = []
        for name, parameter in adapter.trainable().items():
            if name.startswith(CRITIC_PREFIX):
                self._value.append(parameter)
            elif not name.startswith(TEACHER_PREFIX):
                self._policy.append(parameter)
        self.optimizer = torch.optim.AdamW(
            self._policy, lr=config.lr, betas=config.betas, weight_decay=0.0, fused=True
        )

    @abstractmethod
    def step(self, segments: Sequence[Segment]) -> Metrics:
        """Learns from new segments and returns metrics; the version rises by one.

        The run reads ``lag_mean`` and ``lag_max`` among the metrics, see `objective.lag_metrics`.
        """

    def state(self) -> State:
        """A copy of all that `restore` needs, the policy's weights apart; see `snapshot`."""
        return {
            "version": self.version,
            "skipped": self.skipped,
            "skipped_in_a_row": self._skipped_in_a_row,
            "schedule_updates": self.config.updates,
            "optimizer": optimizer_state(self.optimizer),
        }

    def restore(self, state: State) -> None:
        """Resume from `state`; the adapter has its weights already."""
        self.version = state["version"]
        self.skipped = state["skipped"]
        self._skipped_in_a_row = state["skipped_in_a_row"]
        # A resumed run with more updates keeps the schedule that it began with, so that rates do not jump.
        self.config = replace(self.config, updates=state["schedule_updates"])
        restore_optimizer(self.optimizer, state["optimizer"])

    def spare_policy(self) -> None:
        """Drops the policy's gradient in the first updates, which are the critic's alone.

        Its moments in the optimiser so begin with its learning rate.
        """
        if self.version < self.config.value_warmup_updates:
            for parameter in self._policy:
                parameter.grad = None

    def lr_share(self, start: int = 0) -> float:
        """Share of the peak of a learning rate that begins with update `start`."""
        return self.config.lr_share(self.version, start)

    def apply(self, optimizer: torch.optim.Optimizer, step: str, loss: float, norm: float) -> None:
        """Makes a step, unless its loss or its gradient's norm is not finite; those are counted.

        Raises:
            NonFiniteError: `errors.MAX_NONFINITE` of them since the policy's last step.
        """
        hint = "lower trainer.lr or trainer.value_lr"
        in_a_row = step_if_finite(optimizer, step, loss, norm, self._skipped_in_a_row, hint)
        if in_a_row:
            self.skipped += 1
        if in_a_row or optimizer is self.optimizer:
            self._skipped_in_a_row = in_a_row
