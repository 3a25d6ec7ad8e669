# SPDX-License-Identifier: Apache-2.0
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
