# SPDX-License-Identifier: Apache-2.0
"""The objectives of an update: GIPO, importance sampling, SAPO, AWR, PPO and decoupled PPO.

GIPO: a Gaussian trust weight on the log-ratio instead of a clip (arXiv 2603.03955, used by AcceRL,
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

SAPO, Soft Adaptive Policy Optimization: a sigmoid gate instead of a clip (arXiv 2511.20347).

    f(ρ) = (4/τ) · σ(τ (ρ − 1))            τ = tau_positive where Â > 0, tau_negative elsewhere
    L = −E[f(ρ) · Â]  +  the shared terms of `objective`

f′(ρ) = 4p(1 − p) with p = σ(τ (ρ − 1)), so the gradient is −E[4p(1 − p) · ρ Â ∇log π]: at ρ = 1 the plain
policy gradient, whatever τ, fading smoothly as ρ grows. Towards ρ = 0 the gate itself stays open (0.79 there
at τ = 1), so a sample fades only with ρ. A larger τ where Â ≤ 0 makes those samples fade sooner, because
pushing one token down pushes all others up.

Deviation: log ρ is clamped, see `ratio.LOG_RATIO_CLAMP`. The paper's ratio is per token: level ``token``.

Advantage-weighted regression: fine-tuning on one's own samples, the better ones more (arXiv 1910.00177).

    w = min(exp(Â / beta), cap)
    L = −E[w · log π]  +  the shared terms of `objective`

The exact solution of one such regression is μ·exp(Â/β), normalised: the best policy within some KL of μ.
There is no ratio: a stale sample counts like a fresh one, and μ is whatever mix of versions replay holds. All
weights are positive, so no action is pushed away for being bad. ``beta`` infinite is behaviour cloning, SFT
on what the policy itself did.

At level ``chunk`` log π is the decision's; at the finer ones the same sum is divided by the number of
factors, as in losses with ratios.

Deviation: Â has mean 0 and standard deviation 1 over the batch, so β is in standard deviations.

PPO with a clip (Schulman et al., arXiv 1707.06347), asymmetric as in DAPO (arXiv 2503.14476, section 3.1).

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

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from accerl_lerobot.algorithms.contract import AlgorithmConfig, LossInputs, RatioConfig
from accerl_lerobot.algorithms.objective import Clip, LossOutput, advantage_column, assemble, mean_over_ratios
from accerl_lerobot.algorithms.ratio import at_level, ratio
from accerl_lerobot.config.ranges import NonNegative, Positive, Range

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

    def loss(self, inputs: LossInputs) -> LossOutput:
        """See the top of the file. E is the mean over all ratios of all decisions."""
        advantage = advantage_column(inputs)
        logs = at_level(inputs.log_prob_new - inputs.log_prob_old.detach(), inputs, self.level)
        weight = trust_weight(logs, advantage, self)
        policy_loss = -mean_over_ratios(weight * ratio(logs) * advantage, inputs, self.level)
        return assemble(inputs, self, policy_loss=policy_loss, log_ratio=logs, weight=weight)


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


@AlgorithmConfig.register_subclass("is")
@dataclass(frozen=True, kw_only=True)
class ImportanceConfig(RatioConfig):
    """Settings of importance sampling."""

    cap: Annotated[float, Range("[1, inf)")] | None = None
    """Largest weight of a sample; None: unbounded."""

    def loss(self, inputs: LossInputs) -> LossOutput:
        """See the top of the file. E is the mean over all ratios of all decisions."""
        logs = at_level(inputs.log_prob_new - inputs.log_prob_old.detach(), inputs, self.level)
        rho = ratio(logs)
        weighted = rho
        if self.cap is not None:
            # 1 + log ρ − log ρ̄ is 1 with the gradient ∇log π, also where `ratio` is clamped and has none.
            weighted = rho.detach().clamp(max=self.cap) * (1.0 + logs - logs.detach())
        return assemble(
            inputs,
            self,
            policy_loss=-mean_over_ratios(weighted * advantage_column(inputs), inputs, self.level),
            log_ratio=logs,
            weight=weighted / rho,
        )


@AlgorithmConfig.register_subclass("sapo")
@dataclass(frozen=True, kw_only=True)
class SAPOConfig(RatioConfig):
    """Settings of SAPO; the defaults are the paper's."""

    tau_positive: Positive = 1.0
    """Temperature where Â > 0: the larger, the sooner a sample fades as ρ leaves 1."""
    tau_negative: Positive = 1.05
    """Temperature where Â ≤ 0."""

    def loss(self, inputs: LossInputs) -> LossOutput:
        """See the top of the file. E is the mean over all ratios of all decisions."""
        advantage = advantage_column(inputs)
        logs = at_level(inputs.log_prob_new - inputs.log_prob_old.detach(), inputs, self.level)
        tau = advantage.new_full(advantage.shape, self.tau_negative)
        tau = tau.masked_fill(advantage > 0.0, self.tau_positive)
        gate = (tau * (ratio(logs) - 1.0)).sigmoid()
        return assemble(
            inputs,
            self,
            policy_loss=-mean_over_ratios(4.0 / tau * gate * advantage, inputs, self.level),
            log_ratio=logs,
            weight=4.0 * gate * (1.0 - gate),
        )


