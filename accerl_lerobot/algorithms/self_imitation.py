# SPDX-License-Identifier: Apache-2.0
"""Imitation of the policy's own successful episodes, as they come in: the settings.

Known as rejection fine-tuning or filtered behaviour cloning, here without rounds. It is the baseline that
every other algorithm has to beat at equal episodes. Related: Self-Imitation Learning, arXiv 1806.05635.
"""

from __future__ import annotations

from dataclasses import dataclass

from accerl_lerobot.algorithms.contract import AlgorithmConfig, OffPolicyConfig


@AlgorithmConfig.register_subclass("self_imitation")
@dataclass(frozen=True, kw_only=True)
class SelfImitationConfig(OffPolicyConfig):
    """Settings of self-imitation; it has no critic."""
