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
"""What is logged about every update, and what each number means.

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
    Valid decisions in the batch.

Nothing here waits for the device: masks are applied by filling, not by indexing. Inputs carry no gradient.
"""

from __future__ import annotations

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
        x = x.masked_fill(~_spread(mask, x), float("nan"))
    flat = x.flatten()
    return {name: flat.nanquantile(point) for name, point in points.items()}


def explained_variance(value: Tensor, returns: Tensor, mask: Tensor | None = None) -> Tensor:
    """1 − Var(R − V) / Var(R), (), from (N,); 0 where the returns do not vary, as it is undefined there."""
    spread = _variance(returns, mask)
    explained = 1.0 - _variance(returns - value, mask) / spread.clamp(min=VARIANCE_FLOOR)
    return explained.masked_fill(spread <= VARIANCE_FLOOR, 0.0)


def ratio_metrics(
    log_ratio: Tensor,
    weight: Tensor,
    mask: Tensor | None = None,
    *,
    clip: tuple[float, float],
    clipped: Tensor | None = None,
    pull: Tensor | None = None,
) -> dict[str, Tensor]:
    """All that is said about ρ and ω; keys are explained at the top.

    Args:
        log_ratio: (N, F), 0 at padding.
        weight: (N, F), ω.
        mask: bool (N, F) or (N,), or None.
        clip: (low, high) of the clip range.
        clipped: (N, F), log of the ratios that are clipped; None: `log_ratio`.
        pull: (N, F), what stands before Â∇log π; None: ω·ρ.
    """
    rho = ratio(log_ratio)
    points = {"log_ratio_p05": 0.05, "log_ratio_p50": 0.5, "log_ratio_p95": 0.95}
    return {
        "approx_kl": approx_kl(log_ratio, mask),
        "ess": ess_share(weight * rho if pull is None else pull, mask),
        "low_weight": share_below(weight, LOW_WEIGHT, mask),
        "clip_fraction": clip_fraction(rho if clipped is None else ratio(clipped), *clip, mask),
        "ratio_max_dev": (rho - 1.0).abs().max(),
        **quantiles(log_ratio, points, mask),
    }


def lag_metrics(version: Tensor, trainer_version: int, mask: Tensor | None = None) -> dict[str, Tensor]:
    """How stale a batch is, in updates.

    Args:
        version: int (N,) or (S, T), the weights behind each decision.
        trainer_version: updates made so far.
        mask: bool, same shape, or None.
    """
    lag = (trainer_version - version).flatten().float()
    if mask is not None:
        lag = lag.masked_fill(~mask.flatten(), float("nan"))
    points = {"lag_p95": 0.95, "lag_max": 1.0}
    return {"lag_mean": lag.nanmean(), **quantiles(lag, points)}


def _spread(mask: Tensor, x: Tensor) -> Tensor:
    return mask[:, None] if x.dim() > mask.dim() else mask


def _variance(x: Tensor, mask: Tensor | None) -> Tensor:
    return masked_mean((x - masked_mean(x, mask)).square(), mask)
