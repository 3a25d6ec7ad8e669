# SPDX-License-Identifier: Apache-2.0
"""The root of all environment configs: ``--env.type=metaworld`` picks one."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Self

import draccus

from accerl_lerobot.config.ranges import Range, Section


@dataclass(frozen=True, kw_only=True)
class EnvConfig(Section, draccus.ChoiceRegistry, section="env"):
    """Base of every environment config; subclasses register under the name given on the command line.

    Example:
        >>> draccus.decode(EnvConfig, {"type": "metaworld", "task": "door-open-v3"}).type
        'metaworld'
    """

    max_steps: Annotated[int, Range("[1, 1000000]")] = 500
    """Episode limit in env steps; reaching it truncates."""

    @property
    def type(self) -> str:
        """The registered name."""
        return self.get_choice_name(self.__class__)

    @property
    def state_size(self) -> int:
        """Numbers of ``observation.environment_state``; 0 where observations hold none."""
        return 0

    def shortened(self, max_steps: int) -> Self:
        """This config with its episode limit lowered to `max_steps`, if it is longer."""
        return dataclasses.replace(self, max_steps=min(self.max_steps, max_steps))

    def nominal(self) -> Self:
        """This config without deployment shift; an environment that has one overrides it."""
        return self
