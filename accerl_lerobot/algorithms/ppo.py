# SPDX-License-Identifier: Apache-2.0
"""PPO with a clip (Schulman et al., arXiv 1707.06347), asymmetric as in DAPO (arXiv 2503.14476, section 3.1).

    L = −E[min(ρ Â, clip(ρ, 1 − low, 1 + high) Â)]  +  the shared terms of `objective`

The ratio is taken against the behaviour policy, so under asynchrony the clip range is also the staleness
budget: at a large lag most samples are outside and their gradient is gone. That is what GIPO is for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from accerl_lerobot.algorithms.contract import AlgorithmConfig, LossInputs, LossOutput, RatioConfig
from accerl_lerobot.algorithms.objective import advantage_column, assemble, mean_over_ratios
from accerl_lerobot.algorithms.ratio import at_level, ratio
from accerl_lerobot.config.ranges import Range

if TYPE_CHECKING:
    from torch import Tensor


@AlgorithmConfig.register_subclass("ppo")
@dataclass(frozen=True, kw_only=True)
class PPOConfig(RatioConfig):
    """Settings of PPO."""

    clip_low: Annotated[float, Range("(0, 1)")] = 0.2
    """How far ρ may fall below 1 before a sample with Â < 0 stops counting."""
    clip_high: Annotated[float, Range("(0, inf]")] = 0.28
    """How far ρ may rise above 1 before a sample with Â > 0 stops counting."""


def clipped_surrogate(rho: Tensor, advantage: Tensor, config: PPOConfig) -> tuple[Tensor, Tensor]:
    """min(ρ Â, clip(ρ) Â) and where the clip removed the gradient, both (N, F).

    Args:
        rho: (N, F).
        advantage: (N, 1).
        config: the clip range.
    """
    low, high = 1.0 - config.clip_low, 1.0 + config.clip_high
    dropped = ((advantage > 0.0) & (rho > high)) | ((advantage < 0.0) & (rho < low))
    return (rho * advantage).minimum(rho.clamp(low, high) * advantage), dropped


def ppo_loss(inputs: LossInputs, config: PPOConfig) -> LossOutput:
    """See the top of the file. E is the mean over all ratios of all decisions.

    Args:
        inputs: the batch; `LossInputs` states the shapes.
        config: clip range and coefficients.
    """
    logs = at_level(inputs.log_prob_new - inputs.log_prob_old.detach(), inputs, config.level)
    surrogate, dropped = clipped_surrogate(ratio(logs), advantage_column(inputs), config)
    return assemble(
        inputs,
        config,
        policy_loss=-mean_over_ratios(surrogate, inputs, config.level),
        log_ratio=logs,
        weight=(~dropped).to(logs.dtype),
        clip=(config.clip_low, config.clip_high),
    )
