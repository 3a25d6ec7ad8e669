# SPDX-License-Identifier: Apache-2.0
"""Updates from an off-policy critic and a teacher on the states of a world model.

    new episodes → memory → steps of the world model → steps of critic and teacher → steps of the policy,
    so many of each for each new decision

`ChunkCriticConfig` has the formulas, `world_model.states` what a state is. A world model that learns does so
on a copy; every `REFRESH` decisions the one that acts takes over its weights, and all remembered states are
computed anew. Until ``trainer.value_warmup_updates`` the policy explores alone.
Then the teacher first learns to do what has been done so far, and from there what the critic says.

Shapes: M members of the ensemble, B rows, S numbers of a state, (K, A) of a chunk.
"""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.algorithms import ChunkCriticConfig
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.algorithms.off_policy import OffPolicyUpdate, drawn, mean
from accerl_lerobot.checkpoint.snapshot import State
from accerl_lerobot.checkpoint.tensors import copied, follow, optimizer_state, restore_optimizer
from accerl_lerobot.experience import Metrics, Segment
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.family import Encoded, pooled
from accerl_lerobot.policies.stock import StockAdapter
from accerl_lerobot.policies.teacher import Ensemble, Teacher
from accerl_lerobot.world_model.states import BATCH as TRANSITIONS
from accerl_lerobot.world_model.states import StateLearner, Transitions

if TYPE_CHECKING:
    from accerl_lerobot.world_model.worker import RemoteStateLearner

MEMBERS = 6
MONTE_CARLO = 0.25  # share of the observed return in the critic's target
BATCH = 256  # rows of one step of critic or teacher
TAU = 0.01  # share of the critic's weights that its slow copy takes over in a step
SMOOTHING = 0.1  # std of the noise on the teacher's chunks within the critic's target, as in TD3
DISTANCE, IMITATION = 0.3, 0.5
"""Normalised action units in which the teacher's distance from successes is measured, and its weight."""
PERCEPTION = 0.5  # weight of reading the state off the policy's features
TEACHER_LR = 3e-4
READER_LR = 1e-3
LAST = 50  # exploring episodes that ``teacher_success`` and ``policy_success`` are of
FIRST_STEPS = 2000  # steps in which the teacher learns what was done before it may act
MOST_FIRST = 5000  # most steps of the critic before the teacher's first along it
MARGIN = 0.05  # share of the explored range of actions that the teacher may go beyond it
SMALLEST_SCALE = 0.02  # smallest mean |Q| that Q is divided by
MOST_STATE_STEPS = 200  # of the world model's first steps, in one update
STEPS_AT_ONCE = 25  # of the world model, whose transitions are drawn together
LEAST_TRANSITIONS = 100  # with fewer, the world model does not begin
REFRESH = 320  # new decisions after which the acting world model takes over what was learned, at least
REENCODED = 16  # remembered states that are computed anew for each new decision, at most
REENCODED_AT_ONCE = 512
LATENT_CRITIC_STEPS = 0.5  # of the critic for each new decision, where the state is learned


class Critic(nn.Module):
    """An ensemble of Q: a scaled state (B, S) and a chunk (B, K, A) to (M, B)."""

    def __init__(self, teacher: Teacher) -> None:
        super().__init__()
        inputs = len(teacher.mean) + math.prod(teacher.chunk)
        self.network = Ensemble(inputs, 1, MEMBERS)

    def forward(self, state: Tensor, chunk: Tensor) -> Tensor:
        inputs = torch.cat([state, chunk.flatten(1)], -1)
        return self.network(inputs)[..., 0].float()


