# SPDX-License-Identifier: Apache-2.0
"""The objectives with a likelihood ratio, GIPO and PPO: ratios, the terms that they share, and metrics.

L = L_policy + ½ · E(V − R)² + kl_coef · KL(μ‖π) − entropy_coef · H

ρ = π(a|o) / μ(a|o). μ is the behaviour policy, the one that acted; its log-prob is stored with the sample.
E is the mean over all ratios of all decisions, which are handled as logs of shape (N, F), F per decision:

    level       one ratio covers                      F
    token       one log-prob factor                   L
    chunk       all factors of a decision             1

At level ``chunk`` ρ is the exact density ratio of the decision; its variance grows with L. At level ``token``
every ratio is of its own factor alone and all of them share the decision's advantage: lower variance, and an
approximation off-policy. Losses average over ratios, so at equal weights the gradient is 1/F of that at level
``chunk``. ``docs/metrics.md`` explains the numbers.

Masks, of ratios that exist, are applied by filling and not by indexing, so nothing waits for the device.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from accerl_lerobot.algorithms.config import AlgorithmConfig, Level, LossInputs
from accerl_lerobot.config.ranges import NonNegative, Range, Share
from accerl_lerobot.experience import Metrics

if TYPE_CHECKING:
    from torch import Tensor

LOG_RATIO_CLAMP = 20.0
"""Limit of |log ρ|, beyond which ρ has no gradient: float32 overflows at 88, and ρ is squared."""
KL_LINEAR_ABOVE = 3.0
"""Above this log ρ (ρ ≈ 20) the KL penalty is continued linearly: its gradient, (ρ − 1)·∇log π, is unbounded,
so that one stale sample could decide a whole update."""
USUAL_CLIP = 0.2  # |ρ − 1| above which the clip fraction counts, whatever an algorithm clips: runs compare
LOW_WEIGHT = 0.1  # share of its gradient below which a sample is as good as lost
TINY = 1e-30  # makes the effective sample size 0, and not NaN, when every weight is 0
VARIANCE_FLOOR = 1e-12  # returns that vary less (a standard deviation of 1e-6) are constant up to rounding


def at_level(x: Tensor, inputs: LossInputs, level: Level) -> Tensor:
    """Sums log-probs, or differences of them, (N, L), over the factors that one ratio covers: (N, F).

    Factors that do not exist add 0 and get no gradient, even where they are NaN.
    """
    x = x.masked_fill(~inputs.factors, 0.0)
    if level == "token":
        return x
    return x.sum(dim=-1, keepdim=True)


def present(factors: Tensor, level: Level) -> Tensor:
    """bool (N, F), the ratios that cover at least one existing factor; `factors` is bool (N, L)."""
    if level == "token":
        return factors
    return factors.any(dim=-1, keepdim=True)


def ratio(log_ratio: Tensor) -> Tensor:
    """ρ, finite for any finite log ρ; same shape."""
    return log_ratio.clamp(-LOG_RATIO_CLAMP, LOG_RATIO_CLAMP).exp()


def kl_from_behaviour(log_ratio: Tensor) -> Tensor:
    """Per-sample estimate of KL(μ‖π) from samples of μ: (ρ − 1) − log ρ, same shape, never negative.

    "k3" of Schulman, *Approximating KL divergence* (2020), in the direction in which the samples come from
    the first argument: unbiased, with an unbiased gradient, and zero with its gradient where π = μ.
    Deviation: linear in log ρ above `KL_LINEAR_ABOVE`.
    """
    x = log_ratio.clamp(max=KL_LINEAR_ABOVE)
    slope = math.expm1(KL_LINEAR_ABOVE)
    return x.expm1() - x + slope * (log_ratio - x)


def masked_mean(x: Tensor, mask: Tensor) -> Tensor:
    """Mean over the entries where `mask`, bool and of the same shape, is True; a scalar, 0 if none is."""
    total = x.masked_fill(~mask, 0.0).sum()
    return total / mask.sum().clamp(min=1)


def mean_over_ratios(x: Tensor, inputs: LossInputs, level: Level) -> Tensor:
    """Mean of (N, F) over all ratios that exist, a scalar; all weigh the same.

    Averaging over each decision's own first would bias the policy gradient towards decisions with few.
    """
    counts = present(inputs.factors, level)
    if inputs.ratios_per_decision is None:
        return masked_mean(x, counts)
    total = x.masked_fill(~counts, 0.0).sum()
    return total / (len(x) * inputs.ratios_per_decision)


def advantage_column(inputs: LossInputs) -> Tensor:
    """(N, 1), without gradient: broadcasts against the (N, F) ratios, which share it."""
    return inputs.advantage.detach()[:, None]


def sample_metrics(samples: Tensor) -> dict[str, Tensor]:
    """Scalars, see ``docs/metrics.md``, of the `LossOutput.samples` of a batch's parts, in any order."""
    f = (samples.shape[1] - 2) // 3
    log_ratio, weight, exists, value, returns = samples.split([f, f, f, 1, 1], dim=1)
    keep = exists.bool()
    rho = ratio(log_ratio)
    deviation = (rho - 1.0).abs()
    clipped = deviation > USUAL_CLIP
    weighted = weight * rho
    mean_weight = masked_mean(weighted, keep)
    mean_square = masked_mean(weighted.square(), keep)
    lost = weight < LOW_WEIGHT
    spread = returns.var(correction=0)
    left = (returns - value).var(correction=0)
    explained = 1.0 - left / spread.clamp(min=VARIANCE_FLOOR)
    return {
        "approx_kl": masked_mean(rho - 1.0 - log_ratio, keep),
        "ess": mean_weight.square() / mean_square.clamp(min=TINY),  # Kish's
        "low_weight": masked_mean(lost.float(), keep),
        "clip_fraction": masked_mean(clipped.float(), keep),
        "ratio_max_dev": deviation.max(),
        "explained_variance": explained.masked_fill(spread <= VARIANCE_FLOOR, 0.0),
    }


