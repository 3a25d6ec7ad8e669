# SPDX-License-Identifier: Apache-2.0
"""Updates from a memory of all episodes: the loop that off-policy algorithms share, self-imitation, and AWR.

demonstrations, then new episodes → memory → gradient steps of the policy, so many for each new decision

Shapes: B rows, K executed actions of A dims.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from accerl_lerobot.algorithms import AWRConfig, OffPolicyConfig
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.algorithms.objective import lag_metrics
from accerl_lerobot.algorithms.update import STD_EPSILON, BaseUpdate
from accerl_lerobot.checkpoint.snapshot import State
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import ENVIRONMENT_STATE, Metrics, Observations, Segment
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.family import Encoded
from accerl_lerobot.policies.stock import StockAdapter

POLICY_BATCH = 64  # rows of one step of the policy
CAP = 20.0  # largest weight of a decision in AWR, the paper's
FORGET = 0.99  # share of the mean square of R − V that a step keeps
FIRST = 1024  # rows that a column has space for at first; a full one doubles


class Memory:
    """Rows of whole episodes; `following` points `n_step` decisions ahead."""

    def __init__(self, capacity: int, gamma: float, n_step: int) -> None:
        self.capacity = capacity
        self.gamma = gamma
        self.n_step = n_step
        self.total = 0  # rows ever added
        self._columns: dict[str, np.ndarray] = {}
        self.tasks: list[str] = []

    def __len__(self) -> int:
        return min(self.total, self.capacity)

    def __getitem__(self, name: str) -> np.ndarray:
        """A column, (len, ...).

        ``chunk`` float32 (K, A); ``following``, the row `n_step` decisions on; ``reward``, discounted, of
        the decisions before that; ``discount``, of what follows, 0 where the episode ends before;
        ``return``, discounted, of the episode from here on; ``success``, of the episode; ``task``, a place
        in `tasks`; ``observation.*``.
        """
        return self._columns[name][: len(self)]

    def add(self, segment: Segment, chunk: np.ndarray, **more: np.ndarray) -> None:
        """Adds an episode of T decisions, with `more` columns (T, ...).

        `chunk`, (T, K, A), was executed, normalised.
        """
        t = len(segment)
        if segment.origin.decision or not segment.terminated or t > self.capacity:
            hint = f"the memory holds whole episodes of at most algorithm.memory={self.capacity} decisions"
            raise InputError("rollout.segment_length", t, hint)
        decisions = np.arange(t)
        rows = (self.total + decisions) % self.capacity
        returns = np.zeros(t + 1)
        for i in reversed(range(t)):
            returns[i] = segment.reward[i] + self.gamma * returns[i + 1]
        bootstrap = np.minimum(decisions + self.n_step, t)
        ends = bootstrap == t
        discount = self.gamma ** (bootstrap - decisions)
        reward = returns[:-1] - discount * returns[bootstrap]
        if segment.task not in self.tasks:
            self.tasks.append(segment.task)
        columns: dict[str, Any] = {
            "chunk": chunk,
            "reward": reward.astype(np.float32),
            "discount": np.where(ends, 0.0, discount).astype(np.float32),
            "following": rows[np.where(ends, decisions, bootstrap)],
            "return": returns[:-1].astype(np.float32),
            "success": np.full(t, segment.success),
            "task": np.full(t, self.tasks.index(segment.task)),
        }
        for name, values in segment.observations.items():
            if name != ENVIRONMENT_STATE:  # no policy reads it
                columns[name] = values[:-1]
        self.total += t
        for name, values in (columns | more).items():
            self._write(name, rows, values)

    def _write(self, name: str, rows: np.ndarray, values: np.ndarray) -> None:
        """Sets rows of a column, after making space in it for all rows so far."""
        column = self._columns.get(name, values[:0])
        if len(column) < len(self):
            size = min(max(FIRST, 2 * len(self)), self.capacity)
            space = np.zeros((size - len(column), *values.shape[1:]), values.dtype)
            column = np.concatenate([column, space])
            self._columns[name] = column
        column[rows] = values

    def seen(self) -> Observations:
        """The policy's observations of all rows, each (len, ...); not a copy."""
        return {name: self[name] for name in self._columns if name.startswith("observation.")}

    def observations(self, rows: np.ndarray) -> tuple[Observations, list[str]]:
        """The policy's observations, each (B, ...), and its instructions."""
        seen = {name: column[rows] for name, column in self.seen().items()}
        tasks = self._columns["task"][rows]
        return seen, [self.tasks[task] for task in tasks]

    def state(self) -> State:
        columns = {name: self[name].copy() for name in self._columns}
        return {"total": self.total, "tasks": list(self.tasks), "columns": columns}

    def restore(self, state: State) -> None:
        self.total = state["total"]
        self.tasks = list(state["tasks"])
        self._columns = dict(state["columns"])


