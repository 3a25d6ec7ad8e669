# SPDX-License-Identifier: Apache-2.0
"""The objectives with a likelihood ratio, GIPO and PPO; E is the mean over all ratios of all decisions.

GIPO: a Gaussian trust weight on the log-ratio instead of a clip (arXiv 2603.03955, used by AcceRL,
2603.18464).

    ρ = π(a|o) / μ(a|o)
    ω = exp(−½ (log ρ̄ / σ)²)          ρ̄ = ρ without gradient
    L = −E[ω · ρ · Â]  +  the shared terms of `objective`

The gradient is −E[ω ρ Â ∇log π]. At ρ = 1 it is the plain policy gradient; ω·ρ never exceeds exp(σ²/2) and
fades to 0 the further the current policy has moved from the one that acted, in both directions. Deviations
from the paper: the KL is estimated from samples (`objective.kl_from_behaviour`), because a flow policy has no
token bins to sum over, and log ρ is clamped.

PPO with a clip (Schulman et al., arXiv 1707.06347), asymmetric as in DAPO (arXiv 2503.14476, section 3.1).

    L = −E[min(ρ Â, clip(ρ, 1 − low, 1 + high) Â)]  +  the shared terms of `objective`

The ratio is taken against the behaviour policy, so under asynchrony the clip range is also the staleness
budget: at a large lag most samples are outside and their gradient is gone. That is what GIPO is for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from accerl_lerobot.algorithms.contract import AlgorithmConfig, LossInputs, RatioConfig
from accerl_lerobot.algorithms.objective import (
    LossOutput,
    advantage_column,
    assemble,
    at_level,
    mean_over_ratios,
    ratio,
)
from accerl_lerobot.config.ranges import NonNegative, Range


@AlgorithmConfig.register_subclass("gipo")
@dataclass(frozen=True, kw_only=True)
class GIPOConfig(RatioConfig):
    """Settings of GIPO; the defaults are the paper's."""

    sigma: Annotated[float, Range("(0, inf]")] = 1.0
    """Width of the trust weight in nats of log ρ; ``inf`` is importance sampling without any clip."""
    kl_coef: NonNegative = 0.1
    """Weight of KL(μ‖π), the distance from the behaviour policy."""

    def loss(self, inputs: LossInputs) -> LossOutput:
        logs = at_level(inputs.log_prob_new - inputs.log_prob_old, inputs, self.level)
        weight = (-0.5 * (logs.detach() / self.sigma).square()).exp()
        weighted = weight * ratio(logs) * advantage_column(inputs)
        policy_loss = -mean_over_ratios(weighted, inputs, self.level)
        return assemble(inputs, self, policy_loss=policy_loss, log_ratio=logs, weight=weight)


@AlgorithmConfig.register_subclass("ppo")
@dataclass(frozen=True, kw_only=True)
class PPOConfig(RatioConfig):
    """Settings of PPO."""

    clip_low: Annotated[float, Range("(0, 1)")] = 0.2
    """How far ρ may fall below 1 before a sample with Â < 0 stops counting."""
    clip_high: Annotated[float, Range("(0, inf]")] = 0.28
    """How far ρ may rise above 1 before a sample with Â > 0 stops counting."""

    def loss(self, inputs: LossInputs) -> LossOutput:
        logs = at_level(inputs.log_prob_new - inputs.log_prob_old, inputs, self.level)
        rho, advantage = ratio(logs), advantage_column(inputs)
        low, high = 1.0 - self.clip_low, 1.0 + self.clip_high
        surrogate = (rho * advantage).minimum(rho.clamp(low, high) * advantage)
        dropped = ((advantage > 0.0) & (rho > high)) | ((advantage < 0.0) & (rho < low))
        return assemble(
            inputs,
            self,
            policy_loss=-mean_over_ratios(surrogate, inputs, self.level),
            log_ratio=logs,
            weight=(~dropped).to(logs.dtype),
            clip=(self.clip_low, self.clip_high),
        )