def lag_metrics(version: np.ndarray, trainer_version: int) -> Metrics:
    """How stale a batch is, in updates; `version`, int (N,), is of the weights behind each decision."""
    lag = trainer_version - version
    return {"lag_mean": float(lag.mean()), "lag_max": float(lag.max())}


@dataclass(frozen=True, kw_only=True)
class LossOutput:
    """Loss of one batch, and what its metrics are computed from."""

    loss: Tensor  # (), call ``backward`` on it
    means: dict[str, Tensor]  # means over decisions, scalars without gradient
    samples: Tensor
    """float64 (N, 3F + 2) without gradient, for metrics that are no means over decisions: of each ratio
    log ρ, ω and 1 if it exists, else 0; V; R."""


def assemble(
    inputs: LossInputs, config: RatioConfig, *, policy_loss: Tensor, log_ratio: Tensor, weight: Tensor
) -> LossOutput:
    """Adds the shared terms to a policy loss and measures the batch.

    `log_ratio` (N, F), log π/μ with gradient, is from `at_level`; `weight` (N, F) is how much of each
    sample's gradient the algorithm keeps, ω.
    """
    import torch

    value_loss = (inputs.value - inputs.returns).square().mean()
    mean_entropy = inputs.entropy.mean()
    kl = mean_over_ratios(kl_from_behaviour(log_ratio), inputs, config.level)
    loss = policy_loss + 0.5 * value_loss
    if config.kl_coef:
        loss = loss + config.kl_coef * kl
    if config.entropy_coef:  # an entropy that is not used may be non-finite
        loss = loss - config.entropy_coef * mean_entropy
    means = {
        "loss": loss,
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "kl": kl,
        "entropy": mean_entropy,
    }
    means = {name: mean.detach() for name, mean in means.items()}
    exists = present(inputs.factors, config.level)
    columns = (log_ratio, weight, exists, inputs.value[:, None], inputs.returns[:, None])
    samples = torch.cat([column.detach().double() for column in columns], 1)
    return LossOutput(loss=loss, means=means, samples=samples)


