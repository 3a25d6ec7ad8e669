# SPDX-License-Identifier: Apache-2.0
"""Algorithms: objectives with a likelihood ratio, as their papers state them, and off-policy updates.

To add one, register a config under `AlgorithmConfig`: a `RatioConfig` with a `loss` that ends in
`objective.assemble`, as GIPO's does, or an `OffPolicyConfig` whose `update` names a subclass of
`off_policy.OffPolicyUpdate`. In this package, import it below; in a package of your own, name that by
``--algorithm.discover_packages_path``. No file that this package imports pulls in torch, so a run can be
parsed before torch is loaded.
"""

from __future__ import annotations

from accerl_lerobot.algorithms.config import (
    AlgorithmConfig,
    AWRConfig,
    ChunkCriticConfig,
    Level,
    LossInputs,
    OffPolicyConfig,
    SelfImitationConfig,
)
from accerl_lerobot.algorithms.objective import GIPOConfig, LossOutput, PPOConfig, RatioConfig

__all__ = [
    "AWRConfig", "AlgorithmConfig", "ChunkCriticConfig", "GIPOConfig", "Level", "LossInputs", "LossOutput",
    "OffPolicyConfig", "PPOConfig", "RatioConfig", "SelfImitationConfig",
]  # fmt: skip