class ChunkCriticUpdate(OffPolicyUpdate):
    """Updates of critic, teacher and policy."""

    n_step = 4

    def __init__(
        self, adapter: LeRobotAdapter | StockAdapter, algorithm: ChunkCriticConfig, config: TrainerConfig
    ) -> None:
        super().__init__(adapter, algorithm, config)
        assert adapter.teacher is not None
        self.teacher = adapter.teacher
        device = adapter.device
        self.critic = Critic(self.teacher).to(device)
        self.slow = copy.deepcopy(self.critic).requires_grad_(False)
        model = self.teacher.model
        self.state_learner: StateLearner | RemoteStateLearner | None = None
        if model.learns:
            self.state_learner = StateLearner(model)
        self._unpublished = 0  # new decisions since the model that acts was replaced
        self._unsubmitted = 0  # new decisions for which the world model has no steps yet
        # The teacher lies beside the policy's weights.
        self.networks: dict[str, nn.Module] = {"critic": self.critic, "slow": self.slow}
        critic = self.critic.parameters()
        teacher = self.teacher.network.parameters()
        self.optimizers = {
            "critic": torch.optim.AdamW(critic, lr=config.value_lr, weight_decay=1e-3, fused=True),
            "teacher": torch.optim.AdamW(teacher, lr=TEACHER_LR, weight_decay=1e-4, fused=True),
        }
        # Success of the last exploring episodes, by the network that acted in them.
        self._outcomes = {
            "policy_success": deque[bool](maxlen=LAST),
            "teacher_success": deque[bool](maxlen=LAST),
        }
        # Reads the scaled state off the policy's features.
        self.reader: nn.Linear | None = None
        if adapter.feature_width is not None:
            self.reader = nn.Linear(adapter.feature_width, len(self.teacher.mean)).to(device)
            self.networks["reader"] = self.reader
            self.optimizer.add_param_group({"params": list(self.reader.parameters()), "lr": READER_LR})

    def step(self, segments: Sequence[Segment]) -> Metrics:
        for segment in segments:
            taught = bool(self.teacher.ready) and self.teacher.plays(segment.origin.seed)
            name = "teacher_success" if taught else "policy_success"
            self._outcomes[name].append(segment.success)
        metrics: Metrics = {}
        for name, last in self._outcomes.items():
            metrics[name] = sum(last) / max(1, len(last))
        return super().step(segments) | metrics

    def columns(self, segment: Segment) -> dict[str, np.ndarray]:
        t = len(segment)
        seen = {name: rows[:-1] for name, rows in segment.observations.items()}
        states = self.teacher.states(seen, [segment.task] * t, segment.elapsed)
        last = np.arange(t) == t - 1
        return {"state": states.cpu().numpy(), "elapsed": segment.elapsed, "last": last}

    def learn_states_in(self, worker: Any, timeout_s: float) -> None:
        """Have a `WorldModelWorker`, of which `worker` is the handle, make the steps of the world model."""
        from accerl_lerobot.world_model.worker import RemoteStateLearner

        if isinstance(self.state_learner, StateLearner):
            self.state_learner = RemoteStateLearner(worker, self.state_learner, timeout_s)

    def learn(self, new: int) -> Metrics:
        metrics = self._learn_states(new)
        if self.state_learner is not None and not self.state_learner.ready:
            return metrics  # critic and teacher would learn on states that mean nothing yet
        return metrics | self._learn_to_act(new)

    def transitions(self) -> np.ndarray:
        """Rows of the memory that another one of their episode follows; the world model learns from these."""
        return np.flatnonzero(~self.memory["last"])

    def _learn_states(self, new: int) -> Metrics:
        """Steps of the world model, where it learns; now and then the one that acts takes them over."""
        transitions = self.transitions()
        if self.state_learner is None or len(transitions) < LEAST_TRANSITIONS:
            return {}
        self._submit_steps(transitions, new)
        if not self.state_learner.ready and self.version >= self.config.value_warmup_updates:
            self.state_learner.wait()  # or episodes would be spent before anything is learned from them
        steps = self.state_learner.collect()
        self._unpublished += new
        interval = max(REFRESH, len(self.memory) // REENCODED)
        due = not self.teacher.ready or self._unpublished >= interval
        if steps and due:
            self._unpublished = 0
            self.state_learner.publish(self.teacher.model)
            self._encode_memory()
        return {f"world_model_{name}": value for name, value in mean(steps).items()}

    def _submit_steps(self, transitions: np.ndarray, new: int) -> None:
        """Give the world model the steps that are due, unless it has not made the last ones yet."""
        learner = self.state_learner
        assert learner is not None
        self._unsubmitted += new
        if learner.busy:
            return
        numbers = {name: rows for name, rows in self.memory.seen().items() if rows.dtype != np.uint8}
        # A part of the first steps at a time, so that no update takes minutes.
        due = min(learner.behind, MOST_STATE_STEPS)
        if not due:
            each = self.teacher.model.steps_per_decision
            due = len(self.steps("world_model", each, self._unsubmitted))
        self._unsubmitted = 0
        for first in range(0, due, STEPS_AT_ONCE):
            count = min(STEPS_AT_ONCE, due - first)
            rows = drawn(transitions, count * TRANSITIONS)
            learner.submit(self._transitions(rows), numbers)

    def _transitions(self, rows: np.ndarray) -> Transitions:
        observations, tasks = self.memory.observations(rows)
        following, _ = self.memory.observations((rows + 1) % self.memory.capacity)
        return Transitions(
            observations=observations,
            following=following,
            tasks=tasks,
            elapsed=self.tensor("elapsed", rows),
            chunk=self.tensor("chunk", rows),
            returns=self.tensor("return", rows),
            success=self.tensor("success", rows),
        )

    def _encode_memory(self) -> None:
        states = self.memory["state"]
        parts = math.ceil(len(states) / REENCODED_AT_ONCE)
        for rows in np.array_split(np.arange(len(states)), parts):
            observations, tasks = self.memory.observations(rows)
            elapsed = self.memory["elapsed"][rows]
            computed = self.teacher.states(observations, tasks, elapsed)
            states[rows] = computed.cpu().numpy()

    def _learn_to_act(self, new: int) -> Metrics:
        won = np.flatnonzero(self.memory["success"])
        # Without a success there is nothing to learn: the teacher would follow the critic's noise. So it
        # would in a task without one, see `imitable`.
        if self.version < self.config.value_warmup_updates or not len(won):
            return {}
        self._scale_states()
        returns = self.memory["return"]
        bounds = float(returns.min()), float(returns.max())
        if not self.teacher.ready:
            self._begin(won, bounds)
        each = self.algorithm.critic_steps
        if each is None:
            each = 1.0 if self.state_learner is None else LATENT_CRITIC_STEPS
        critic_steps = self.steps("critic", each, new)
        metrics = mean(self._critic_step(bounds) for _ in critic_steps)
        teacher_steps = self.steps("teacher", each / 2, new)
        rows = self.imitable()
        metrics |= mean(self._teacher_step(rows, won) for _ in teacher_steps)
        return metrics | super().learn(new)

    def imitable(self) -> np.ndarray:
        """Rows of the tasks that have been achieved, whose observations the teacher labels."""
        tasks = self.memory["task"]
        achieved = np.unique(tasks[self.memory["success"]])
        return np.flatnonzero(np.isin(tasks, achieved))

    @torch.no_grad()
    def target(self, rows: np.ndarray) -> Tensor:
        return self.teacher(self.tensor("state", rows))

    def losses(self, rows: np.ndarray, encoded: Encoded | None, imitation: Tensor) -> dict[str, Tensor]:
        if encoded is None or self.reader is None:
            return super().losses(rows, encoded, imitation)
        features = pooled(encoded.features, encoded.mask)
        state = self.teacher.scaled(self.tensor("state", rows))
        error = self.reader(features) - state
        losses = super().losses(rows, encoded, imitation)
        losses["perception_loss"] = PERCEPTION * error.square().mean()
        return losses

    def state(self) -> State:
        state = super().state()
        state["networks"] = {name: copied(module) for name, module in self.networks.items()}
        state["optimizers"] = {name: optimizer_state(each) for name, each in self.optimizers.items()}
        state["outcomes"] = {name: list(last) for name, last in self._outcomes.items()}
        state["unpublished"] = (self._unpublished, self._unsubmitted)
        state["state_learner"] = None
        if self.state_learner is not None:
            state["state_learner"] = self.state_learner.state()
        return state

    def restore(self, state: State) -> None:
        super().restore(state)
        for name, module in self.networks.items():
            module.load_state_dict(state["networks"][name])
        for name, optimizer in self.optimizers.items():
            restore_optimizer(optimizer, state["optimizers"][name])
        for name, last in self._outcomes.items():
            last.extend(state["outcomes"][name])
        self._unpublished, self._unsubmitted = state["unpublished"]
        if isinstance(self.state_learner, StateLearner):
            self.state_learner.restore(state["state_learner"])

    @torch.no_grad()
    def _scale_states(self) -> None:
        states = self.memory["state"]
        # In float64, or the rounding of a long sum would look like a spread.
        mean_state = states.mean(0, dtype=np.float64)
        std = states.std(0, dtype=np.float64).clip(1e-3)
        self.teacher.mean.copy_(torch.from_numpy(mean_state))
        self.teacher.std.copy_(torch.from_numpy(std))

    def _begin(self, won: np.ndarray, bounds: tuple[float, float]) -> None:
        """The teacher learns to do what succeeded so far, or all that was done if that is little."""
        chunks = self.memory["chunk"]
        low = torch.from_numpy(chunks.min((0, 1)))
        high = torch.from_numpy(chunks.max((0, 1)))
        margin = MARGIN * (high - low) + MARGIN
        with torch.no_grad():
            self.teacher.low.copy_(low - margin)
            self.teacher.high.copy_(high + margin)
        known = won
        if len(won) < BATCH:
            known = np.arange(len(self.memory))
        for _ in range(FIRST_STEPS):
            loss = self._gap(drawn(known, BATCH)).square().mean()
            self._descend("teacher", loss)
        # Or the teacher would at once climb a critic that knows nothing.
        for _ in range(min(len(self.memory), MOST_FIRST)):
            self._critic_step(bounds)
        with torch.no_grad():
            self.teacher.ready.fill_(1)

    def _gap(self, rows: np.ndarray) -> Tensor:
        """Difference (B, K, A) of the teacher's chunks from those that were executed."""
        return self.teacher(self.tensor("state", rows)) - self.tensor("chunk", rows)

    def _critic_step(self, bounds: tuple[float, float]) -> Metrics:
        """One gradient step of the ensemble; ``bounds`` of the returns seen, which no target leaves."""
        rows = drawn(np.arange(len(self.memory)), BATCH)
        state = self.tensor("state", rows)
        chunk = self.tensor("chunk", rows)
        reward = self.tensor("reward", rows)
        discount = self.tensor("discount", rows)
        returns = self.tensor("return", rows)
        following = self.tensor("state", self.memory["following"][rows])
        with torch.no_grad(), self.adapter.autocast():
            planned = self.teacher(following)
            planned = planned + SMOOTHING * torch.randn_like(planned)
            following_q = self.slow(self.teacher.scaled(following), planned)
            bootstrap = pessimistic(following_q).clamp(*bounds)
            predicted = reward + discount * bootstrap
            target = (1 - MONTE_CARLO) * predicted + MONTE_CARLO * returns
        with self.adapter.autocast():
            q = self.critic(self.teacher.scaled(state), chunk)
        loss = (q - target).square().mean(1).sum()
        norm = self._descend("critic", loss, clip=math.inf)
        follow(self.slow, self.critic, TAU)
        with torch.no_grad():
            q = q.mean(0)
            spread = returns.var().clamp(min=1e-8)
            unexplained = (returns - q).var() / spread
        return {
            "value_loss": float(loss.detach()) / MEMBERS,
            "value_grad_norm": norm,
            "value_mean": float(q.mean()),
            "return_mean": float(returns.mean()),
            "explained_variance": float(1 - unexplained),
        }

    def _teacher_step(self, rows: np.ndarray, won: np.ndarray) -> Metrics:
        """One gradient step of the teacher along the critic in `rows`, and towards the successes `won`."""
        state = self.tensor("state", drawn(rows, BATCH))
        with self.adapter.autocast():
            q = self.critic(self.teacher.scaled(state), self.teacher(state))
            gap = self._gap(drawn(won, BATCH))
        scale = q.detach().abs().mean().clamp(min=SMALLEST_SCALE)
        loss = -pessimistic(q).mean() / scale
        distance = gap.square().mean() / DISTANCE**2
        self._descend("teacher", loss + IMITATION * distance)
        q = q.detach()
        return {
            "teacher_value": float(q.mean()),
            "disagreement": float(q.std(0).mean()),
            "distance": float(distance.detach()),
        }

    def _descend(self, name: str, loss: Tensor, clip: float = 1.0) -> float:
        """A step of one optimiser, left out where it is not finite; the gradient's norm."""
        optimizer = self.optimizers[name]
        parameters = optimizer.param_groups[0]["params"]
        # Of these alone: the teacher's loss runs through the critic, whose gradients nobody needs then.
        gradients = torch.autograd.grad(loss, parameters)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        norm = torch.nn.utils.clip_grad_norm_(parameters, clip)
        self.apply(optimizer, f"a step of the {name}", float(loss.detach()), float(norm))
        return float(norm)


def pessimistic(q: Tensor) -> Tensor:
    """Mean of the ensemble less its standard deviation, (M, B) to (B,)."""
    return q.mean(0) - q.std(0)
