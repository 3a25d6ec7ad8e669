# SPDX-License-Identifier: Apache-2.0
"""Processors of ``smolvla_bins``: those of LeRobot's smolvla, whose backbone and tokeniser it has."""

from __future__ import annotations

from typing import Any

from lerobot.policies.smolvla.processor_smolvla import make_smolvla_pre_post_processors
from torch import Tensor

from lerobot_policy_smolvla_bins.configuration_smolvla_bins import SmolVLABinsConfig


def make_smolvla_bins_pre_post_processors(
    config: SmolVLABinsConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[Any, Any]:
    """Newline, tokeniser, normalisation; and back. LeRobot finds this by its name."""
    pipelines: tuple[Any, Any] = make_smolvla_pre_post_processors(config, dataset_stats)
    return pipelines
