# SPDX-License-Identifier: Apache-2.0
"""The metrics that are logged about every update, and their meaning.

``approx_kl``
    Mean of (ρ − 1) − log ρ: KL(μ‖π) in nats, by how much the policy has left the samples.
``kl``
    The penalty as it enters the loss; differs from the above only in being bounded for far samples.
``kl_reference``
    KL(π‖π_ref) as it enters the loss; there only if it does.
``ess``
    Effective sample size of ω·ρ as a share of the samples: 1 all count alike, 1/n one of them decides.
``low_weight``
    Share of samples with ω < 0.1; for PPO, of samples whose gradient the clip removed.
``clip_fraction``
    Share of ratios outside the clip range.
``ratio_max_dev``
    Largest |ρ − 1|; at learning rate 0 this is the mismatch between inference and trainer.
``log_ratio_p05``, ``log_ratio_p50``, ``log_ratio_p95``
    Quantiles of log ρ.
``explained_variance``
    1 − Var(R − V) / Var(R): 1 a perfect critic, 0 no better than a constant, below 0 worse than that.
``lag_mean``, ``lag_p95``, ``lag_max``
    Trainer version − sample version, in updates.
``decisions``
    Decisions in the batch.

Masks, of ratios that exist, are applied by filling and not by indexing, so nothing waits for the device.
Inputs carry no gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from accerl_lerobot.algorithms.ratio import masked_mean, ratio

if TYPE_CHECKING:
    from torch import Tensor

LOW_WEIGHT = 0.1
"""A sample below this share of its gradient is as good as lost."""

TINY = 1e-30
"""Makes the effective sample size 0, and not NaN, when every weight is 0."""

VARIANCE_FLOOR = 1e-12
"""Returns that vary less (a standard deviation of 1e-6) are constant up to rounding."""


def approx_kl(log_ratio: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean of (ρ − 1) − log ρ over samples of μ, (), from (N, F)."""
    return masked_mean(ratio(log_ratio) - 1.0 - log_ratio, mask)


def ess_share(weighted_ratio: Tensor, mask: Tensor | None = None) -> Tensor:
    """Kish's effective sample size (Σw)² / (n Σw²) of w = ω·ρ, (), in [0, 1], from (N, F)."""
    return masked_mean(weighted_ratio, mask).square() / masked_mean(weighted_ratio.square(), mask).clamp(
        min=TINY
    )


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
    grad_weight: Tensor
    """(N, F), factor of Â∇log π in the gradient."""
    clipped: Tensor
    """(N, F), log of the ratios that are clipped."""
    keep: Tensor
    """bool (N, F), the ratios that count."""
    value: Tensor
    """(N,), V."""
    returns: Tensor
    """(N,), R."""
    clip: tuple[float, float]
    """(low, high) of the clip range."""

    def rows(self) -> Tensor:
        """All of it on the CPU, float64 (N, 5F + 2), for `joined`."""
        import torch

        wide = (self.log_ratio, self.weight, self.grad_weight, self.clipped, self.keep)
        narrow = (self.value, self.returns)
        return torch.cat([*(x.double().cpu() for x in wide), *(x.double().cpu()[:, None] for x in narrow)], 1)

    def joined(self, rows: Tensor) -> Samples:
        """The samples of a whole batch, from the `rows` of its parts in any order, laid end to end."""
        *wide, narrow = rows.split([*[self.log_ratio.shape[1]] * 5, 2], dim=1)
        value, returns = narrow.unbind(1)
        return Samples(
            **dict(zip(("log_ratio", "weight", "grad_weight", "clipped"), wide, strict=False)),
            keep=wide[4].bool(),
            value=value,
            returns=returns,
            clip=self.clip,
        )

    def metrics(self) -> dict[str, Tensor]:
        """Scalars; keys are explained at the top."""
        rho = ratio(self.log_ratio)
        points = {"log_ratio_p05": 0.05, "log_ratio_p50": 0.5, "log_ratio_p95": 0.95}
        return {
            "approx_kl": approx_kl(self.log_ratio, self.keep),
            "ess": ess_share(self.grad_weight, self.keep),
            "low_weight": share_below(self.weight, LOW_WEIGHT, self.keep),
            "clip_fraction": clip_fraction(ratio(self.clipped), *self.clip, self.keep),
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
