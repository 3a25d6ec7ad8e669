# SPDX-License-Identifier: Apache-2.0
"""Importance sampling without a clip, or truncated: the plain off-policy policy gradient, to compare with.

    ρ_c = min(ρ, cap)            cap None: ρ_c = ρ
    L = −E[ρ_c Â]  +  the shared terms of `objective`

The gradient is −E[ρ_c Â ∇log π]: a truncated sample keeps the weight `cap` (Ionides, *Truncated importance
sampling*, 2008; the weight of V-trace, arXiv 1802.01561). Differentiating min(ρ, cap) itself would leave such
samples no gradient at all, which is a clip.

Without a cap this is unbiased at level ``chunk``, and nothing but `ratio.LOG_RATIO_CLAMP` bounds what one
sample can do. It equals GIPO with an infinite σ.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from accerl_lerobot.algorithms.contract import AlgorithmConfig, LossInputs, LossOutput, RatioConfig
from accerl_lerobot.algorithms.objective import advantage_column, assemble, mean_over_ratios
from accerl_lerobot.algorithms.ratio import at_level, ratio
from accerl_lerobot.config.ranges import Range


@AlgorithmConfig.register_subclass("is")
@dataclass(frozen=True, kw_only=True)
class ImportanceConfig(RatioConfig):
    """Settings of importance sampling."""

    cap: Annotated[float, Range("[1, inf)")] | None = None
    """Largest weight of a sample; None: unbounded."""


def importance_loss(inputs: LossInputs, config: ImportanceConfig) -> LossOutput:
    """See the top of the file. E is the mean over all ratios of all decisions.

    Args:
        inputs: the batch; `LossInputs` states the shapes.
        config: cap and coefficients.
    """
    logs = at_level(inputs.log_prob_new - inputs.log_prob_old.detach(), inputs, config.level)
    rho = ratio(logs)
    weighted = rho
    if config.cap is not None:
        # 1 + log ρ − log ρ̄ is 1 with the gradient ∇log π, also where `ratio` is clamped and has none.
        weighted = rho.detach().clamp(max=config.cap) * (1.0 + logs - logs.detach())
    return assemble(
        inputs,
        config,
        policy_loss=-mean_over_ratios(weighted * advantage_column(inputs), inputs, config.level),
        log_ratio=logs,
        weight=weighted / rho,
    )
