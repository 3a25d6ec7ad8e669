# SPDX-License-Identifier: Apache-2.0
"""One update: segments in, better weights and numbers about them out.

    values of the current critic (bootstraps too) → GAE → advantages normalised over the batch → loss → step

Values stored with the samples are stale by their lag, so they are recomputed; the stored log-probs are not,
since they are what the ratio divides by.

Shapes: S segments, T decisions of the longest one, N decisions in all.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from accerl_lerobot.algorithms import AlgorithmConfig, LossInputs, RatioConfig
from accerl_lerobot.algorithms.advantages import decision_mask, gae, moments, normalise
from accerl_lerobot.algorithms.batch import Batch, collate, pick, split_rows
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.algorithms.objective import lag_metrics, present, sample_metrics
from accerl_lerobot.algorithms.probe import CRITIC_PREFIX, Probe
from accerl_lerobot.algorithms.ranks import ALONE, Ranks
from accerl_lerobot.algorithms.sharding import arrange
from accerl_lerobot.checkpoint.tensors import optimizer_state, restore_optimizer, whole
from accerl_lerobot.config.parsing import imported
from accerl_lerobot.errors import MAX_NONFINITE, NonFiniteError
from accerl_lerobot.experience import Segment
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.policies.adapter import PolicyAdapter
from accerl_lerobot.policies.teacher import TEACHER_PREFIX


def make_update(
    adapter: Any, algorithm: AlgorithmConfig, config: TrainerConfig, ranks: Ranks = ALONE
) -> BaseUpdate:
    """The updates that belong to an algorithm; see `RatioUpdate` for the arguments."""
    shared = [ranks] if isinstance(algorithm, RatioConfig) else []
    return imported(algorithm.update)(adapter, algorithm, config, *shared)


class BaseUpdate(ABC):
    """The optimiser around one adapter, and what the updates of all algorithms share."""

    def __init__(self, adapter: Any, config: TrainerConfig) -> None:
        arrange(adapter, config)
        self.adapter, self.config = adapter, config
        self.version = self.skipped = self._skipped_in_a_row = 0
        self._schedule_updates = config.updates
        named = adapter.trainable().items()
        self._policy = [p for k, p in named if not k.startswith((CRITIC_PREFIX, TEACHER_PREFIX))]
        self._value = [p for k, p in named if k.startswith(CRITIC_PREFIX)]
        self.optimizer = torch.optim.AdamW(self._policy, lr=config.lr, betas=config.betas, weight_decay=0.0)

    @abstractmethod
    def step(self, segments: Sequence[Segment]) -> dict[str, float]:
        """Learns from new segments and returns metrics; the version rises by one."""

    def state(self) -> dict[str, Any]:
        """A copy of all that `restore` needs, the policy's weights apart; see `snapshot`."""
        return {
            "version": self.version,
            "skipped": (self.skipped, self._skipped_in_a_row),
            "schedule_updates": self._schedule_updates,
            "optimizer": optimizer_state(self.optimizer),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Resume from `state`; the adapter has its weights already."""
        self.version = state["version"]
        self.skipped, self._skipped_in_a_row = state["skipped"]
        self._schedule_updates = state["schedule_updates"]
        restore_optimizer(self.optimizer, state["optimizer"])

    def lr_share(self, start: int = 0) -> float:
        """Share of the peak of a learning rate that begins with update `start`."""
        # A resumed run with more updates keeps the schedule that it began with, so that rates do not jump.
        return self.config.lr_share(self.version, start=start, updates=self._schedule_updates)

    def apply(self, optimizer: torch.optim.Optimizer, step: str, loss: float, norm: float) -> None:
        """Makes a step, unless its loss or its gradient's norm is not finite; those are counted.

        Raises:
            NonFiniteError: `MAX_NONFINITE` of them since the policy's last step.
        """
        if math.isfinite(loss + norm):
            optimizer.step()
            if optimizer is self.optimizer:
                self._skipped_in_a_row = 0
            return
        self.skipped += 1
        self._skipped_in_a_row += 1
        if self._skipped_in_a_row >= MAX_NONFINITE:
            raise NonFiniteError(
                f"{self._skipped_in_a_row} steps in a row had a non-finite loss or gradient (the last one, "
                f"{step}: loss {loss:g}, gradient norm {norm:g}); lower trainer.lr or trainer.value_lr"
            )


class RatioUpdate(BaseUpdate):
    """Updates by a likelihood ratio; of several ranks, each has one, and all make the same steps.

    Parameters of the adapter are others afterwards where `ranks` keep parts of them.
    """

    def __init__(
        self, adapter: PolicyAdapter, algorithm: RatioConfig, config: TrainerConfig, ranks: Ranks = ALONE
    ) -> None:
        self.algorithm, self.ranks = algorithm, ranks
        self.ranks.begin_alike(list(adapter.trainable().values()))
        super().__init__(adapter, config)
        self._moments = torch.zeros(3, dtype=torch.float64)
        self._probe = Probe(adapter, config, self.ranks)
        self.optimizer.add_param_group({"params": self._value})

    def step(self, segments: Sequence[Segment]) -> dict[str, float]:
        batch = collate(segments)
        mismatch = self._probe.read(batch)
        lr = self.config.lr * self.lr_share(self.config.value_warmup_updates)
        value_lr = self.config.value_lr * self.lr_share()
        for group, rate in zip(self.optimizer.param_groups, (lr, value_lr), strict=True):
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        metrics = self._backward(batch)
        fault_point("trainer.backward")
        if self.version < self.config.value_warmup_updates:
            for parameter in self._policy:  # its moments in the optimiser begin with its learning rate
                parameter.grad = None
        # Each by itself, or the larger gradient would scale the other one down.
        norm, value_norm = (
            float(whole(torch.nn.utils.clip_grad_norm_(parameters, self.config.grad_clip)))
            for parameters in (self._policy, self._value)
        )
        self.apply(self.optimizer, "an update", metrics["loss"], norm + value_norm)
        metrics |= mismatch | lag_metrics(torch.from_numpy(batch.version), self.version)
        self.version += 1
        self._probe.renew(self.version)
        norms = {"grad_norm": norm, "value_grad_norm": value_norm}
        return metrics | norms | {"lr": lr, "value_lr": value_lr, "skipped": float(self.skipped)}

    def state(self) -> dict[str, Any]:
        return super().state() | {"moments": self._moments.clone(), "probe": self._probe.state()}

    def restore(self, state: dict[str, Any]) -> None:
        super().restore(state)
        self._moments = state["moments"]
        self._probe.restore(state["probe"])

    def _backward(self, batch: Batch) -> dict[str, float]:
        """Accumulates gradients over micro-batches; returns metrics of the whole batch."""
        parts = split_rows(np.arange(len(batch)), self.config.micro_batch, self.ranks.rank, self.ranks.size)
        bootstrap = self._values(batch.last_observations, batch.segment_tasks)
        targets: tuple[Tensor, Tensor] | None = None
        if len(parts) > 1:  # a single micro-batch supplies the values that GAE needs by its own forward pass
            targets = self._targets(batch, self._values(batch.observations, batch.tasks), bootstrap)
        factors = self.adapter.factors(batch.latent)
        ratios = None
        if factors is not None:
            ratios = float(present(factors, self.algorithm.level).sum()) / len(factors)
        means: dict[str, float] = {}
        samples: list[Tensor] = []
        for rows, own in parts:
            evaluation = self.adapter.evaluate(*batch.part(rows))
            counted = slice(None) if own else slice(0)
            if targets is None:
                mine = evaluation.value.detach().cpu().float()[counted]
                targets = self._targets(batch, self.ranks.gather(mine, len(batch)), bootstrap)
            device = evaluation.log_prob.device
            inputs = LossInputs(
                log_prob_new=evaluation.log_prob,
                log_prob_old=batch.log_prob[rows].to(device),
                advantage=targets[0][rows].to(device),
                value=evaluation.value,
                returns=targets[1][rows].to(device),
                entropy=evaluation.entropy,
                factors=None if factors is None else factors[rows].to(device),
                ratios_per_decision=ratios,
            )
            output = self.algorithm.loss(inputs)
            share = len(rows) / len(batch) if own else 0.0
            loss = output.loss * share * self.ranks.size  # a gradient is the mean over ranks
            (loss * math.nan if fault_point("trainer.loss") else loss).backward()
            for name, mean in output.means.items():
                weight = float(own) if name == "decisions" else share
                means[name] = means.get(name, 0.0) + (weight * float(mean) if own else 0.0)
            samples.append(output.samples[counted].cpu())
        if not self.config.zero:
            self.ranks.average(self._policy + self._value)
        assert targets is not None
        share_of_means = torch.tensor([list(means.values())], dtype=torch.float64)
        total = self.ranks.gather(share_of_means, self.ranks.size).sum(0).tolist()
        gathered = sample_metrics(self.ranks.gather(torch.cat(samples), len(batch)), output.clip)
        return {
            **dict(zip(means, total, strict=True)),
            **{name: float(value) for name, value in gathered.items()},
            "return_mean": float(targets[1].mean()),
            "reward_mean": float(batch.reward.mean()),
        }

    def _targets(self, batch: Batch, values: Tensor, bootstrap: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised advantages, and returns, each (N,)."""
        mask = decision_mask(batch.lengths, int(batch.lengths.max()))
        padded = torch.zeros(mask.shape)
        reward, value = (padded.masked_scatter(mask, x.float()) for x in (batch.reward, values))
        gamma, lam = self.algorithm.gamma, self.algorithm.lam
        advantages, returns = gae(
            reward, value, bootstrap, batch.terminated, batch.lengths, gamma=gamma, lam=lam
        )
        total = self.config.advantage_memory * self._moments + moments(advantages, mask)
        if bool(torch.isfinite(total).all()):  # a batch that is not finite is skipped, and must be forgotten
            self._moments = total
        return normalise(advantages, total, mask)[mask], returns[mask]

    def _values(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> Tensor:
        """V of each row, (rows,), without gradient, at most `micro_batch` rows at a time."""

        def values(rows: np.ndarray) -> Tensor:
            return self.adapter.values(*pick(observations, tasks, rows)).float()

        return self.ranks.each(values, np.arange(len(tasks)), self.config.micro_batch)
