# SPDX-License-Identifier: Apache-2.0
"""GIPO: a Gaussian trust weight on the log-ratio instead of a clip (arXiv 2603.03955, used by AcceRL,
2603.18464).

    ρ = π(a|o) / μ(a|o)
    ω = exp(−½ (log ρ̄ / σ)²)          ρ̄ = ρ without gradient
    L = −E[ω · ρ · Â]  +  the shared terms of `objective`

The gradient is −E[ω ρ Â ∇log π]. At ρ = 1 it is the plain policy gradient; ω·ρ never exceeds exp(σ²/2) and
fades to 0 the further the current policy has moved from the one that acted, in both directions. PPO drops
such samples at an edge, and only on one side.

Deviations from the paper:
    * the KL to the behaviour policy is estimated from samples (`ratio.kl_from_behaviour`), not summed over
      token bins, because a flow policy has no bins;
    * log ρ is clamped, see `ratio.LOG_RATIO_CLAMP`.

Importance sampling, to compare with: ω = 1 at an infinite σ, or truncated,

    L = −E[min(ρ, cap) Â]  +  the shared terms,      gradient −E[min(ρ, cap) Â ∇log π]

A truncated sample keeps the weight `cap` (Ionides, *Truncated importance sampling*, 2008; the weight of
V-trace, arXiv 1802.01561). Differentiating min(ρ, cap) itself would leave such samples no gradient, which
is a clip. Without a cap this is unbiased at level ``chunk``, and nothing but `ratio.LOG_RATIO_CLAMP` bounds
what one sample can do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from accerl_lerobot.algorithms.contract import AlgorithmConfig, LossInputs, RatioConfig
from accerl_lerobot.algorithms.objective import LossOutput, advantage_column, assemble, mean_over_ratios
from accerl_lerobot.algorithms.ratio import at_level, ratio
from accerl_lerobot.config.ranges import NonNegative, Range

if TYPE_CHECKING:
    from torch import Tensor


@AlgorithmConfig.register_subclass("gipo")
@dataclass(frozen=True, kw_only=True)
class GIPOConfig(RatioConfig):
    """Settings of GIPO; the defaults are the paper's."""

    sigma: Annotated[float, Range("(0, inf]")] = 1.0
    """Width of the trust weight in nats of log ρ; ``inf`` is importance sampling without any clip."""
    sigma_negative: Annotated[float, Range("(0, inf]")] | None = None
    """The width where Â ≤ 0; None is the paper's symmetric form, a later variant halves `sigma`."""
    kl_coef: NonNegative = 0.1
    """Weight of KL(μ‖π), the distance from the behaviour policy."""


def trust_weight(log_ratio: Tensor, advantage: Tensor, config: GIPOConfig) -> Tensor:
    """ω in [0, 1], (N, F), without gradient.

    Args:
        log_ratio: (N, F).
        advantage: (N, 1), only its sign is used.
        config: the widths.
    """
    positive = (-0.5 * (log_ratio.detach() / config.sigma).square()).exp()
    if config.sigma_negative is None:
        return positive
    negative = (-0.5 * (log_ratio.detach() / config.sigma_negative).square()).exp()
    return positive.where(advantage > 0.0, negative)


def gipo_loss(inputs: LossInputs, config: GIPOConfig) -> LossOutput:
    """See the top of the file. E is the mean over all ratios of all decisions."""
    advantage = advantage_column(inputs)
    logs = at_level(inputs.log_prob_new - inputs.log_prob_old.detach(), inputs, config.level)
    weight = trust_weight(logs, advantage, config)
    policy_loss = -mean_over_ratios(weight * ratio(logs) * advantage, inputs, config.level)
    return assemble(inputs, config, policy_loss=policy_loss, log_ratio=logs, weight=weight)


@AlgorithmConfig.register_subclass("is")
@dataclass(frozen=True, kw_only=True)
class ImportanceConfig(RatioConfig):
    """Settings of importance sampling."""

    cap: Annotated[float, Range("[1, inf)")] | None = None
    """Largest weight of a sample; None: unbounded."""


def importance_loss(inputs: LossInputs, config: ImportanceConfig) -> LossOutput:
    """See the top of the file. E is the mean over all ratios of all decisions."""
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
