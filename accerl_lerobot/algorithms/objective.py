# SPDX-License-Identifier: Apache-2.0
"""Importance ratios, the terms that all objectives share, and the metrics that are logged about every update.

L = L_policy + value_coef · mean value error + kl_coef · KL(μ‖π) − entropy_coef · H

ρ = π(a|o) / μ(a|o). μ is the behaviour policy, the one that acted; its log-prob is stored with the sample.
All ratios are handled as logs of shape (N, F), F ratios per decision:

    level       one ratio covers                      F
    token       one log-prob factor                   L
    chunk       all factors of a decision             1

At level ``chunk`` ρ is the exact density ratio of the decision; its variance grows with L. At level ``token``
every ratio is of its own factor alone and all of them share the decision's advantage: lower variance, and an
approximation off-policy. Losses average over ratios, so at equal weights the gradient is
1/F of that at level ``chunk``. `Samples.metrics` and `lag_metrics` make the numbers that ``docs/metrics.md``
explains.

Masks, of ratios that exist, are applied by filling and not by indexing, so nothing waits for the device.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from accerl_lerobot.algorithms.contract import Level, LossInputs, RatioConfig

if TYPE_CHECKING:
    from torch import Tensor

LOG_RATIO_CLAMP = 20.0
"""|log ρ| is limited to this before the exponential.

float32 overflows at 88 and the effective sample size squares ρ, so anything below 44 is finite; 20 leaves
room for sums over a batch. Beyond it the gradient of ρ is zero. GIPO never notices: at σ = 1 its weight
there is exp(−200).
"""
KL_LINEAR_ABOVE = 3.0
"""Above this log ρ (ρ ≈ 20) the KL penalty grows linearly instead of exponentially.

Its gradient is (ρ − 1)·∇log π per sample: unbounded in ρ, so one stale sample could decide a whole update.
The linear continuation has the same slope at the joint, still pulls π back, and is biased only for samples
that far away.
"""
USUAL_CLIP = (0.2, 0.2)
"""Range (low, high) of the reported clip fraction of algorithms that clip nothing, so that runs compare."""
LOW_WEIGHT = 0.1
"""A sample below this share of its gradient is as good as lost."""
TINY = 1e-30
"""Makes the effective sample size 0, and not NaN, when every weight is 0."""
VARIANCE_FLOOR = 1e-12
"""Returns that vary less (a standard deviation of 1e-6) are constant up to rounding."""


def at_level(x: Tensor, inputs: LossInputs, level: Level) -> Tensor:
    """Sums log-probs, or differences of them, over the factors that one ratio covers.

    Args:
        x: (N, L).

    Returns:
        (N, F). Factors that do not count add 0 and get no gradient, even where they are NaN.
    """
    if inputs.factors is not None:
        x = x.masked_fill(~inputs.factors, 0.0)
    return x.sum(dim=-1, keepdim=True) if level == "chunk" else x


def present(factors: Tensor, level: Level) -> Tensor:
    """bool (N, F), the ratios that cover at least one existing factor; `factors` is bool (N, L)."""
    return factors.any(dim=-1, keepdim=True) if level == "chunk" else factors


def present_in(inputs: LossInputs, level: Level) -> Tensor | None:
    """bool (N, F), the ratios that count; None: all."""
    return None if inputs.factors is None else present(inputs.factors, level)


def ratio(log_ratio: Tensor) -> Tensor:
    """ρ, finite for any finite log ρ; same shape."""
    return log_ratio.clamp(-LOG_RATIO_CLAMP, LOG_RATIO_CLAMP).exp()


def kl_from_behaviour(log_ratio: Tensor) -> Tensor:
    """Per-sample estimate of KL(μ‖π) from samples of μ: (ρ − 1) − log ρ, same shape, never negative.

    This is "k3" of Schulman, *Approximating KL divergence* (2020), in the direction in which the samples
    come from the first argument. E_μ[−log ρ] = KL(μ‖π) and E_μ[ρ − 1] = 0, so it is unbiased; the second
    term is a control variate that makes it vanish together with its gradient where π = μ. Its gradient is
    unbiased as well: E_μ[(ρ − 1)∇log π] = −E_μ[∇log π]. Swapping μ and π here would estimate nothing of
    use.

    Deviation: linear in log ρ above `KL_LINEAR_ABOVE`, see there.
    """
    x = log_ratio.clamp(max=KL_LINEAR_ABOVE)
    return x.expm1() - x + math.expm1(KL_LINEAR_ABOVE) * (log_ratio - x)


def masked_mean(x: Tensor, mask: Tensor | None) -> Tensor:
    """Mean over the entries where `mask`, bool and of the same shape, is True; a scalar, 0 if none is."""
    if mask is None:
        return x.mean()
    return x.masked_fill(~mask, 0.0).sum() / mask.sum().clamp(min=1)


def mean_over_ratios(x: Tensor, inputs: LossInputs, level: Level) -> Tensor:
    """Mean of (N, F) over all ratios that count, a scalar.

    Where decisions have different numbers of factors all factors weigh the same. Averaging over each
    decision's own first would weigh them by 1/F and bias the policy gradient towards decisions with few.
    """
    counts = present_in(inputs, level)
    if inputs.ratios_per_decision is None:
        return masked_mean(x, counts)
    total = (x if counts is None else x.masked_fill(~counts, 0.0)).sum()
    return total / (len(x) * inputs.ratios_per_decision)


def advantage_column(inputs: LossInputs) -> Tensor:
    """(N, 1), without gradient: broadcasts against the (N, F) ratios, which share it."""
    return inputs.advantage.detach()[:, None]


# Metrics.


def approx_kl(log_ratio: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean of (ρ − 1) − log ρ over samples of μ, (), from (N, F)."""
    return masked_mean(ratio(log_ratio) - 1.0 - log_ratio, mask)


