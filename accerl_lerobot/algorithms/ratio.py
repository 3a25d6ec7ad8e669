# SPDX-License-Identifier: Apache-2.0
"""Importance ratios at each level, their numerical guards, and the two KL penalties.

ρ = π(a|o) / μ(a|o). μ is the behaviour policy, the one that acted; its log-prob is stored with the sample.
All ratios are handled as logs of shape (N, F), F ratios per decision:

    level       one ratio covers                      F
    token       one log-prob factor                   L
    action      the factors of one action             `LossInputs.actions`
    chunk       all factors of a decision             1

At level ``chunk`` ρ is the exact density ratio of the decision; its variance grows with L. At the finer
levels every ratio is of its own factors alone and all of them share the decision's advantage: lower
variance, and an approximation off-policy. Losses average over ratios, so at equal weights the gradient is
1/F of that at level ``chunk``.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from accerl_lerobot.algorithms.contract import check_level

if TYPE_CHECKING:
    from torch import Tensor

    from accerl_lerobot.algorithms.contract import Level, LossInputs

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
that far away. `kl_to_reference` weights with ρ, and no sample of its counts more than at this log ρ either.
"""


def at_level(x: Tensor, inputs: LossInputs, level: Level) -> Tensor:
    """Sums log-probs, or differences of them, over the factors that one ratio covers.

    Args:
        x: (N, L).
        inputs: says which factors count and which of them belong together.
        level: what one ratio covers.

    Returns:
        (N, F). Factors that do not count add 0 and get no gradient, even where they are NaN.

    Raises:
        InputError: level ``action``, and the factors do not align with actions.
    """
    if inputs.factors is not None:
        x = x.masked_fill(~inputs.factors, 0.0)
    return _grouped(x, level, inputs.actions).sum(dim=-1)


def present(factors: Tensor, level: Level, actions: int | None) -> Tensor:
    """bool (N, F), the ratios that cover at least one existing factor; `factors` is bool (N, L)."""
    return _grouped(factors, level, actions).any(dim=-1)


def present_in(inputs: LossInputs, level: Level) -> Tensor | None:
    """bool (N, F), the ratios that count; None: all."""
    return None if inputs.factors is None else present(inputs.factors, level, inputs.actions)


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


def kl_to_reference(log_ratio: Tensor, log_reference: Tensor) -> Tensor:
    """Per-sample estimate of KL(π‖π_ref) from samples of μ, same shape, never negative.

    With y = log π/π_ref, GRPO's k3 (arXiv 2402.03300) is e^−y − 1 + y, for samples of π. Ours are of μ, so it
    is weighted with ρ: E_μ[ρ(e^−y − 1 + y)] = KL(π‖π_ref). Differentiating GRPO's term by itself gives
    (1 − e^−y)∇log π, in expectation the gradient of KL(π_ref‖π), the other divergence (arXiv 2506.09477).
    Differentiating ρ along with it gives ρ·y·∇log π, whose expectation is the gradient of KL(π‖π_ref) itself,
    as in DeepSeek-V3.2 (arXiv 2512.02556). That slope is what is used here.

    What remains: observations are those that μ has met, not π. Below level ``chunk``, so is whatever a factor
    is conditioned on within its decision, and ρ is of that factor alone.

    Deviation: log ρ counts at most `KL_LINEAR_ABOVE` and |y| in the slope at most `LOG_RATIO_CLAMP`. The
    value is only logged; in it π_ref/μ grows linearly above the same point as in `kl_from_behaviour`.

    Args:
        log_ratio: (N, F), log π/μ.
        log_reference: (N, F), log π/π_ref; the gradient goes through it.
    """
    joint = KL_LINEAR_ABOVE
    logs = log_ratio.detach().clamp(-LOG_RATIO_CLAMP, joint)
    y = log_reference.detach()
    rho, from_behaviour = logs.exp(), logs - y  # the latter is log π_ref/μ
    far = rho * (y - 1.0) + math.exp(joint) * (1.0 + from_behaviour - joint)
    value = (rho * ((-y).expm1() + y)).where(from_behaviour <= joint, far)
    slope = rho * y.clamp(-LOG_RATIO_CLAMP, LOG_RATIO_CLAMP)
    return value + slope * (log_reference - y)


def masked_mean(x: Tensor, mask: Tensor | None) -> Tensor:
    """Mean over the entries where `mask`, bool and of the same shape, is True; a scalar, 0 if none is."""
    if mask is None:
        return x.mean()
    return x.masked_fill(~mask, 0.0).sum() / mask.sum().clamp(min=1)


def _grouped(x: Tensor, level: Level, actions: int | None) -> Tensor:
    """(N, F, factors of one ratio) from (N, L)."""
    check_level(level, actions)
    groups = {"token": x.shape[-1], "action": actions or 1, "chunk": 1}[level]
    return x.unflatten(-1, (groups, -1))
