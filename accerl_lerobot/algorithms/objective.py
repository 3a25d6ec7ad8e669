# SPDX-License-Identifier: Apache-2.0
"""Terms that all objectives share: the critic, the KL penalties, the entropy bonus and the diagnostics.

L = L_policy + value_coef · mean value error + kl_coef · KL(μ‖π) + reference_coef · KL(π‖π_ref)
             − entropy_coef · H
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from accerl_lerobot.algorithms.contract import Level, LossInputs, RatioConfig
from accerl_lerobot.algorithms.diagnostics import Samples
from accerl_lerobot.algorithms.ratio import (
    at_level,
    kl_from_behaviour,
    kl_to_reference,
    masked_mean,
    present_in,
    ratio,
)

if TYPE_CHECKING:
    from torch import Tensor


class Clip(NamedTuple):
    """Range of the reported clip fraction, which counts ratios outside [1 − low, 1 + high].

    The default is for algorithms that clip nothing, so that runs can be compared.
    """

    low: float = 0.2
    high: float = 0.2
    log_ratio: Tensor | None = None
    """(N, F), log of the ratios that are clipped; None: log π/μ."""


USUAL_CLIP = Clip()


@dataclass(frozen=True, kw_only=True)
class LossOutput:
    """Loss and metrics of one batch."""

    loss: Tensor
    """(), call ``backward`` on it."""
    means: dict[str, Tensor]
    """Means over decisions, scalars without gradient. Those of micro-batches, weighted by their decisions,
    add up to that of the whole batch; ``decisions`` is a count."""
    samples: Samples
    """Per-decision values behind the metrics that are no means over decisions, without gradient."""

    @property
    def metrics(self) -> dict[str, Tensor]:
        """Scalars of this batch, still on the device; `diagnostics` explains each."""
        return self.means | self.samples.metrics()


def advantage_column(inputs: LossInputs) -> Tensor:
    """(N, 1), without gradient: broadcasts against the (N, F) ratios, which share it."""
    return inputs.advantage.detach()[:, None]


def mean_over_ratios(x: Tensor, inputs: LossInputs, level: Level) -> Tensor:
    """Mean of (N, F) over all ratios that count, a scalar.

    Where decisions have different numbers of factors all factors weigh the same. Averaging over each
    decision's own first would weigh them by 1/F and bias the policy gradient towards decisions with few.
    """
    counts = present_in(inputs, level)
    if inputs.ratios_per_decision is None:
        return masked_mean(x, counts)
    total = (x if counts is None else x.masked_fill(~counts, 0.0)).sum()
    return total / (len(x) * inputs.ratios_per_decision)


def assemble(
    inputs: LossInputs,
    config: RatioConfig,
    *,
    policy_loss: Tensor,
    log_ratio: Tensor,
    weight: Tensor,
    clip: Clip = USUAL_CLIP,
    grad_weight: Tensor | None = None,
) -> LossOutput:
    """Adds the shared terms to a policy loss and measures the batch.

    Args:
        inputs: the batch.
        config: the shared coefficients.
        policy_loss: (), with gradient.
        log_ratio: (N, F), log π/μ with gradient, from `ratio.at_level`.
        weight: (N, F), how much of each sample's gradient the algorithm keeps, ω.
        grad_weight: (N, F), factor of Â∇log π in the gradient; None: ω·ρ.
    """
    value_loss, mean_entropy = inputs.value_error.mean(), inputs.entropy.mean()
    kl = mean_over_ratios(kl_from_behaviour(log_ratio), inputs, config.level)

    loss = policy_loss + config.value_coef * value_loss
    if config.kl_coef:
        loss = loss + config.kl_coef * kl
    if config.entropy_coef:  # an entropy that is not used may be non-finite
        loss = loss - config.entropy_coef * mean_entropy
    means = {"policy_loss": policy_loss, "value_loss": value_loss, "kl": kl, "entropy": mean_entropy}
    if config.reference_coef:
        means["kl_reference"] = _reference_kl(inputs, config, log_ratio)
        loss = loss + config.reference_coef * means["kl_reference"]

    keep = present_in(inputs, config.level)
    means |= {"loss": loss, "decisions": loss.new_tensor(float(len(inputs.value)))}
    samples = Samples(
        log_ratio=log_ratio.detach(),
        weight=weight.detach(),
        grad_weight=(weight * ratio(log_ratio) if grad_weight is None else grad_weight).detach(),
        clipped=(log_ratio if clip.log_ratio is None else clip.log_ratio).detach(),
        keep=log_ratio.new_ones(log_ratio.shape).bool() if keep is None else keep,
        value=inputs.value.detach(),
        returns=inputs.returns.detach(),
        clip=(clip.low, clip.high),
    )
    return LossOutput(loss=loss, means={k: v.detach() for k, v in means.items()}, samples=samples)


def _reference_kl(inputs: LossInputs, config: RatioConfig, log_ratio: Tensor) -> Tensor:
    if inputs.log_prob_reference is None:
        raise ValueError("reference_coef is above 0: log_prob_reference is needed")
    apart = at_level(inputs.log_prob_new - inputs.log_prob_reference.detach(), inputs, config.level)
    return mean_over_ratios(kl_to_reference(log_ratio, apart), inputs, config.level)
