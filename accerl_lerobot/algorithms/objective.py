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
"""What all objectives have in common: the critic, the KL penalty, the entropy bonus and the diagnostics.

L = L_policy + value_coef · mean (V − R)² + kl_coef · KL(μ‖π) − entropy_coef · H
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from accerl_lerobot.algorithms.contract import AlgorithmConfig, LossInputs, LossOutput
from accerl_lerobot.algorithms.diagnostics import explained_variance, ratio_metrics
from accerl_lerobot.algorithms.ratio import kl_from_behaviour, masked_mean

if TYPE_CHECKING:
    from torch import Tensor


def advantage_column(inputs: LossInputs) -> Tensor:
    """(N, 1), without gradient, 0 at padding: broadcasts against the (N, F) ratios, which share it."""
    advantage = inputs.advantage.detach()
    if inputs.mask is not None:
        advantage = advantage.masked_fill(~inputs.mask, 0.0)
    return advantage[:, None]


def assemble(
    inputs: LossInputs,
    config: AlgorithmConfig,
    *,
    policy_loss: Tensor,
    log_ratio: Tensor,
    weight: Tensor,
    clip: tuple[float, float],
) -> LossOutput:
    """Adds the shared terms to a policy loss and measures the batch.

    Args:
        inputs: the batch.
        config: the shared coefficients.
        policy_loss: (), with gradient.
        log_ratio: (N, F), with gradient, from `ratio.log_ratio`.
        weight: (N, F), how much of each sample's gradient the algorithm keeps, in [0, 1].
        clip: (low, high), the clip fraction counts ratios outside [1 − low, 1 + high].
    """
    mask = inputs.mask
    error = inputs.value - inputs.returns.detach()
    entropy = inputs.entropy
    if mask is not None:
        error, entropy = error.masked_fill(~mask, 0.0), entropy.masked_fill(~mask, 0.0)
    value_loss = masked_mean(error.square(), mask)
    kl = masked_mean(kl_from_behaviour(log_ratio), mask)
    mean_entropy = masked_mean(entropy, mask)

    loss = policy_loss + config.value_coef * value_loss
    if config.kl_coef:
        loss = loss + config.kl_coef * kl
    if config.entropy_coef:  # an entropy that is not used may be non-finite
        loss = loss - config.entropy_coef * mean_entropy

    decisions = mask.sum() if mask is not None else loss.new_tensor(float(len(inputs.value)))
    metrics = {
        "loss": loss,
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "kl": kl,
        "entropy": mean_entropy,
        "decisions": decisions.to(loss.dtype),
        "explained_variance": explained_variance(inputs.value.detach(), inputs.returns, mask),
        **ratio_metrics(log_ratio.detach(), weight.detach(), mask, clip=clip),
    }
    return LossOutput(loss=loss, metrics={k: v.detach() for k, v in metrics.items()})
