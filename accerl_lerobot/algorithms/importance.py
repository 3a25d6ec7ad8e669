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
"""Importance sampling without a clip, or truncated: the plain off-policy policy gradient, to compare with.

    ρ_c = min(ρ, cap)            cap None: ρ_c = ρ
    L = −E[ρ_c Â]  +  the shared terms of `objective`

The gradient is −E[ρ_c Â ∇log π]: a truncated sample keeps the weight `cap` (Ionides, *Truncated importance
sampling*, 2008; the weight of V-trace, arXiv 1802.01561). Differentiating min(ρ, cap) itself would leave such
samples no gradient at all, which is a clip.

Without a cap this is unbiased at level ``chunk``, and nothing but `ratio.LOG_RATIO_CLAMP` bounds what one
sample can do. It equals GIPO with an infinite σ.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from accerl_lerobot.algorithms.contract import AlgorithmConfig, LossInputs, LossOutput
from accerl_lerobot.algorithms.objective import advantage_column, assemble, mean_over_ratios
from accerl_lerobot.algorithms.ratio import at_level, ratio
from accerl_lerobot.errors import InputError


@AlgorithmConfig.register_subclass("is")
@dataclass(frozen=True, kw_only=True)
class ImportanceConfig(AlgorithmConfig):
    """Settings of importance sampling."""

    cap: float | None = None
    """Largest weight of a sample, ≥ 1; None: unbounded."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.cap is not None and not 1.0 <= self.cap < math.inf:
            raise InputError("algorithm.cap", self.cap, "use a finite number from 1 up, or null")


def importance_loss(inputs: LossInputs, config: ImportanceConfig) -> LossOutput:
    """See the top of the file. E is the mean over all ratios of all decisions.

    Args:
        inputs: the batch; `LossInputs` states the shapes.
        config: cap and coefficients.
    """
    logs = at_level(inputs.log_prob_new - inputs.log_prob_old.detach(), inputs, config.level)
    rho = ratio(logs)
    weighted = rho
    if config.cap is not None:
        # 1 + log ρ − log ρ̄ is 1 with the gradient ∇log π, also where `ratio` is clamped and has none.
        weighted = rho.detach().clamp(max=config.cap) * (1.0 + logs - logs.detach())
    return assemble(
        inputs,
        config,
        policy_loss=-mean_over_ratios(weighted * advantage_column(inputs), inputs, config.level),
        log_ratio=logs,
        weight=weighted / rho,
    )
