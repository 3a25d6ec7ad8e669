# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""One update: segments in, better weights and numbers about them out.

    values of the current critic (bootstraps too) → GAE → advantages normalised over the batch → loss → step

With ``advantage=group`` the advantages are those that the rollout workers stamped on the segments. GAE then
only makes the critic's targets; where ``value_coef`` is 0, not even those, and V is not computed beforehand.

Values stored with the samples are stale by their lag, so they are recomputed; the stored log-probs are not,
since they are what the ratio divides by. Knows no process: the Ray worker and the single-process mode both
call `Update.step`.

Shapes: S segments, T decisions of the longest one, N decisions in all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from accerl_lerobot.algorithms import AlgorithmConfig, LossInputs, compute_loss
from accerl_lerobot.algorithms.diagnostics import lag_metrics
from accerl_lerobot.algorithms.gae import decision_mask, gae
from accerl_lerobot.algorithms.normalise import moments, normalise
from accerl_lerobot.experience import Segment
from accerl_lerobot.policies.base import PolicyAdapter
from accerl_lerobot.trainer.config import TrainerConfig


@dataclass(frozen=True, kw_only=True)
class Batch:
    """Segments laid end to end: N rows of decisions, plus one bootstrap observation per segment."""

    observations: dict[str, np.ndarray]
    """Each (N, ...)."""
    tasks: list[str]
    latent: dict[str, Tensor]
    """Each (N, ...)."""
    log_prob: Tensor
    """(N, L) of the behaviour policy."""
    reward: Tensor
    """(N,)."""
    version: np.ndarray
    """int64 (N,)."""
    lengths: Tensor
    """int64 (S,)."""
    terminated: Tensor
    """bool (S,)."""
    last_observations: dict[str, np.ndarray]
    """Each (S, ...)."""
    segment_tasks: list[str]
    advantage: Tensor | None = None
    """(N,), stamped by the rollout workers; None: not on all segments."""


def collate(segments: Sequence[Segment]) -> Batch:
    """Lays segments end to end."""
    keys, names = segments[0].observations.keys(), segments[0].latent.keys()
    stamped = [s.advantage for s in segments if s.advantage is not None]
    return Batch(
        observations={k: np.concatenate([s.observations[k][:-1] for s in segments]) for k in keys},
        tasks=[s.task for s in segments for _ in range(len(s))],
        latent={k: torch.from_numpy(np.concatenate([s.latent[k] for s in segments])) for k in names},
        log_prob=torch.from_numpy(np.concatenate([s.log_prob for s in segments])),
        reward=torch.from_numpy(np.concatenate([s.reward for s in segments])),
        version=np.concatenate([s.version for s in segments]),
        lengths=torch.tensor([len(s) for s in segments]),
        terminated=torch.tensor([s.terminated for s in segments]),
        last_observations={k: np.stack([s.observations[k][-1] for s in segments]) for k in keys},
        segment_tasks=[s.task for s in segments],
        advantage=torch.from_numpy(np.concatenate(stamped)) if len(stamped) == len(segments) else None,
    )


class NonFiniteError(RuntimeError):
    """Too many updates in a row had a non-finite loss or gradient."""


