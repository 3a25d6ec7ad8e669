# SPDX-License-Identifier: Apache-2.0
"""Decoupled PPO: the clip measures how far one update moves, not how stale a sample is (Hilton et al., arXiv
2110.00641; AReaL, arXiv 2505.24298).

    r = π / π_prox            π_prox: the weights of at most `proximal_every` updates ago
    w = π_prox / μ            without gradient; 0 above `behaviour_cap`
    L = −E[w · min(r Â, clip(r, 1 − clip_low, 1 + clip_high) Â)]  +  the shared terms of `objective`

PPO's ratio does two things: it corrects for who acted, and its range keeps the step small. Under asynchrony
the first uses the range up. Here w corrects, and only r is clipped. w·r is π/μ, so a sample that is neither
clipped nor masked has the gradient of importance sampling, −(π/μ) Â ∇log π. At `proximal_every` 1 the weights
that are updated are their own proximal ones: r = 1, nothing is clipped, and the gradient is −E[w Â ∇log π].

Deviations:
    * for π_prox Hilton et al. use a moving average of weights, AReaL those before a batch's minibatches.
      Here an update is one minibatch, so π_prox is renewed every `proximal_every` updates;
    * both ratios are clamped, see `ratio.LOG_RATIO_CLAMP`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from accerl_lerobot.algorithms.contract import AlgorithmConfig, LossInputs, LossOutput
from accerl_lerobot.algorithms.objective import advantage_column, assemble, mean_over_ratios
from accerl_lerobot.algorithms.ppo import PPOConfig, clipped_surrogate
from accerl_lerobot.algorithms.ratio import at_level, ratio
from accerl_lerobot.config.ranges import Range


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
        """See the base class."""
        return self.proximal_every


def decoupled_loss(inputs: LossInputs, config: DecoupledConfig) -> LossOutput:
    """See the top of the file. E is the mean over all ratios of all decisions, masked ones counted as 0.

    Args:
        inputs: the batch, with `log_prob_proximal`.
        config: clip range, cap and coefficients.

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
        clip=(config.clip_low, config.clip_high),
        clipped=moved,
    )
