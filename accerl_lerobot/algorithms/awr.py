# SPDX-License-Identifier: Apache-2.0
"""Advantage-weighted regression: fine-tuning on one's own samples, the better ones more (arXiv 1910.00177).

    w = min(exp(Â / beta), cap)
    L = −E[w · log π]  +  the shared terms of `objective`

The exact solution of one such regression is μ·exp(Â/β), normalised: the best policy within some KL of μ.
There is no ratio: a stale sample counts like a fresh one, and μ is whatever mix of versions replay holds. All
weights are positive, so no action is pushed away for being bad. ``beta`` infinite is behaviour cloning, SFT
on what the policy itself did.

At level ``chunk`` log π is the decision's; at the finer ones the same sum is divided by the number of
factors, as in losses with ratios.

Deviation: Â has mean 0 and standard deviation 1 over the batch, so β is in standard deviations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from accerl_lerobot.algorithms.contract import AlgorithmConfig, LossInputs, RatioConfig
from accerl_lerobot.algorithms.objective import LossOutput, advantage_column, assemble, mean_over_ratios
from accerl_lerobot.algorithms.ratio import at_level
from accerl_lerobot.config.ranges import Range


@AlgorithmConfig.register_subclass("awr")
@dataclass(frozen=True, kw_only=True)
class AWRConfig(RatioConfig):
    """Settings of advantage-weighted regression."""

    beta: Annotated[float, Range("(0, inf]")] = 1.0
    """Temperature in standard deviations of the advantage; ``inf`` weighs all samples alike."""
    cap: Annotated[float, Range("[1, inf)")] = 20.0
    """Largest weight of a sample; an average one has 1."""


def awr_loss(inputs: LossInputs, config: AWRConfig) -> LossOutput:
    """See the top of the file. E is the mean over all factors, actions or chunks of all decisions."""
    log_prob = at_level(inputs.log_prob_new, inputs, config.level)
    logs = at_level(inputs.log_prob_new - inputs.log_prob_old.detach(), inputs, config.level)
    # Limited before the exponential, which would overflow at Â/β = 89.
    weight = (advantage_column(inputs) / config.beta).clamp(max=math.log(config.cap)).exp()
    weight = weight.expand_as(log_prob)
    return assemble(
        inputs,
        config,
        policy_loss=-mean_over_ratios(weight * log_prob, inputs, config.level),
        log_ratio=logs,
        weight=weight,
        grad_weight=weight,
    )
