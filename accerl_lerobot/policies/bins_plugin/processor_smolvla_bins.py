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
"""Processors of ``smolvla_bins``: those of LeRobot's smolvla, whose backbone and tokeniser it has."""

from __future__ import annotations

from typing import Any

from lerobot.policies.smolvla.processor_smolvla import make_smolvla_pre_post_processors
from torch import Tensor

from accerl_lerobot.policies.bins_plugin.configuration_smolvla_bins import SmolVLABinsConfig


def make_smolvla_bins_pre_post_processors(
    config: SmolVLABinsConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[Any, Any]:
    """Newline, tokeniser, normalisation; and back. LeRobot finds this by its name."""
    pipelines: tuple[Any, Any] = make_smolvla_pre_post_processors(config, dataset_stats)
    return pipelines
