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
"""The importance ratio ρ = π(a|o) / μ(a|o), its numerical guards, and the penalty KL(μ‖π).

μ is the behaviour policy, the one that acted; its log-prob is stored with the sample. All ratios are
handled as logs of shape (N, F): F = L at level ``action``, F = 1 at level ``chunk``.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from accerl_lerobot.algorithms.contract import Level

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


def log_ratio(new: Tensor, old: Tensor, level: Level, mask: Tensor | None = None) -> Tensor:
    """log ρ, not clamped.

    At level ``chunk`` ρ is the exact density ratio of the decision, whose variance grows with L; at level
    ``action`` each factor has its own ratio and all of them share the decision's advantage: lower variance,
    and an approximation off-policy. Losses average over factors, so at equal weights the gradient at level
    ``action`` is 1/L of that at level ``chunk``.

    Args:
        new: (N, L), log π.
        old: (N, L), log μ.
        level: what one ratio covers.
        mask: bool (N,); padding gets log ρ = 0 and no gradient, even where it is NaN.

    Returns:
        (N, L) or (N, 1).
    """
    difference = new - old
    if mask is not None:
        difference = difference.masked_fill(~mask[:, None], 0.0)
    return difference.sum(dim=-1, keepdim=True) if level == "chunk" else difference


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
    """Mean over the valid decisions (and their factors), a scalar; 0 when there is none.

    Args:
        x: (N,) or (N, F). Padding may be non-finite in value; it must not be so in gradient, so mask
        earlier as well.
        mask: bool (N,) or None.
    """
    if mask is None:
        return x.mean()
    factors = x[0].numel() if x.dim() > 1 and len(x) else 1
    where = mask[:, None] if x.dim() > 1 else mask
    return x.masked_fill(~where, 0.0).sum() / (mask.sum() * factors).clamp(min=1)
