# SPDX-License-Identifier: Apache-2.0
"""An algorithm of somebody else's package: REINFORCE with the critic as its baseline."""

from __future__ import annotations

from dataclasses import dataclass

from accerl_lerobot.algorithms import AlgorithmConfig, LossInputs, LossOutput, RatioConfig
from accerl_lerobot.config.ranges import NonNegative


@AlgorithmConfig.register_subclass("own_reinforce")
@dataclass(frozen=True, kw_only=True)
class OwnReinforceConfig(RatioConfig):
    """L = −scale · E[log π · Â]  +  the shared terms."""

    scale: NonNegative = 1.0
    """Weight of the objective."""

    def loss(self, inputs: LossInputs) -> LossOutput:
        from accerl_lerobot.algorithms.objective import (
            advantage_column,
            assemble,
            at_level,
            mean_over_ratios,
        )

        log_prob = at_level(inputs.log_prob_new, inputs, self.level)
        log_ratio = at_level(inputs.log_prob_new - inputs.log_prob_old, inputs, self.level).detach()
        policy_loss = -self.scale * mean_over_ratios(log_prob * advantage_column(inputs), inputs, self.level)
        weight = log_ratio.new_ones(log_ratio.shape)
        return assemble(inputs, self, policy_loss=policy_loss, log_ratio=log_ratio, weight=weight)
