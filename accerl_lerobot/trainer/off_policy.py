# SPDX-License-Identifier: Apache-2.0
"""Updates from a memory of all episodes: the loop that off-policy algorithms share, self-imitation, and AWR.

demonstrations, then new episodes → memory → gradient steps of the policy, so many for each new decision
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from accerl_lerobot.algorithms import AWRConfig, OffPolicyConfig
from accerl_lerobot.algorithms.advantages import STD_EPSILON
from accerl_lerobot.algorithms.objective import lag_metrics
from accerl_lerobot.checkpoint.tensors import optimizer_state, restore_optimizer
from accerl_lerobot.experience import Segment
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.family import Encoded
from accerl_lerobot.policies.teacher import PREFIX
from accerl_lerobot.trainer.batch import MAX_NONFINITE, NonFiniteError
from accerl_lerobot.trainer.config import TrainerConfig
from accerl_lerobot.trainer.memory import Memory
from accerl_lerobot.trainer.probe import CRITIC

POLICY_BATCH = 64
"""Rows of one step of the policy."""
FORGET = 0.99
"""Share of the mean square of R − V that a step keeps."""


class OffPolicyUpdate:
    """Has the methods of `update.Update`, and stands in its place. As it is, imitates successful episodes.

    Args:
        config: the optimiser; ``batch_decisions`` of new experience make one update.
    """

    n_step = 1
    """Decisions after which a target bootstraps."""

    def __init__(self, adapter: LeRobotAdapter, algorithm: OffPolicyConfig, config: TrainerConfig) -> None:
        self.adapter, self.config = adapter, config
        self.policy_steps = algorithm.policy_steps
        self.memory = Memory(algorithm.memory, algorithm.gamma, self.n_step)
        self.version = self.skipped = self._skipped_in_a_row = 0
        self._owed: dict[str, float] = {}
        self._schedule_updates = config.updates
        self._policy = [p for k, p in adapter.trainable().items() if not k.startswith((CRITIC, PREFIX))]
        self.optimizer = torch.optim.AdamW(self._policy, lr=config.lr, betas=config.betas, weight_decay=0.0)

    def step(self, segments: Sequence[Segment]) -> dict[str, float]:
        """Learns from new episodes and from those before; the version rises by one.

        Returns:
            Its metrics.

        Raises:
            InputError: a segment is not a whole episode.
            NonFiniteError: see `update.Update.step`.
        """
        if not self.memory.total and self.adapter.demonstrations is not None:
            for demonstration in self.adapter.demonstrations(segments[0]):
                self.remember(demonstration)
        for segment in segments:
            self.remember(segment)
        metrics = {"decisions": float(sum(map(len, segments))), "memory_decisions": float(len(self.memory))}
        rewards = np.concatenate([segment.reward for segment in segments])
        metrics |= {"reward_mean": float(rewards.mean())}
        if len(self.memory):
            metrics |= self.learn(len(rewards))
        versions = torch.from_numpy(np.concatenate([segment.version for segment in segments]))
        metrics |= {name: float(value) for name, value in lag_metrics(versions, self.version).items()}
        self.version += 1
        return metrics | {"skipped": float(self.skipped)}

    def learn(self, new: int) -> dict[str, float]:
        """Makes all steps that so many new decisions allow."""
        return self.policy_learns(new)

    def imitable(self) -> np.ndarray:
        """Rows of the memory that the policy imitates."""
        return np.flatnonzero(self.memory["success"])

    def target(self, rows: np.ndarray) -> Tensor:
        """Chunks (B, K, A) for the policy to imitate, in normalised units."""
        return self.tensor("chunk", rows)

    def weight(self, rows: np.ndarray, encoded: Encoded) -> Tensor | float:
        """Factor on the imitation loss of each row, (B,) or one for all; arguments as of `auxiliary`."""
        return 1.0

    def auxiliary(self, rows: np.ndarray, encoded: Encoded) -> dict[str, Tensor]:
        """Further losses of a step of the policy, by name, already weighted.

        Args:
            rows: (B,) of the memory.
            encoded: their observations, differentiable.
        """
        return {}

    def state(self) -> dict[str, Any]:
        """A copy of all that `restore` needs, the policy's weights apart; see `snapshot`."""
        return {
            "version": self.version,
            "skipped": (self.skipped, self._skipped_in_a_row),
            "schedule_updates": self._schedule_updates,
            "owed": dict(self._owed),
            "memory": self.memory.state(),
            "optimizer": optimizer_state(self.optimizer),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Resume from `state`; the adapter has its weights already."""
        self.version = state["version"]
        self.skipped, self._skipped_in_a_row = state["skipped"]
        self._schedule_updates, self._owed = state["schedule_updates"], dict(state["owed"])
        self.memory.restore(state["memory"])
        restore_optimizer(self.optimizer, state["optimizer"])

    def steps(self, name: str, each: float, new: int) -> range:
        """As many steps as are due at ``each`` for a new decision; what is left over is due later."""
        owed = self._owed.get(name, 0.0) + each * new
        due = int(owed)
        self._owed[name] = owed - due
        return range(due)

    def policy_learns(self, new: int) -> dict[str, float]:
        """The policy's steps of this update; none before ``value_warmup_updates``."""
        start = self.config.value_warmup_updates
        lr = self.config.lr * self.config.lr_share(self.version, start=start, updates=self._schedule_updates)
        self.optimizer.param_groups[0]["lr"] = lr
        metrics = {"lr": lr}
        if self.version >= start and len(rows := self.imitable()):
            metrics |= mean(self._policy_step(rows) for _ in self.steps("policy", self.policy_steps, new))
        return metrics

    def remember(self, segment: Segment) -> None:
        """Adds a whole episode to the memory."""
        executed = self.adapter.processing.normalise(torch.from_numpy(segment.actions))
        self.memory.add(segment, executed.numpy())

    def tensor(self, name: str, rows: np.ndarray) -> Tensor:
        """Rows of a column, where the policy lives."""
        return torch.from_numpy(self.memory[name][rows]).to(self.adapter.device)

    def _policy_step(self, imitable: np.ndarray) -> dict[str, float]:
        """One gradient step on rows drawn from `imitable`."""
        rows = imitable[torch.randint(len(imitable), (POLICY_BATCH,)).numpy()]
        metrics: dict[str, float] = {}
        self.optimizer.zero_grad(set_to_none=True)
        for part in np.array_split(rows, math.ceil(len(rows) / self.config.micro_batch)):
            with self.adapter.autocast():
                encoded = self.adapter.encode(*self.memory.observations(part))
                imitation = self.adapter.family.imitation_loss(encoded, self.target(part)).float()
            weighted = (self.weight(part, encoded) * imitation).mean()
            losses = {"imitation_loss": weighted} | self.auxiliary(part, encoded)
            losses = {name: len(part) / len(rows) * value for name, value in losses.items()}
            torch.stack(list(losses.values())).sum().backward()
            for name, value in losses.items():
                metrics[name] = metrics.get(name, 0.0) + float(value.detach())
        loss = sum(metrics.values())
        norm = float(torch.nn.utils.clip_grad_norm_(self._policy, self.config.grad_clip))
        if math.isfinite(loss + norm):
            self.optimizer.step()
            self._skipped_in_a_row = 0
        else:
            self.skip("a step of the policy", loss, norm)
        return metrics | {"policy_loss": loss, "grad_norm": norm}

    def skip(self, step: str, loss: float, norm: float) -> None:
        """Counts a step that was left out because its loss or gradient is not finite.

        Raises:
            NonFiniteError: `MAX_NONFINITE` of them since the policy's last step.
        """
        self.skipped += 1
        self._skipped_in_a_row += 1
        if self._skipped_in_a_row >= MAX_NONFINITE:
            raise NonFiniteError(
                f"{self._skipped_in_a_row} steps in a row had a non-finite loss or gradient (the last one, "
                f"{step}: loss {loss:g}, gradient norm {norm:g}); lower trainer.lr or trainer.value_lr"
            )


class AWRUpdate(OffPolicyUpdate):
    """Advantage-weighted regression, see `AWRConfig`; the critic is the adapter's."""

    def __init__(self, adapter: LeRobotAdapter, algorithm: AWRConfig, config: TrainerConfig) -> None:
        super().__init__(adapter, algorithm, config)
        self.algorithm = algorithm
        self._variance = 0.0
        """Mean square of R − V, over some hundred steps."""
        value = {"params": list(adapter.value_head.parameters()), "lr": config.value_lr}
        self.optimizer.add_param_group(value)

    def learn(self, new: int) -> dict[str, float]:
        share = self.config.lr_share(self.version, updates=self._schedule_updates)
        self.optimizer.param_groups[1]["lr"] = self.config.value_lr * share
        return super().learn(new)

    def imitable(self) -> np.ndarray:
        """See the base class: of failures too, what went better than expected."""
        return np.arange(len(self.memory))

    def weight(self, rows: np.ndarray, encoded: Encoded) -> Tensor:
        error = self._error(rows, encoded).detach()
        square = float(error.square().mean())
        self._variance = FORGET * self._variance + (1 - FORGET) * square if self._variance else square
        advantage = error / max(math.sqrt(self._variance), STD_EPSILON)
        return weights(advantage, self.algorithm.beta, self.algorithm.cap)

    def auxiliary(self, rows: np.ndarray, encoded: Encoded) -> dict[str, Tensor]:
        return {"value_loss": self._error(rows, encoded).square().mean()}

    def state(self) -> dict[str, Any]:
        return super().state() | {"variance": self._variance}

    def restore(self, state: dict[str, Any]) -> None:
        super().restore(state)
        self._variance = state["variance"]

    def _error(self, rows: np.ndarray, encoded: Encoded) -> Tensor:
        """R − V(o), (B,), with the critic's gradient."""
        value: Tensor = self.adapter.value_head(encoded.features, encoded.mask)
        return self.tensor("return", rows) - value


def weights(advantage: Tensor, beta: float, cap: float) -> Tensor:
    """min(exp(advantage / beta), cap), limited before the exponential, which would overflow."""
    return (advantage / beta).clamp(max=math.log(cap)).exp()


def mean(steps: Iterator[dict[str, float]]) -> dict[str, float]:
    """Means over steps; empty without any."""
    made = list(steps)
    return {name: sum(step[name] for step in made) / len(made) for name in (made[0] if made else ())}
