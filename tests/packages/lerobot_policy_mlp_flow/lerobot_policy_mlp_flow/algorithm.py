# SPDX-License-Identifier: Apache-2.0
"""CISPO (arXiv 2506.13585): the gradient of the log-prob, weighted by a clipped ratio without gradient.

L = −E[min(ρ̄, cap) · Â · log π]  +  the shared terms          ρ̄ = ρ without gradient
"""

from dataclasses import dataclass
from typing import Annotated

from accerl_lerobot.algorithms import AlgorithmConfig, LossInputs, LossOutput, RatioConfig
from accerl_lerobot.algorithms.objective import advantage_column, assemble, at_level, mean_over_ratios, ratio
from accerl_lerobot.config.ranges import Range


@AlgorithmConfig.register_subclass("cispo")
@dataclass(frozen=True, kw_only=True)
class CISPOConfig(RatioConfig):
    """Settings of CISPO."""

    cap: Annotated[float, Range("[1, inf]")] = 2.0
    """Largest weight."""

    def loss(self, inputs: LossInputs) -> LossOutput:
        log_prob = at_level(inputs.log_prob_new, inputs, self.level)
        log_ratio = at_level(inputs.log_prob_new - inputs.log_prob_old, inputs, self.level)
        rho = ratio(log_ratio.detach())
        capped = rho.clamp(max=self.cap)
        weighted = capped * advantage_column(inputs) * log_prob
        policy_loss = -mean_over_ratios(weighted, inputs, self.level)
        return assemble(inputs, self, policy_loss=policy_loss, log_ratio=log_ratio, weight=capped / rho)