@dataclass(frozen=True, kw_only=True)
class RatioConfig(AlgorithmConfig):
    """Base of the objectives that weight decisions by their likelihood under new and old weights."""

    update = "accerl_lerobot.algorithms.ratio_update:RatioUpdate"

    lam: Share = 0.95
    """λ of GAE per decision: 0 trusts the critic, 1 the observed rewards."""
    level: Level = "token"
    """Extent of one importance ratio: each log-prob factor, a token or, of a flow or Gaussian policy, an
    action (``token``), or the whole ``chunk``."""
    kl_coef: NonNegative = 0.0
    """Weight of KL(μ‖π), the distance from the behaviour policy."""
    entropy_coef: NonNegative = 0.0
    """Weight of the entropy bonus."""

    def loss(self, inputs: LossInputs) -> LossOutput:
        """The objective, with its diagnostics; `assemble` adds the shared terms."""
        raise NotImplementedError(f"{type(self).__name__} has no loss(inputs)")


@AlgorithmConfig.register_subclass("gipo")
@dataclass(frozen=True, kw_only=True)
class GIPOConfig(RatioConfig):
    """Settings of GIPO (arXiv 2603.03955, used by AcceRL, 2603.18464); the defaults are the paper's.

        ω = exp(−½ (log ρ̄ / σ)²)          ρ̄ = ρ without gradient
        L = −E[ω · ρ · Â]  +  the shared terms

    A Gaussian trust weight on the log-ratio instead of a clip. The gradient is −E[ω ρ Â ∇log π]. At ρ = 1 it
    is the plain policy gradient; ω·ρ never exceeds exp(σ²/2) and fades to 0 the further the current policy
    has moved from the one that acted, in both directions. Deviations from the paper: the KL is estimated from
    samples, because a flow policy has no token bins to sum over, and log ρ is clamped.
    """

    sigma: Annotated[float, Range("(0, inf]")] = 1.0
    """Width of the trust weight in nats of log ρ; ``inf`` is importance sampling without any clip."""
    kl_coef: NonNegative = 0.1
    """Weight of KL(μ‖π), the distance from the behaviour policy."""

    def loss(self, inputs: LossInputs) -> LossOutput:
        logs = at_level(inputs.log_prob_new - inputs.log_prob_old, inputs, self.level)
        distance = logs.detach() / self.sigma
        weight = (-0.5 * distance.square()).exp()
        weighted = weight * ratio(logs) * advantage_column(inputs)
        policy_loss = -mean_over_ratios(weighted, inputs, self.level)
        return assemble(inputs, self, policy_loss=policy_loss, log_ratio=logs, weight=weight)


@AlgorithmConfig.register_subclass("ppo")
@dataclass(frozen=True, kw_only=True)
class PPOConfig(RatioConfig):
    """Settings of PPO with a clip (arXiv 1707.06347), asymmetric as in DAPO (arXiv 2503.14476, section 3.1).

        L = −E[min(ρ Â, clip(ρ, 1 − low, 1 + high) Â)]  +  the shared terms

    The ratio is taken against the behaviour policy, so under asynchrony the clip range is also the staleness
    budget: at a large lag most samples are outside and their gradient is gone. That is what GIPO is for.
    """

    clip_low: Annotated[float, Range("(0, 1)")] = 0.2
    """How far ρ may fall below 1 before a sample with Â < 0 stops counting."""
    clip_high: Annotated[float, Range("(0, inf]")] = 0.28
    """How far ρ may rise above 1 before a sample with Â > 0 stops counting."""

    def loss(self, inputs: LossInputs) -> LossOutput:
        logs = at_level(inputs.log_prob_new - inputs.log_prob_old, inputs, self.level)
        rho = ratio(logs)
        advantage = advantage_column(inputs)
        low = 1.0 - self.clip_low
        high = 1.0 + self.clip_high
        clipped = rho.clamp(low, high) * advantage
        surrogate = (rho * advantage).minimum(clipped)
        above = (advantage > 0.0) & (rho > high)
        below = (advantage < 0.0) & (rho < low)
        dropped = above | below
        return assemble(
            inputs,
            self,
            policy_loss=-mean_over_ratios(surrogate, inputs, self.level),
            log_ratio=logs,
            weight=(~dropped).to(logs.dtype),
        )