def ess_share(weighted_ratio: Tensor, mask: Tensor | None = None) -> Tensor:
    """Kish's effective sample size (Σw)² / (n Σw²) of w = ω·ρ, (), in [0, 1], from (N, F)."""
    squares = masked_mean(weighted_ratio.square(), mask)
    return masked_mean(weighted_ratio, mask).square() / squares.clamp(min=TINY)


def share_below(x: Tensor, threshold: float, mask: Tensor | None = None) -> Tensor:
    """Share of samples below `threshold`, ()."""
    return masked_mean((x < threshold).float(), mask)


def clip_fraction(rho: Tensor, low: float, high: float, mask: Tensor | None = None) -> Tensor:
    """Share of ratios outside [1 − low, 1 + high], ()."""
    return masked_mean(((rho < 1.0 - low) | (rho > 1.0 + high)).float(), mask)


def quantiles(x: Tensor, points: dict[str, float], mask: Tensor | None = None) -> dict[str, Tensor]:
    """Linear-interpolated quantiles of the valid entries, each (); NaN when there is none."""
    if mask is not None:
        x = x.masked_fill(~mask, float("nan"))
    flat = x.flatten()
    return {name: flat.nanquantile(point) for name, point in points.items()}


def explained_variance(value: Tensor, returns: Tensor) -> Tensor:
    """1 − Var(R − V) / Var(R), (), from (N,); 0 where the returns do not vary, as it is undefined there."""
    spread = returns.var(correction=0)
    explained = 1.0 - (returns - value).var(correction=0) / spread.clamp(min=VARIANCE_FLOOR)
    return explained.masked_fill(spread <= VARIANCE_FLOOR, 0.0)


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Inputs of one batch's metrics, without gradient; parts of a batch are joined first.

    Quantiles, the effective sample size and explained variance of a batch are not means of those of its
    micro-batches, so they are computed once, from the samples of all micro-batches and ranks.
    """

    log_ratio: Tensor
    """(N, F), 0 where a ratio does not exist."""
    weight: Tensor
    """(N, F), ω."""
    keep: Tensor
    """bool (N, F), the ratios that count."""
    value: Tensor
    """(N,), V."""
    returns: Tensor
    """(N,), R."""
    clip: tuple[float, float]
    """(low, high) of the clip range."""

    def rows(self) -> Tensor:
        """All of it on the CPU, float64 (N, 3F + 2), for `joined`."""
        import torch

        narrow = (self.value[:, None], self.returns[:, None])
        return torch.cat([x.double().cpu() for x in (self.log_ratio, self.weight, self.keep, *narrow)], 1)

    def joined(self, rows: Tensor) -> Samples:
        """The samples of a whole batch, from the `rows` of its parts in any order, laid end to end."""
        log_ratio, weight, keep, narrow = rows.split([*[self.log_ratio.shape[1]] * 3, 2], dim=1)
        value, returns = narrow.unbind(1)
        return Samples(
            log_ratio=log_ratio, weight=weight, keep=keep.bool(), value=value, returns=returns, clip=self.clip
        )

    def metrics(self) -> dict[str, Tensor]:
        """Scalars, see ``docs/metrics.md``."""
        rho = ratio(self.log_ratio)
        points = {"log_ratio_p05": 0.05, "log_ratio_p50": 0.5, "log_ratio_p95": 0.95}
        return {
            "approx_kl": approx_kl(self.log_ratio, self.keep),
            "ess": ess_share(self.weight * rho, self.keep),
            "low_weight": share_below(self.weight, LOW_WEIGHT, self.keep),
            "clip_fraction": clip_fraction(rho, *self.clip, self.keep),
            "ratio_max_dev": (rho - 1.0).abs().max(),
            **quantiles(self.log_ratio, points, self.keep),
            "explained_variance": explained_variance(self.value, self.returns),
        }


def lag_metrics(version: Tensor, trainer_version: int) -> dict[str, Tensor]:
    """How stale a batch is, in updates.

    Args:
        version: int (N,), the weights behind each decision.
        trainer_version: updates made so far.
    """
    lag = (trainer_version - version).float()
    return {"lag_mean": lag.mean(), **quantiles(lag, {"lag_p95": 0.95, "lag_max": 1.0})}


# The loss.


@dataclass(frozen=True, kw_only=True)
class LossOutput:
    """Loss and metrics of one batch."""

    loss: Tensor
    """(), call ``backward`` on it."""
    means: dict[str, Tensor]
    """Means over decisions, scalars without gradient. Those of micro-batches, weighted by their decisions,
    add up to that of the whole batch; ``decisions`` is a count."""
    samples: Samples
    """Per-decision values behind the metrics that are no means over decisions, without gradient."""

    @property
    def metrics(self) -> dict[str, Tensor]:
        """Scalars of this batch, still on the device."""
        return self.means | self.samples.metrics()


def assemble(
    inputs: LossInputs,
    config: RatioConfig,
    *,
    policy_loss: Tensor,
    log_ratio: Tensor,
    weight: Tensor,
    clip: tuple[float, float] = USUAL_CLIP,
) -> LossOutput:
    """Adds the shared terms to a policy loss and measures the batch.

    Args:
        policy_loss: (), with gradient.
        log_ratio: (N, F), log π/μ with gradient, from `at_level`.
        weight: (N, F), how much of each sample's gradient the algorithm keeps, ω.
        clip: see `Samples.clip`.
    """
    value_loss, mean_entropy = inputs.value_error.mean(), inputs.entropy.mean()
    kl = mean_over_ratios(kl_from_behaviour(log_ratio), inputs, config.level)
    loss = policy_loss + config.value_coef * value_loss
    if config.kl_coef:
        loss = loss + config.kl_coef * kl
    if config.entropy_coef:  # an entropy that is not used may be non-finite
        loss = loss - config.entropy_coef * mean_entropy
    means = {"policy_loss": policy_loss, "value_loss": value_loss, "kl": kl, "entropy": mean_entropy}
    means |= {"loss": loss, "decisions": loss.new_tensor(float(len(inputs.value)))}
    keep = present_in(inputs, config.level)
    samples = Samples(
        log_ratio=log_ratio.detach(),
        weight=weight.detach(),
        keep=log_ratio.new_ones(log_ratio.shape).bool() if keep is None else keep,
        value=inputs.value.detach(),
        returns=inputs.returns.detach(),
        clip=clip,
    )
    return LossOutput(loss=loss, means={k: v.detach() for k, v in means.items()}, samples=samples)
