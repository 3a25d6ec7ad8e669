# SPDX-License-Identifier: Apache-2.0
"""A LeRobot reward model of a few weights: how bright the picture is, and how much brighter than before.

Saved and loaded as any other; the type is registered by importing this.
"""

from tests.world_model.tiny_reward.configuration_tiny_brightness import TinyBrightnessConfig

__all__ = ["TinyBrightnessConfig"]