@AlgorithmConfig.register_subclass("awr")
@dataclass(frozen=True, kw_only=True)
class AWRConfig(RatioConfig):
    """Settings of advantage-weighted regression."""

    beta: Annotated[float, Range("(0, inf]")] = 1.0
    """Temperature in standard deviations of the advantage; ``inf`` weighs all samples alike."""
    cap: Annotated[float, Range("[1, inf)")] = 20.0
    """Largest weight of a sample; an average one has 1."""

    def loss(self, inputs: LossInputs) -> LossOutput:
        """See the top of the file. E is the mean over all factors, actions or chunks of all decisions."""
        log_prob = at_level(inputs.log_prob_new, inputs, self.level)
        logs = at_level(inputs.log_prob_new - inputs.log_prob_old.detach(), inputs, self.level)
        # Limited before the exponential, which would overflow at Â/β = 89.
        weight = (advantage_column(inputs) / self.beta).clamp(max=math.log(self.cap)).exp()
        weight = weight.expand_as(log_prob)
        return assemble(
            inputs,
            self,
            policy_loss=-mean_over_ratios(weight * log_prob, inputs, self.level),
            log_ratio=logs,
            weight=weight,
            grad_weight=weight,
        )


@AlgorithmConfig.register_subclass("ppo")
@dataclass(frozen=True, kw_only=True)
class PPOConfig(RatioConfig):
    """Settings of PPO."""

    clip_low: Annotated[float, Range("(0, 1)")] = 0.2
    """How far ρ may fall below 1 before a sample with Â < 0 stops counting."""
    clip_high: Annotated[float, Range("(0, inf]")] = 0.28
    """How far ρ may rise above 1 before a sample with Â > 0 stops counting."""

    def loss(self, inputs: LossInputs) -> LossOutput:
        """The loss at the top of the file. E is the mean over all ratios of all decisions."""
        logs = at_level(inputs.log_prob_new - inputs.log_prob_old.detach(), inputs, self.level)
        surrogate, dropped = clipped_surrogate(ratio(logs), advantage_column(inputs), self)
        return assemble(
            inputs,
            self,
            policy_loss=-mean_over_ratios(surrogate, inputs, self.level),
            log_ratio=logs,
            weight=(~dropped).to(logs.dtype),
            clip=Clip(self.clip_low, self.clip_high),
        )


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

    def loss(self, inputs: LossInputs) -> LossOutput:
        """See the top of the file. E is the mean over all ratios of all decisions, masked ones counted as 0.

        Raises:
            ValueError: there are no proximal log-probs.
        """
        if inputs.log_prob_proximal is None:
            raise ValueError("decoupled PPO: log_prob_proximal is needed")
        proximal, old = inputs.log_prob_proximal.detach(), inputs.log_prob_old.detach()
        moved = at_level(inputs.log_prob_new - proximal, inputs, self.level)
        behaviour = ratio(at_level(proximal - old, inputs, self.level))
        behaviour = behaviour.masked_fill(behaviour > self.behaviour_cap, 0.0)
        surrogate, dropped = clipped_surrogate(ratio(moved), advantage_column(inputs), self)
        return assemble(
            inputs,
            self,
            policy_loss=-mean_over_ratios(behaviour * surrogate, inputs, self.level),
            log_ratio=at_level(inputs.log_prob_new - old, inputs, self.level),
            weight=(~dropped & (behaviour > 0.0)).to(moved.dtype),
            clip=Clip(self.clip_low, self.clip_high, moved),
        )