class OffPolicyUpdate(BaseUpdate):
    """Updates for each ``batch_decisions`` of new experience; as it is, imitates successful episodes.

    A subclass overrides what it does differently: `imitable`, `target` and `losses` of a policy step, `learn`
    for further gradient steps, `columns` for what else is remembered, `n_step`. With networks of its own it
    overrides `state` and `restore` too, and clips their gradients itself.
    """

    n_step = 1  # decisions after which a target bootstraps
    has_value = False  # True if steps of the policy train a critic too, alone during the warm-up

    adapter: LeRobotAdapter | StockAdapter

    def __init__(
        self, adapter: LeRobotAdapter | StockAdapter, algorithm: OffPolicyConfig, config: TrainerConfig
    ) -> None:
        super().__init__(adapter, algorithm, config)
        self.memory = Memory(algorithm.memory, algorithm.gamma, self.n_step)
        self._pending_steps: dict[str, float] = {}

    def step(self, segments: Sequence[Segment]) -> Metrics:
        if not self.memory.total and self.adapter.demonstrations is not None:
            for demonstration in self.adapter.demonstrations(segments[0]):
                self.remember(demonstration)
        for segment in segments:
            self.remember(segment)
        rewards = np.concatenate([segment.reward for segment in segments])
        metrics: Metrics = {
            "decisions": len(rewards),
            "memory_decisions": len(self.memory),
            "reward_mean": float(rewards.mean()),
        }
        metrics |= self.learn(len(rewards))
        # Lag is that of the new decisions only: those that the steps draw from the memory may be much older.
        versions = np.concatenate([segment.version for segment in segments])
        metrics |= lag_metrics(versions, self.version)
        self.version += 1
        metrics["skipped"] = self.skipped
        return metrics

    def learn(self, new: int) -> Metrics:
        """Makes the steps that so many new decisions allow, of a critic alone in ``value_warmup_updates``."""
        start = self.config.value_warmup_updates
        lr = self.config.lr * self.lr_share(start)
        self.optimizer.param_groups[0]["lr"] = lr
        metrics = {"lr": lr}
        rows = self.imitable()
        if len(rows) and (self.version >= start or self.has_value):
            steps = self.steps("policy", self.algorithm.policy_steps, new)
            metrics |= mean(self._policy_step(rows) for _ in steps)
        return metrics

    def imitable(self) -> np.ndarray:
        """Rows of the memory that the policy imitates."""
        return np.flatnonzero(self.memory["success"])

    def target(self, rows: np.ndarray) -> Tensor:
        """Chunks (B, K, A) for the policy to imitate, in normalised units."""
        return self.tensor("chunk", rows)

    def losses(self, rows: np.ndarray, encoded: Encoded | None, imitation: Tensor) -> dict[str, Tensor]:
        """Losses of a step of the policy, by name, each a scalar and already weighted.

        `rows` (B,) are of the memory, `encoded` are their observations where the policy's features are known,
        `imitation` is LeRobot's training loss, (B,) or its mean.
        """
        return {"imitation_loss": imitation.mean()}

    def state(self) -> State:
        state = super().state()
        state["pending_steps"] = dict(self._pending_steps)
        state["memory"] = self.memory.state()
        return state

    def restore(self, state: State) -> None:
        super().restore(state)
        self._pending_steps = dict(state["pending_steps"])
        self.memory.restore(state["memory"])

    def steps(self, name: str, each: float, new: int) -> range:
        """The steps that are due after `new` decisions, `each` for one; a fraction is due later."""
        pending_steps = self._pending_steps.get(name, 0.0) + each * new
        due = int(pending_steps)
        self._pending_steps[name] = pending_steps - due
        return range(due)

    def remember(self, segment: Segment) -> None:
        executed = self.adapter.processing.normalise(torch.from_numpy(segment.actions))
        self.memory.add(segment, executed.numpy(), **self.columns(segment))

    def columns(self, segment: Segment) -> dict[str, np.ndarray]:
        """Further columns of the memory, each (T, ...)."""
        return {}

    def tensor(self, name: str, rows: np.ndarray) -> Tensor:
        """Rows of a column, where the policy lives."""
        return torch.from_numpy(self.memory[name][rows]).to(self.adapter.device)

    def _policy_step(self, imitable: np.ndarray) -> Metrics:
        rows = drawn(imitable, POLICY_BATCH)
        metrics: Metrics = {}
        self.optimizer.zero_grad(set_to_none=True)
        micro_batches = math.ceil(len(rows) / self.config.micro_batch)
        for part in np.array_split(rows, micro_batches):
            observations, tasks = self.memory.observations(part)
            with self.adapter.autocast():
                imitation, encoded = self.adapter.imitate(observations, tasks, self.target(part))
            share = len(part) / len(rows)
            losses = self.losses(part, encoded, imitation.float())
            losses = {name: share * value for name, value in losses.items()}
            torch.stack(list(losses.values())).sum().backward()
            for name, value in losses.items():
                metrics[name] = metrics.get(name, 0.0) + float(value.detach())
        self.spare_policy()
        loss = sum(metrics.values())
        norm = torch.nn.utils.clip_grad_norm_(self._policy, self.config.grad_clip)
        self.apply(self.optimizer, "a step of the policy", loss, float(norm))
        metrics["policy_loss"] = loss
        metrics["grad_norm"] = float(norm)
        return metrics


