# SPDX-License-Identifier: Apache-2.0
"""SAPO, Soft Adaptive Policy Optimization: a sigmoid gate instead of a clip (arXiv 2511.20347).

    f(ρ) = (4/τ) · σ(τ (ρ − 1))            τ = tau_positive where Â > 0, tau_negative elsewhere
    L = −E[f(ρ) · Â]  +  the shared terms of `objective`

f′(ρ) = 4p(1 − p) with p = σ(τ (ρ − 1)), so the gradient is −E[4p(1 − p) · ρ Â ∇log π]: at ρ = 1 the plain
policy gradient, whatever τ, fading smoothly as ρ grows. Towards ρ = 0 the gate itself stays open (0.79 there
at τ = 1), so a sample fades only with ρ. A larger τ where Â ≤ 0 makes those samples fade sooner, because
pushing one token down pushes all others up.

Deviation: log ρ is clamped, see `ratio.LOG_RATIO_CLAMP`. The paper's ratio is per token: level ``token``.
"""

from __future__ import annotations

from dataclasses import dataclass

from accerl_lerobot.algorithms.contract import AlgorithmConfig, LossInputs, RatioConfig
from accerl_lerobot.algorithms.objective import LossOutput, advantage_column, assemble, mean_over_ratios
from accerl_lerobot.algorithms.ratio import at_level, ratio
from accerl_lerobot.config.ranges import Positive


@AlgorithmConfig.register_subclass("sapo")
@dataclass(frozen=True, kw_only=True)
class SAPOConfig(RatioConfig):
    """Settings of SAPO; the defaults are the paper's."""

    tau_positive: Positive = 1.0
    """Temperature where Â > 0: the larger, the sooner a sample fades as ρ leaves 1."""
    tau_negative: Positive = 1.05
    """Temperature where Â ≤ 0."""


def sapo_loss(inputs: LossInputs, config: SAPOConfig) -> LossOutput:
    """See the top of the file. E is the mean over all ratios of all decisions."""
    advantage = advantage_column(inputs)
    logs = at_level(inputs.log_prob_new - inputs.log_prob_old.detach(), inputs, config.level)
    tau = advantage.new_full(advantage.shape, config.tau_negative)
    tau = tau.masked_fill(advantage > 0.0, config.tau_positive)
    gate = (tau * (ratio(logs) - 1.0)).sigmoid()
    return assemble(
        inputs,
        config,
        policy_loss=-mean_over_ratios(4.0 / tau * gate * advantage, inputs, config.level),
        log_ratio=logs,
        weight=4.0 * gate * (1.0 - gate),
    )
