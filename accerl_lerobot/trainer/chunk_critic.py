# SPDX-License-Identifier: Apache-2.0
"""Updates from an off-policy critic over chunks; `algorithms.chunk_critic` has the formulas.

    new episodes → memory → steps of the critic → steps of the policy, both so many for each new decision

Each row of the memory keeps a *proposal*, the chunk that the policy would execute there without exploring,
from a noise kept with it: the critic's target bootstraps from it and the policy is held near it. Proposals
are computed again in turn, all of them once in `RENEWED_IN` steps of the policy.

Shapes: M members of the ensemble, B rows, S numbers of a state, C = K · A of a chunk.
"""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.algorithms import ChunkCriticConfig
from accerl_lerobot.checkpoint.tensors import copied, optimizer_state, restore_optimizer
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.family import Encoded
from accerl_lerobot.trainer.config import TrainerConfig
from accerl_lerobot.trainer.off_policy import OffPolicyUpdate, mean

MEMBERS, WIDTH = 6, 256
CRITIC_BATCH = 256
"""Rows of one step of the critic."""
TAU = 0.01
"""Share of the critic's weights that its slow copy takes over in a step."""
SMOOTHING = 0.1
"""Std of the noise on proposals within the critic's target, as in TD3."""
DISTANCE = 0.3
"""Normalised action units in which the distance from a proposal is measured."""
RENEWED_IN = 80
"""Steps of the policy in which all proposals are computed again."""
SMALLEST_SCALE = 0.02
"""Smallest mean return that Q is divided by."""