class AWRUpdate(OffPolicyUpdate):
    """Advantage-weighted regression, see `AWRConfig`; the critic is the adapter's."""

    has_value = True

    def __init__(self, adapter: LeRobotAdapter, algorithm: AWRConfig, config: TrainerConfig) -> None:
        super().__init__(adapter, algorithm, config)
        self._variance = 0.0  # mean square of R − V, over some hundred steps
        self.optimizer.add_param_group({"params": self._value, "lr": config.value_lr})

    def learn(self, new: int) -> Metrics:
        self.optimizer.param_groups[1]["lr"] = self.config.value_lr * self.lr_share()
        return super().learn(new)

    def imitable(self) -> np.ndarray:  # of failures too, what went better than expected
        return np.arange(len(self.memory))

    def losses(self, rows: np.ndarray, encoded: Encoded | None, imitation: Tensor) -> dict[str, Tensor]:
        assert encoded is not None and isinstance(self.adapter, LeRobotAdapter)
        value = self.adapter.value_head(encoded.features, encoded.mask)
        error = self.tensor("return", rows) - value
        square = float(error.detach().square().mean())
        if self._variance:
            square = FORGET * self._variance + (1 - FORGET) * square
        self._variance = square
        std = max(math.sqrt(self._variance), STD_EPSILON)
        weight = weights(error.detach() / std, self.algorithm.beta)
        weighted = weight * imitation
        return {"imitation_loss": weighted.mean(), "value_loss": error.square().mean()}

    def state(self) -> State:
        return super().state() | {"variance": self._variance}

    def restore(self, state: State) -> None:
        super().restore(state)
        self._variance = state["variance"]


def drawn(rows: np.ndarray, count: int) -> np.ndarray:
    """So many of the rows, with repetition, by torch's global generator."""
    chosen = torch.randint(len(rows), (count,))
    return rows[chosen.numpy()]


def weights(advantage: Tensor, beta: float) -> Tensor:
    """min(exp(advantage / beta), CAP), limited before the exponential, which would overflow."""
    return (advantage / beta).clamp(max=math.log(CAP)).exp()


def mean(steps: Iterable[Metrics]) -> Metrics:
    """Means over steps; empty without any."""
    made = list(steps)
    if not made:
        return {}
    means: Metrics = {}
    for name in made[0]:
        means[name] = sum(step[name] for step in made) / len(made)
    return means
