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
"""A LeRobot reward model of a few weights: how bright the picture is, and how much brighter than before.

Saved and loaded as any other; the type is registered by importing this.
"""

from tests.world_model.tiny_reward.configuration_tiny_brightness import TinyBrightnessConfig

__all__ = ["TinyBrightnessConfig"]
