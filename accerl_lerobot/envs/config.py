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
"""The root of all environment configs: ``--env.type=metaworld`` picks one."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Self

import draccus


@dataclass(frozen=True, kw_only=True)
class EnvConfig(draccus.ChoiceRegistry):
    """Base of every environment config; subclasses register under the name given on the command line.

    Example:
        >>> draccus.decode(EnvConfig, {"type": "metaworld", "task": "door-open-v3"}).type
        'metaworld'
    """

    max_steps: int = 500
    """Episode limit in env steps; reaching it truncates."""

    @property
    def type(self) -> str:
        """The registered name."""
        return self.get_choice_name(self.__class__)

    def shortened(self, max_steps: int) -> Self:
        """This config with its episode limit lowered to `max_steps`, if it is longer."""
        return dataclasses.replace(self, max_steps=min(self.max_steps, max_steps))
