# SPDX-License-Identifier: Apache-2.0
"""One update by a likelihood ratio: segments in, better weights and numbers about them out.

    batch → values of the current critic → advantages, normalised over the batch
          → loss and gradient, one micro-batch after the other → step of the optimiser

Values stored with the samples are stale by their lag, so they are recomputed. The stored log-probs are not:
the ratio divides by them. Of several ranks each makes the same update; see `ranks`.

Advantages are generalised advantage estimates (`gae`, arXiv 1506.02438) per decision:

    δ_t = r_t + γ V_{t+1} − V_t
    Â_t = δ_t + γλ Â_{t+1}
    R_t = Â_t + V_t

r_t is the reward summed over a whole chunk, so γ and λ are per decision. The value after the last decision of
a segment is 0 if the episode *terminated*, by its time limit too. It is V of the observation after the
decision if the segment was cut in mid-episode. `normalise` works on the whole batch: per micro-batch it would
compare a decision only with its neighbours.

Shapes: S segments, N decisions in all.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.algorithms import LossInputs, RatioConfig, ranks
from accerl_lerobot.algorithms.batch import Batch, collate, pick
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.algorithms.objective import lag_metrics, present, sample_metrics
from accerl_lerobot.algorithms.probe import Probe
from accerl_lerobot.algorithms.ranks import Part
from accerl_lerobot.algorithms.update import STD_EPSILON, BaseUpdate
from accerl_lerobot.checkpoint.snapshot import State
from accerl_lerobot.checkpoint.tensors import in_parts
from accerl_lerobot.experience import Metrics, Observations, Segment
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.policies.adapter import Evaluation, PolicyAdapter


class RatioUpdate(BaseUpdate):
    """Updates by a likelihood ratio."""

    def __init__(self, adapter: PolicyAdapter, algorithm: RatioConfig, config: TrainerConfig) -> None:
        super().__init__(adapter, algorithm, config)
        self.optimizer.add_param_group({"params": self._value})
        self._moments = torch.zeros(3, dtype=torch.float64)  # of the advantages so far
        self._probe = Probe(adapter, config)

    def step(self, segments: Sequence[Segment]) -> Metrics:
        batch = collate(segments)
        mismatch = self._probe.read(batch)
        self.optimizer.zero_grad(set_to_none=True)
        rows = np.arange(len(batch))
        parts = ranks.split_rows(rows, self.config.micro_batch, ranks.rank(), ranks.size())
        following = self._values(batch.last_observations, batch.segment_tasks)
        evaluations: Iterable[Evaluation] = (self.adapter.evaluate(*batch.part(part.rows)) for part in parts)
        if len(parts) == 1:  # the forward pass of a single micro-batch has the values
            (evaluation,) = evaluations
            evaluations = [evaluation]
            local_values = evaluation.value.detach().cpu().float()
            values = ranks.gather(parts[0].counted(local_values), len(batch))
        else:
            values = self._values(batch.observations, batch.tasks)
        advantages, returns = self._targets(batch, values, following)
        metrics = self._backward(batch, parts, evaluations, advantages, returns)
        fault_point("trainer.backward")
        metrics |= self._step(metrics["loss"])
        metrics |= mismatch
        metrics |= lag_metrics(batch.version, self.version)
        self.version += 1
        self._probe.renew(self.version)
        return metrics

    def state(self) -> State:
        state = super().state()
        state["moments"] = self._moments.clone()
        state["probe"] = self._probe.state()
        return state

    def restore(self, state: State) -> None:
        super().restore(state)
        self._moments = state["moments"]
        self._probe.restore(state["probe"])

    def _values(self, observations: Observations, tasks: Sequence[str]) -> Tensor:
        """V of each row, (rows,), without gradient, at most `micro_batch` rows at a time."""

        def values(rows: np.ndarray) -> Tensor:
            return self.adapter.values(*pick(observations, tasks, rows)).float()

        all_rows = np.arange(len(tasks))
        return ranks.over_rows(values, all_rows, self.config.micro_batch)

    def _targets(self, batch: Batch, values: Tensor, following: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised advantages, and returns, each (N,), from V before each decision and V after the last."""
        advantages, returns = gae(
            batch.reward,
            values,
            following,
            batch.terminated,
            batch.lengths,
            gamma=self.algorithm.gamma,
            lam=self.algorithm.lam,
        )
        return normalise(advantages, self._moments_with(advantages)), returns

    def _moments_with(self, advantages: Tensor) -> Tensor:
        """Moments of these advantages and of those before, which are remembered."""
        total = self.config.advantage_memory * self._moments + moments(advantages)
        if total.isfinite().all():  # a batch that is not finite is skipped, and must be forgotten
            self._moments = total
        return total

    def _backward(
        self,
        batch: Batch,
        parts: Sequence[Part],
        evaluations: Iterable[Evaluation],
        advantages: Tensor,
        returns: Tensor,
    ) -> Metrics:
        """Accumulates the gradient of the loss over micro-batches; returns metrics of the whole batch.

        `evaluations` are of the parts, each made when its turn comes.
        """
        factors = self.adapter.factors(batch.latent)
        if factors is None:
            factors = torch.ones(batch.log_prob.shape, dtype=torch.bool)
        ratios = float(present(factors, self.algorithm.level).sum()) / len(batch)
        means: Metrics = {}
        samples: list[Tensor] = []
        for part, evaluation in zip(parts, evaluations, strict=True):
            rows = part.rows
            device = evaluation.log_prob.device
            inputs = LossInputs(
                log_prob_new=evaluation.log_prob,
                log_prob_old=batch.log_prob[rows].to(device),
                advantage=advantages[rows].to(device),
                value=evaluation.value,
                returns=returns[rows].to(device),
                entropy=evaluation.entropy,
                factors=factors[rows].to(device),
                ratios_per_decision=ratios,
            )
            output = self.algorithm.loss(inputs)
            share = 0.0
            if part.own:
                share = len(rows) / len(batch)
            loss = output.loss * share * ranks.size()  # a gradient is the mean over ranks
            if fault_point("trainer.loss"):
                loss = loss * math.nan
            loss.backward()
            for name, mean in output.means.items():
                means[name] = means.get(name, 0.0) + share * float(mean)
            samples.append(part.counted(output.samples.cpu()))
        if not self.config.zero:  # FSDP averages by itself
            ranks.average_gradients(self._policy + self._value)
        metrics = self._whole_means(means)
        all_samples = ranks.gather(torch.cat(samples), len(batch))
        for name, value in sample_metrics(all_samples).items():
            metrics[name] = float(value)
        metrics["decisions"] = len(batch)
        metrics["return_mean"] = float(returns.mean())
        metrics["reward_mean"] = float(batch.reward.mean())
        return metrics

    def _whole_means(self, means: Metrics) -> Metrics:
        """Means over the batch from this rank's shares of them."""
        local_means = torch.tensor([list(means.values())], dtype=torch.float64)
        totals = ranks.gather(local_means, ranks.size()).sum(0)
        return dict(zip(means, totals.tolist(), strict=True))

    def _step(self, loss: float) -> Metrics:
        """A step of the optimiser along the gradient, whose loss it was, if both are finite."""
        lr = self.config.lr * self.lr_share(self.config.value_warmup_updates)
        value_lr = self.config.value_lr * self.lr_share()
        for group, rate in zip(self.optimizer.param_groups, (lr, value_lr), strict=True):
            group["lr"] = rate
        self.spare_policy()
        # Each by itself, or the larger gradient would scale the other one down.
        norm = self._clip(self._policy)
        value_norm = self._clip(self._value)
        self.apply(self.optimizer, "an update", loss, norm + value_norm)
        return {
            "grad_norm": norm,
            "value_grad_norm": value_norm,
            "lr": lr,
            "value_lr": value_lr,
            "skipped": self.skipped,
        }

    def _clip(self, parameters: list[nn.Parameter]) -> float:
        """Scales gradients down to ``trainer.grad_clip``; returns their norm before."""
        norm: Any = torch.nn.utils.clip_grad_norm_(parameters, self.config.grad_clip)
        if in_parts(norm):
            norm = norm.full_tensor()
        return float(norm)


