# SPDX-License-Identifier: Apache-2.0
"""The objectives as the papers state them: typed tensors in, loss and diagnostics out.

To add one: write its config, a `RatioConfig` with a `loss`, and register it under `AlgorithmConfig`; in a
package of your own, which ``--algorithm.discover_packages_path`` names, it needs no change here. No file that
this package imports pulls in torch, so a run can be parsed before torch is loaded.
"""

from __future__ import annotations

from accerl_lerobot.algorithms.contract import (
    AlgorithmConfig,
    AWRConfig,
    ChunkCriticConfig,
    Level,
    LossInputs,
    OffPolicyConfig,
    RatioConfig,
    SelfImitationConfig,
)
from accerl_lerobot.algorithms.losses import GIPOConfig, PPOConfig
from accerl_lerobot.algorithms.objective import LossOutput

__all__ = [
    "AWRConfig",
    "AlgorithmConfig",
    "ChunkCriticConfig",
    "GIPOConfig",
    "Level",
    "LossInputs",
    "LossOutput",
    "OffPolicyConfig",
    "PPOConfig",
    "RatioConfig",
    "SelfImitationConfig",
]