class Update:
    """The optimiser around one adapter.

    Example:
        >>> update = Update(adapter, GIPOConfig(), TrainerConfig(lr=1e-4))
        >>> metrics = update.step(replay.sample(128, update.version, rng))
        >>> weights = adapter.export_trainable()        # to publish as version `update.version`
    """

    def __init__(self, adapter: PolicyAdapter, algorithm: AlgorithmConfig, config: TrainerConfig) -> None:
        self.adapter, self.algorithm, self.config = adapter, algorithm, config
        self._grouped = algorithm.advantage == "group"
        self._critic = not self._grouped or algorithm.value_coef > 0
        self.version = 0
        self.skipped = 0
        self._skipped_in_a_row = 0
        named = adapter.trainable()
        critic = [p for k, p in named.items() if k.startswith("value_head.")]
        self._policy_parameters = [p for k, p in named.items() if not k.startswith("value_head.")]
        self._parameters = self._policy_parameters + critic
        groups = [
            {"params": self._policy_parameters, "lr": config.lr},
            {"params": critic, "lr": config.value_lr},
        ]
        self.optimizer = torch.optim.AdamW(groups, betas=config.betas, weight_decay=config.weight_decay)

    def step(self, segments: Sequence[Segment]) -> dict[str, float]:
        """Applies one optimiser step and returns its metrics; the version rises by one.

        Raises:
            NonFiniteError: `TrainerConfig.max_nonfinite` updates in a row were not finite.
        """
        batch = collate(segments)
        share = self.config.lr_share(self.version)
        critic_only = self.version < self.config.value_warmup_updates and not self._grouped
        policy_group, critic_group = self.optimizer.param_groups
        policy_group["lr"] = 0.0 if critic_only else self.config.lr * share
        critic_group["lr"] = self.config.value_lr * share
        self.optimizer.zero_grad(set_to_none=True)
        metrics = self._backward(batch)
        if critic_only:
            # Before the norm is taken: noise in the policy's gradient must not scale the critic's.
            for parameter in self._policy_parameters:
                parameter.grad = None
        norm = torch.nn.utils.clip_grad_norm_(self._parameters, self.config.grad_clip)
        if bool(torch.isfinite(norm)) and np.isfinite(metrics["loss"]):
            self.optimizer.step()
            self._skipped_in_a_row = 0
        else:
            self._skip()
        lag = lag_metrics(torch.from_numpy(batch.version), self.version)
        self.version += 1
        metrics |= {name: float(value) for name, value in lag.items()}
        return metrics | {
            "grad_norm": float(norm),
            "lr": float(policy_group["lr"]),
            "value_lr": float(critic_group["lr"]),
            "skipped": float(self.skipped),
        }

    def _skip(self) -> None:
        self.skipped += 1
        self._skipped_in_a_row += 1
        if self._skipped_in_a_row >= self.config.max_nonfinite:
            raise NonFiniteError(
                f"{self._skipped_in_a_row} updates in a row had a non-finite loss or gradient; "
                "lower trainer.lr"
            )

    def _backward(self, batch: Batch) -> dict[str, float]:
        """Accumulates gradients over micro-batches; returns metrics weighted by their decisions."""
        n = len(batch.reward)
        chunks = np.split(np.arange(n), range(self.config.micro_batch, n, self.config.micro_batch))
        bootstrap = self._values(batch.last_observations, batch.segment_tasks)
        targets: tuple[Tensor, Tensor] | None = None
        if len(chunks) > 1:  # a single micro-batch supplies the values that GAE needs by its own forward pass
            targets = self._targets(batch, self._values(batch.observations, batch.tasks), bootstrap)
        total: dict[str, float] = {}
        for rows in chunks:
            latent = {k: v[rows] for k, v in batch.latent.items()}
            observations, tasks = _rows(batch.observations, batch.tasks, rows)
            evaluation = self.adapter.evaluate(observations, tasks, latent)
            if targets is None:
                targets = self._targets(batch, evaluation.value.detach().cpu(), bootstrap)
            device = evaluation.value.device
            output = compute_loss(
                LossInputs(
                    log_prob_new=evaluation.log_prob,
                    log_prob_old=batch.log_prob[rows].to(device),
                    advantage=targets[0][rows].to(device),
                    value=evaluation.value,
                    returns=targets[1][rows].to(device),
                    entropy=evaluation.entropy,
                ),
                self.algorithm,
            )
            share = len(rows) / n
            (output.loss * share).backward()
            _merge(total, {k: float(v) for k, v in output.metrics.items()}, share)
        assert targets is not None
        return total | {"return_mean": float(targets[1].mean()), "reward_mean": float(batch.reward.mean())}

    def _targets(self, batch: Batch, values: Tensor, bootstrap: Tensor) -> tuple[Tensor, Tensor]:
        """Advantages, normalised unless they come from groups, and returns, each (N,)."""
        mask = decision_mask(batch.lengths, int(batch.lengths.max()))
        padded = torch.zeros(mask.shape)
        if not self._critic:
            values = torch.zeros_like(values)
        reward, value = (padded.masked_scatter(mask, x.float()) for x in (batch.reward, values))
        advantages, returns = gae(
            reward,
            value,
            bootstrap,
            batch.terminated,
            batch.lengths,
            gamma=self.algorithm.gamma,
            lam=self.algorithm.lam,
        )
        if self._grouped:
            if batch.advantage is None:
                raise ValueError(
                    "algorithm.advantage=group, but a segment carries none: set rollout.group_size"
                )
            return batch.advantage, returns[mask]
        advantages = normalise(advantages, moments(advantages, mask), mask)
        return advantages[mask], returns[mask]

    def _values(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> Tensor:
        """V of each row, (rows,), without gradient, at most `micro_batch` rows at a time."""
        size, n = self.config.micro_batch, len(tasks)
        if not self._critic:  # V is neither used nor learnt
            return torch.zeros(n)
        rows = np.split(np.arange(n), range(size, n, size))
        return torch.cat([self.adapter.values(*_rows(observations, tasks, r)).cpu().float() for r in rows])


def _rows(
    observations: dict[str, np.ndarray], tasks: Sequence[str], rows: np.ndarray
) -> tuple[dict[str, np.ndarray], list[str]]:
    return {k: v[rows] for k, v in observations.items()}, [tasks[i] for i in rows]


def _merge(total: dict[str, float], metrics: dict[str, float], share: float) -> None:
    """Adds a micro-batch's metrics: a maximum, a count, and means weighted by its share of the decisions."""
    for name, value in metrics.items():
        if name == "ratio_max_dev":
            total[name] = max(total.get(name, value), value)
        else:
            total[name] = total.get(name, 0.0) + (value if name == "decisions" else share * value)
