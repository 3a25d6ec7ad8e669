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
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.algorithms.chunk_critic import ChunkCriticConfig
from accerl_lerobot.algorithms.diagnostics import lag_metrics
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Segment
from accerl_lerobot.optimizers import copied, optimizer_state, restore_optimizer
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.trainer.anchors import CRITIC
from accerl_lerobot.trainer.config import TrainerConfig
from accerl_lerobot.trainer.memory import Memory
from accerl_lerobot.trainer.nonfinite import NonFiniteError

MEMBERS, WIDTH = 6, 256
CRITIC_BATCH, POLICY_BATCH = 256, 128
"""Rows of one step of the critic and of the policy. Half of the policy's are drawn from successful episodes."""
TAU = 0.01
"""Share of the critic's weights that its slow copy takes over in a step."""
SMOOTHING = 0.1
"""Std of the noise on proposals within the critic's target, as in TD3."""
DISTANCE = 0.3
"""Normalised action units in which the distance from a proposal is measured."""
RENEWED_IN = 80
"""Steps of the policy in which all proposals are computed again."""
SMALLEST_SCALE = 0.02
"""Of the mean return that Q is divided by."""


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

    def forward(self, state: Tensor, chunk: Tensor) -> Tensor:
        """(B, S) and (B, K, A) to (M, B)."""
        x = torch.cat([(state - self.mean) / self.std, chunk.flatten(1)], -1).expand(MEMBERS, -1, -1)
        *hidden, last = zip(self.weights, self.biases, strict=True)
        for weight, bias in hidden:
            x = torch.baddbmm(bias, x, weight)
            x = functional.silu(functional.layer_norm(x, x.shape[-1:]))
        return torch.baddbmm(last[1], x, last[0])[..., 0]


