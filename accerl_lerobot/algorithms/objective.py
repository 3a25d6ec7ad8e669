# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""What all objectives have in common: the critic, the KL penalties, the entropy bonus and the diagnostics.

L = L_policy + value_coef · mean value error + kl_coef · KL(μ‖π) + reference_coef · KL(π‖π_ref)
             − entropy_coef · H
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from accerl_lerobot.algorithms.contract import AlgorithmConfig, Level, LossInputs, LossOutput
from accerl_lerobot.algorithms.diagnostics import explained_variance, ratio_metrics
from accerl_lerobot.algorithms.ratio import (
    at_level,
    kl_from_behaviour,
    kl_to_reference,
    masked_mean,
    present_in,
)

if TYPE_CHECKING:
    from torch import Tensor

USUAL_CLIP = (0.2, 0.2)
"""What the clip fraction counts for an algorithm that clips nothing, so that runs can be compared."""


def advantage_column(inputs: LossInputs) -> Tensor:
    """(N, 1), without gradient, 0 at padding: broadcasts against the (N, F) ratios, which share it."""
    advantage = inputs.advantage.detach()
    if inputs.mask is not None:
        advantage = advantage.masked_fill(~inputs.mask, 0.0)
    return advantage[:, None]


def mean_over_ratios(x: Tensor, inputs: LossInputs, level: Level) -> Tensor:
    """Mean of (N, F) over all ratios that count, a scalar.

    Where decisions have different numbers of factors all factors weigh the same. Averaging over each
    decision's own first would weigh them by 1/F and bias the policy gradient towards decisions with few.
    """
    counts = present_in(inputs, level)
    if inputs.ratios_per_decision is None:
        return masked_mean(x, counts)
    total = (x if counts is None else x.masked_fill(~counts, 0.0)).sum()
    decisions = len(x) if inputs.mask is None else inputs.mask.sum().clamp(min=1)
    return total / (decisions * inputs.ratios_per_decision)


def assemble(
    inputs: LossInputs,
    config: AlgorithmConfig,
    *,
    policy_loss: Tensor,
    log_ratio: Tensor,
    weight: Tensor,
    clip: tuple[float, float] = USUAL_CLIP,
    clipped: Tensor | None = None,
    pull: Tensor | None = None,
) -> LossOutput:
    """Adds the shared terms to a policy loss and measures the batch.

    Args:
        inputs: the batch.
        config: the shared coefficients.
        policy_loss: (), with gradient.
        log_ratio: (N, F), log π/μ with gradient, from `ratio.at_level`.
        weight: (N, F), how much of each sample's gradient the algorithm keeps, ω.
        clip: (low, high), the clip fraction counts ratios outside [1 − low, 1 + high].
        clipped: (N, F), log of the ratios that are clipped; None: `log_ratio`.
        pull: (N, F), what stands before Â∇log π; None: ω·ρ.
    """
    mask = inputs.mask
    value_loss, mean_entropy = masked_mean(inputs.value_error, mask), masked_mean(inputs.entropy, mask)
    kl = mean_over_ratios(kl_from_behaviour(log_ratio), inputs, config.level)

    loss = policy_loss + config.value_coef * value_loss
    if config.kl_coef:
        loss = loss + config.kl_coef * kl
    if config.entropy_coef:  # an entropy that is not used may be non-finite
        loss = loss - config.entropy_coef * mean_entropy
    metrics = {"policy_loss": policy_loss, "value_loss": value_loss, "kl": kl, "entropy": mean_entropy}
    if config.reference_coef:
        metrics["kl_reference"] = _reference_kl(inputs, config, log_ratio)
        loss = loss + config.reference_coef * metrics["kl_reference"]

    decisions = mask.sum() if mask is not None else loss.new_tensor(float(len(inputs.value)))
    metrics |= {
        "loss": loss,
        "decisions": decisions.to(loss.dtype),
        "explained_variance": explained_variance(inputs.value.detach(), inputs.returns, mask),
    }
    metrics |= ratio_metrics(
        log_ratio.detach(),
        weight.detach(),
        present_in(inputs, config.level),
        clip=clip,
        clipped=None if clipped is None else clipped.detach(),
        pull=None if pull is None else pull.detach(),
    )
    return LossOutput(loss=loss, metrics={k: v.detach() for k, v in metrics.items()})


def _reference_kl(inputs: LossInputs, config: AlgorithmConfig, log_ratio: Tensor) -> Tensor:
    if inputs.log_prob_reference is None:
        raise ValueError("reference_coef is above 0: log_prob_reference is needed")
    apart = at_level(inputs.log_prob_new - inputs.log_prob_reference.detach(), inputs, config.level)
    return mean_over_ratios(kl_to_reference(log_ratio, apart), inputs, config.level)
