# SPDX-License-Identifier: Apache-2.0
"""PPO with a clip (Schulman et al., arXiv 1707.06347), asymmetric as in DAPO (arXiv 2503.14476, section 3.1).

    L = −E[min(ρ Â, clip(ρ, 1 − low, 1 + high) Â)]  +  the shared terms of `objective`

The ratio is taken against the behaviour policy, so under asynchrony the clip range is also the staleness
budget: at a large lag most samples are outside and their gradient is gone. That is what GIPO is for.

Decoupled PPO (Hilton et al., arXiv 2110.00641; AReaL, arXiv 2505.24298) clips how far one update moves, not
how stale a sample is:

    r = π / π_prox            π_prox: the weights of at most `proximal_every` updates ago
    w = π_prox / μ            without gradient; 0 above `behaviour_cap`
    L = −E[w · min(r Â, clip(r, 1 − clip_low, 1 + clip_high) Â)]  +  the shared terms

PPO's ratio corrects for the behaviour policy and its range keeps the step small; under asynchrony the first
uses the range up. Here w corrects, and only r is clipped. w·r is π/μ, so a sample that is neither clipped
nor masked has the gradient of importance sampling. At `proximal_every` 1 the weights that are updated are
their own proximal ones: r = 1, nothing is clipped, and the gradient is −E[w Â ∇log π]. For π_prox Hilton et
al. use a moving average of weights, AReaL those before a batch's minibatches; here an update is one
minibatch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from accerl_lerobot.algorithms.contract import AlgorithmConfig, LossInputs, RatioConfig
from accerl_lerobot.algorithms.objective import Clip, LossOutput, advantage_column, assemble, mean_over_ratios
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
    """The loss at the top of the file. E is the mean over all ratios of all decisions."""
    logs = at_level(inputs.log_prob_new - inputs.log_prob_old.detach(), inputs, config.level)
    surrogate, dropped = clipped_surrogate(ratio(logs), advantage_column(inputs), config)
    return assemble(
        inputs,
        config,
        policy_loss=-mean_over_ratios(surrogate, inputs, config.level),
        log_ratio=logs,
        weight=(~dropped).to(logs.dtype),
        clip=Clip(config.clip_low, config.clip_high),
    )


@AlgorithmConfig.register_subclass("decoupled")
@dataclass(frozen=True, kw_only=True)
class DecoupledConfig(PPOConfig):
    """Settings of decoupled PPO; the clip range is that of π/π_prox."""

    behaviour_cap: Annotated[float, Range("[1, inf]")] = 2.0
    """Samples whose w = π_prox/μ is above this are masked; ``inf`` masks none."""
    proximal_every: Annotated[int, Range("[1, 1000000]")] = 4
    """Updates for which proximal weights are kept. Above 1 the trainer holds a copy of the policy's
    weights and re-scores batches under it."""

    @property
    def proximal_updates(self) -> int:
        return self.proximal_every


def decoupled_loss(inputs: LossInputs, config: DecoupledConfig) -> LossOutput:
    """See the top of the file. E is the mean over all ratios of all decisions, masked ones counted as 0.

    Raises:
        ValueError: there are no proximal log-probs.
    """
    if inputs.log_prob_proximal is None:
        raise ValueError("decoupled PPO: log_prob_proximal is needed")
    proximal, old = inputs.log_prob_proximal.detach(), inputs.log_prob_old.detach()
    moved = at_level(inputs.log_prob_new - proximal, inputs, config.level)
    behaviour = ratio(at_level(proximal - old, inputs, config.level))
    behaviour = behaviour.masked_fill(behaviour > config.behaviour_cap, 0.0)
    surrogate, dropped = clipped_surrogate(ratio(moved), advantage_column(inputs), config)
    return assemble(
        inputs,
        config,
        policy_loss=-mean_over_ratios(behaviour * surrogate, inputs, config.level),
        log_ratio=at_level(inputs.log_prob_new - old, inputs, config.level),
        weight=(~dropped & (behaviour > 0.0)).to(moved.dtype),
        clip=Clip(config.clip_low, config.clip_high, moved),
    )