class ChunkCriticUpdate:
    """Has the methods of `update.Update`, and stands in its place.

    Args:
        adapter: the policy.
        algorithm: the objective.
        config: the optimiser; ``batch_decisions`` of new experience make one update.

    Raises:
        InputError: the policy's chunks are no differentiable function of its weights.
    """

    def __init__(self, adapter: LeRobotAdapter, algorithm: ChunkCriticConfig, config: TrainerConfig) -> None:
        if not adapter.family.proposes:
            remedy = "needs a policy that explores by flow or gaussian; use gipo"
            raise InputError("algorithm.type", algorithm.type, remedy)
        self.adapter, self.algorithm, self.config = adapter, algorithm, config
        self.memory = Memory(algorithm.memory, algorithm.gamma, algorithm.n_step)
        self.version = self.skipped = self._skipped_in_a_row = 0
        self._owed = {"critic": 0.0, "policy": 0.0, "proposals": 0.0}
        self._renewed = 0
        self._schedule_updates = config.updates
        self._policy = [p for k, p in adapter.trainable().items() if not k.startswith(CRITIC)]
        self.optimizer = torch.optim.AdamW(
            self._policy, lr=config.lr, betas=config.betas, weight_decay=config.weight_decay
        )
        self._critic: Critic | None = None

    def step(self, segments: Sequence[Segment]) -> dict[str, float]:
        """Learns from new episodes and from those before; the version rises by one.

        Returns:
            Its metrics.

        Raises:
            InputError: a segment is not a whole episode.
            NonFiniteError: see `update.Update.step`.
        """
        for segment in segments:
            if not segment.truncated:  # the simulator diverged: nothing follows, and nothing failed
                latent = {k: torch.from_numpy(v) for k, v in segment.latent.items()}
                rows = self.memory.add(segment, self.adapter.family.executed(latent).numpy())
                self._propose(rows)
        metrics = {"decisions": float(sum(map(len, segments))), "memory_decisions": float(len(self.memory))}
        rewards = np.concatenate([segment.reward for segment in segments])
        metrics |= {"reward_mean": float(rewards.mean())}
        if len(self.memory):
            metrics |= self._learn(len(rewards))
        versions = torch.from_numpy(np.concatenate([segment.version for segment in segments]))
        metrics |= {name: float(value) for name, value in lag_metrics(versions, self.version).items()}
        self.version += 1
        return metrics | {"skipped": float(self.skipped)}

    def state(self) -> dict[str, Any]:
        """A copy of all that `restore` needs, the policy's weights apart; see `snapshot`."""
        critic = self._critic and {
            "weights": copied(self._critic),
            "slow": copied(self._slow),
            "optimizer": optimizer_state(self._critic_optimizer),
        }
        return {
            "version": self.version,
            "skipped": (self.skipped, self._skipped_in_a_row),
            "schedule_updates": self._schedule_updates,
            "owed": dict(self._owed),
            "renewed": self._renewed,
            "memory": self.memory.state(),
            "optimizer": optimizer_state(self.optimizer),
            "critic": critic,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from what `state` gave; the adapter has its weights already."""
        self.version = state["version"]
        self.skipped, self._skipped_in_a_row = state["skipped"]
        self._schedule_updates, self._owed = state["schedule_updates"], state["owed"]
        self._renewed = state["renewed"]
        self.memory.restore(state["memory"])
        restore_optimizer(self.optimizer, state["optimizer"])
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

    def _learn(self, new: int) -> dict[str, float]:
        """All steps that so many new decisions allow."""
        if self._critic is None:
            self._make_critic()
        assert self._critic is not None
        states = self.memory["state"]
        for critic in (self._critic, self._slow):
            critic.mean.copy_(torch.from_numpy(states.mean(0)))
            critic.std.copy_(torch.from_numpy(states.std(0).clip(1e-3)))
        start, updates = self.config.value_warmup_updates, self._schedule_updates
        lr = self.config.lr * self.config.lr_share(self.version, start=start, updates=updates)
        value_lr = self.config.value_lr * self.config.lr_share(self.version, updates=updates)
        self.optimizer.param_groups[0]["lr"] = lr
        self._critic_optimizer.param_groups[0]["lr"] = value_lr
        bounds = float(self.memory["return"].min()), float(self.memory["return"].max())
        critic_metrics = _mean(self._critic_step(bounds) for _ in self._steps("critic", new))
        policy_metrics: dict[str, float] = {}
        if self.version >= start:
            won = np.flatnonzero(self.memory["success"])
            scale = max(float(np.abs(self.memory["return"]).mean()), SMALLEST_SCALE)
            policy_metrics = _mean(self._policy_step(won, scale) for _ in self._steps("policy", new))
            self._renew(new)
        return {"lr": lr, "value_lr": value_lr} | critic_metrics | policy_metrics

    def _steps(self, name: str, new: int) -> range:
        """As many steps as are due; what is left over is due later."""
        each = self.algorithm.critic_steps if name == "critic" else self.algorithm.policy_steps
        self._owed[name] += each * new
        due = int(self._owed[name])
        self._owed[name] -= due
        return range(due)

    def _critic_step(self, bounds: tuple[float, float]) -> dict[str, float]:
        """One gradient step of the ensemble; ``bounds`` of the returns seen, which no target leaves."""
        assert self._critic is not None
        rows = self._draw(CRITIC_BATCH)
        state, chunk, reward, discount, returns = (
            self._tensor(name, rows) for name in ("state", "chunk", "reward", "discount", "return")
        )
        following = self.memory["following"][rows]
        with torch.no_grad():
            proposal = self._tensor("proposal", following)
            proposal = proposal + SMOOTHING * torch.randn_like(proposal)
            two = torch.randperm(MEMBERS)[:2]
            bootstrap = self._slow(self._tensor("state", following), proposal)[two].min(0).values
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

    def _policy_step(self, won: np.ndarray, scale: float) -> dict[str, float]:
        """One gradient step of the policy.

        Args:
            won: rows of successful episodes.
            scale: what Q is divided by.
        """
        assert self._critic is not None
        algorithm, family = self.algorithm, self.adapter.family
        rows = self._draw(POLICY_BATCH)
        if len(won):
            half = POLICY_BATCH // 2
            rows[:half] = won[torch.randint(len(won), (half,)).numpy()]
        success = self._tensor("success", rows).float()
        with self.adapter.autocast():
            encoded = self.adapter.encode(*self.memory.observations(rows))
            chunk = family.propose(encoded, self._tensor("noise", rows)).float()
            error = family.imitation_loss(encoded, self._tensor("chunk", rows)).float()
        imitation = (error * success).sum() / success.sum().clamp(min=1)
        proposal, state = self._tensor("proposal", rows), self._tensor("state", rows)
        q = self._critic(state, chunk)
        pessimistic = q.mean(0) - algorithm.pessimism * q.std(0)
        distance = (chunk - proposal).square().mean((1, 2)) / DISTANCE**2
        climb = (algorithm.anchor * distance - pessimistic / scale).mean()
        loss = climb + algorithm.imitation * imitation
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = float(torch.nn.utils.clip_grad_norm_(self._policy, self.config.grad_clip))
        if math.isfinite(float(loss.detach()) + norm):
            self.optimizer.step()
            self._skipped_in_a_row = 0
        else:
            self._skip(float(loss.detach()), norm)
        with torch.no_grad():
            gain = (q - self._critic(state, proposal)).mean() / scale
        return {
            "policy_loss": float(loss.detach()),
            "grad_norm": norm,
            "imitation_loss": float(imitation.detach()),
            "distance": float(distance.detach().mean()),
            "disagreement": float(q.detach().std(0).mean()) / scale,
            "gain": float(gain),
        }

    def _skip(self, loss: float, norm: float) -> None:
        self.skipped += 1
        self._skipped_in_a_row += 1
        if self._skipped_in_a_row >= self.config.max_nonfinite:
            raise NonFiniteError(
                f"{self._skipped_in_a_row} steps in a row had a non-finite loss or gradient (the last one: "
                f"loss {loss:g}, gradient norm {norm:g}); lower trainer.lr"
            )

    def _renew(self, new: int) -> None:
        """Computes the proposals anew whose turn it is."""
        self._owed["proposals"] += self.algorithm.policy_steps * new / RENEWED_IN * len(self.memory)
        due = min(int(self._owed["proposals"]), len(self.memory))
        self._owed["proposals"] -= int(self._owed["proposals"])
        self._propose((self._renewed + np.arange(due)) % len(self.memory))
        self._renewed = (self._renewed + due) % len(self.memory)

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

    def _draw(self, count: int) -> np.ndarray:
        return torch.randint(len(self.memory), (count,)).numpy()

    def _tensor(self, name: str, rows: np.ndarray) -> Tensor:
        return torch.from_numpy(self.memory[name][rows]).to(self.adapter.device)


def _mean(steps: Iterator[dict[str, float]]) -> dict[str, float]:
    """Means over steps; empty without any."""
    made = list(steps)
    return {name: sum(step[name] for step in made) / len(made) for name in (made[0] if made else ())}
