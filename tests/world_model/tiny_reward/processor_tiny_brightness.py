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
"""LeRobot's processors of it."""

from __future__ import annotations

from typing import Any

from lerobot.processor import DeviceProcessorStep, PolicyProcessorPipeline

from tests.world_model.tiny_reward.configuration_tiny_brightness import TinyBrightnessConfig


def make_tiny_brightness_pre_post_processors(
    config: TinyBrightnessConfig, dataset_stats: dict[str, Any] | None = None
) -> tuple[Any, Any]:
    """Found by LeRobot under this name."""
    return tuple(PolicyProcessorPipeline(steps=[DeviceProcessorStep(device="cpu")]) for _ in range(2))