class Critic(nn.Module):
    """An ensemble of Q(state, chunk).

    Args:
        state: S.
        chunk: C.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, state: int, chunk: int) -> None:
        super().__init__()
        sizes = ((state + chunk, WIDTH), (WIDTH, WIDTH), (WIDTH, 1))
        self.weights = nn.ParameterList((torch.rand(MEMBERS, i, o) * 2 - 1) / i**0.5 for i, o in sizes)
        self.biases = nn.ParameterList(torch.zeros(MEMBERS, 1, o) for _, o in sizes)
        self.register_buffer("mean", torch.zeros(state))
        self.register_buffer("std", torch.ones(state))

    def forward(self, state: Tensor, chunk: Tensor, members: Tensor | slice = slice(None)) -> Tensor:
        """(B, S) and (B, K, A) to (M, B), of the given members."""
        x = torch.cat([(state - self.mean) / self.std, chunk.flatten(1)], -1)
        layers = [(w[members], b[members]) for w, b in zip(self.weights, self.biases, strict=True)]
        x = x.expand(len(layers[0][0]), -1, -1)
        for weight, bias in layers[:-1]:
            x = torch.baddbmm(bias, x, weight)
            x = functional.silu(functional.layer_norm(x, x.shape[-1:]))
        weight, bias = layers[-1]
        return torch.baddbmm(bias, x, weight)[..., 0]


class ChunkCriticUpdate(OffPolicyUpdate):
    """The arguments are those of `off_policy.OffPolicyUpdate`."""

    def __init__(self, adapter: LeRobotAdapter, algorithm: ChunkCriticConfig, config: TrainerConfig) -> None:
        self.n_step = algorithm.n_step
        super().__init__(adapter, algorithm, config)
        self.algorithm = algorithm
        self._renewed = 0
        self._scale = 1.0
        self._critic: Critic | None = None

    def added(self, rows: np.ndarray) -> None:
        """See the base class."""
        self._propose(rows)

    def learn(self, new: int) -> dict[str, float]:
        """See the base class."""
        if self._critic is None:
            self._make_critic()
        assert self._critic is not None
        states, returns = self.memory["state"], self.memory["return"]
        for critic in (self._critic, self._slow):
            critic.mean.copy_(torch.from_numpy(states.mean(0)))
            critic.std.copy_(torch.from_numpy(states.std(0).clip(1e-3)))
        value_lr = self.config.value_lr * self.config.lr_share(self.version, updates=self._schedule_updates)
        self._critic_optimizer.param_groups[0]["lr"] = value_lr
        bounds = float(returns.min()), float(returns.max())
        due = self.steps("critic", self.algorithm.critic_steps, new)
        metrics = {"value_lr": value_lr} | mean(self._critic_step(bounds) for _ in due)
        self._scale = max(float(np.abs(returns).mean()), SMALLEST_SCALE)
        metrics |= self.policy_learns(new)
        if self.version >= self.config.value_warmup_updates:
            share = self.policy_steps / RENEWED_IN * len(self.memory)
            due = self.steps("proposals", share, new)[: len(self.memory)]
            self._propose((self._renewed + np.array(due, int)) % len(self.memory))
            self._renewed = (self._renewed + len(due)) % len(self.memory)
        return metrics

    def loss(self, rows: np.ndarray, encoded: Encoded, imitation: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """See the base class."""
        assert self._critic is not None
        algorithm = self.algorithm
        with self.adapter.autocast():
            chunk = self.adapter.family.propose(encoded, self.tensor("noise", rows)).float()
        proposal, state = self.tensor("proposal", rows), self.tensor("state", rows)
        q = self._critic(state, chunk)
        pessimistic = q.mean(0) - algorithm.pessimism * q.std(0)
        distance = (chunk - proposal).square().mean((1, 2)) / DISTANCE**2
        climb = (algorithm.anchor * distance - pessimistic / self._scale).mean()
        with torch.no_grad():
            gain = (q - self._critic(state, proposal)).mean() / self._scale
        return climb + algorithm.imitation * imitation, {
            "distance": distance.mean(),
            "disagreement": q.std(0).mean() / self._scale,
            "gain": gain,
        }

    def state(self) -> dict[str, Any]:
        """See the base class."""
        critic = self._critic and {
            "weights": copied(self._critic),
            "slow": copied(self._slow),
            "optimizer": optimizer_state(self._critic_optimizer),
        }
        return super().state() | {"renewed": self._renewed, "critic": critic}

    def restore(self, state: dict[str, Any]) -> None:
        """See the base class."""
        super().restore(state)
        self._renewed = state["renewed"]
        if state["critic"] is not None:
            self._make_critic()
            assert self._critic is not None
            self._critic.load_state_dict(state["critic"]["weights"])
            self._slow.load_state_dict(state["critic"]["slow"])
            restore_optimizer(self._critic_optimizer, state["critic"]["optimizer"])

    def _make_critic(self) -> None:
        """Once the sizes are known."""
        state, chunk = self.memory["state"].shape[1], int(np.prod(self.memory["chunk"].shape[1:]))
        self._critic = Critic(state, chunk).to(self.adapter.device)
        self._slow = copy.deepcopy(self._critic).requires_grad_(False)
        self._critic_optimizer = torch.optim.AdamW(
            self._critic.parameters(), lr=self.config.value_lr, weight_decay=1e-3
        )

    def _critic_step(self, bounds: tuple[float, float]) -> dict[str, float]:
        """One gradient step of the ensemble; ``bounds`` of the returns seen, which no target leaves."""
        assert self._critic is not None
        rows = self.draw(CRITIC_BATCH)
        state, chunk, reward, discount, returns = (
            self.tensor(name, rows) for name in ("state", "chunk", "reward", "discount", "return")
        )
        following = self.memory["following"][rows]
        with torch.no_grad():
            proposal = self.tensor("proposal", following)
            proposal = proposal + SMOOTHING * torch.randn_like(proposal)
            two = torch.randperm(MEMBERS)[:2]
            bootstrap = self._slow(self.tensor("state", following), proposal, two).min(0).values
            m = self.algorithm.monte_carlo
            target = (1 - m) * (reward + discount * bootstrap.clamp(*bounds)) + m * returns
        q = self._critic(state, chunk)
        loss = (q - target).square().mean(1).sum()
        self._critic_optimizer.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self._critic.parameters(), math.inf)
        if math.isfinite(float(loss.detach() + norm)):
            self._critic_optimizer.step()
        with torch.no_grad():
            for slow, fast in zip(self._slow.parameters(), self._critic.parameters(), strict=True):
                slow.lerp_(fast, TAU)
            q = q.mean(0)
            unexplained = (returns - q).var() / returns.var().clamp(min=1e-8)
        return {
            "value_loss": float(loss.detach()) / MEMBERS,
            "value_grad_norm": float(norm),
            "value_mean": float(q.mean()),
            "return_mean": float(returns.mean()),
            "explained_variance": float(1 - unexplained),
        }

    @torch.no_grad()
    def _propose(self, rows: np.ndarray) -> None:
        """Writes the proposals of now, from fresh noise."""
        for part in np.array_split(rows, max(1, math.ceil(len(rows) / (2 * CRITIC_BATCH)))):
            if not len(part):
                return
            noise = torch.randn(len(part), *self.adapter.family.noise_size())
            with self.adapter.autocast():
                encoded = self.adapter.encode(*self.memory.observations(part))
                chunk = self.adapter.family.propose(encoded, noise.to(self.adapter.device))
            self.memory.write("noise", part, noise.numpy())
            self.memory.write("proposal", part, chunk.float().cpu().numpy())


OFF_POLICY: dict[str, Any] = {"chunk_critic": ChunkCriticUpdate, "self_imitation": OffPolicyUpdate}
"""Name of an algorithm → its update."""