def gae(
    rewards: Tensor,
    values: Tensor,
    bootstrap_value: Tensor,
    terminated: Tensor,
    lengths: Sequence[int],
    *,
    gamma: float,
    lam: float,
) -> tuple[Tensor, Tensor]:
    """Advantages and returns, each (N,), of S segments of `lengths` decisions that are laid end to end.

    `rewards` (N,) are summed over each chunk, `values` (N,) are V before each decision. `bootstrap_value`
    (S,), V after the last one, does not count where `terminated`, bool (S,): True if the episode is over,
    False for segments cut in mid-episode.
    """
    last = torch.tensor(lengths).cumsum(0) - 1
    next_values = values.roll(-1)
    next_values[last] = bootstrap_value.masked_fill(terminated, 0.0)
    advantages = rewards + gamma * next_values - values
    for segment in advantages.split(list(lengths)):  # views, from δ to Â
        for i in reversed(range(len(segment) - 1)):
            segment[i] += gamma * lam * segment[i + 1]
    return advantages, advantages + values


def moments(x: Tensor) -> Tensor:
    """(sum, sum of squares, count) of the entries, (3,).

    In float64, because the variance is the difference of two nearly equal numbers when the mean is large.
    """
    wide = x.double()
    return torch.stack([wide.sum(), wide.square().sum(), torch.ones_like(wide).sum()])


def normalise(x: Tensor, moments: Tensor) -> Tensor:
    """(x − mean) / (std + `STD_EPSILON`), same shape and dtype as `x`.

    `moments` (3,) is of everything that is compared with each other.
    """
    total, squares, count = moments.unbind()
    mean = total / count
    variance = squares / count - mean.square()
    std = variance.clamp(min=0.0).sqrt()
    scaled = (x.double() - mean) / (std + STD_EPSILON)
    return scaled.to(x.dtype)
