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
"""What it looks at, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.configs.rewards import RewardModelConfig


@RewardModelConfig.register_subclass("tiny_brightness")
@dataclass
class TinyBrightnessConfig(RewardModelConfig):
    """A film of `frames`, a chunk apart; with `scale` above 1 the answer is no probability."""

    frames: int = 1
    chunk: int = 2
    scale: float = 1.0

    @property
    def observation_delta_indices(self) -> list[int] | None:
        return None if self.frames == 1 else [self.chunk * i for i in range(self.frames)]
