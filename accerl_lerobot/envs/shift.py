# SPDX-License-Identifier: Apache-2.0
"""Differences between the world a policy was trained in and the one it must work in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from accerl_lerobot.config.ranges import Positive, Range, Section

if TYPE_CHECKING:
    from collections.abc import Sequence

Metres = Annotated[float, Range("[-2, 2]")]


@dataclass(frozen=True, kw_only=True)
class ShiftConfig(Section, section="env.shift"):
    """Deployment shift of a MetaWorld scene; the defaults change nothing.

    Scripted demonstrations are recorded without it, unless ``demos.shifted`` says otherwise.

    Example:
        >>> ShiftConfig(camera=(0.0, 0.05, 0.0), action_delay=2).action_delay
        2
    """

    camera: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    """Metres added to the position of every camera, along its body's x, y and z."""
    light: Positive = 1.0
    """Factor on the intensity of all lights."""
    friction: Positive = 1.0
    """Factor on the sliding friction of all surfaces."""
    action_delay: Annotated[int, Range("[0, 100]")] = 0
    """Env steps between an action and its execution; zero actions fill the gap at the start of an episode."""
    start_range: Positive = 1.0
    """Factor on the ranges that start and goal positions are drawn from, about their centres. Far above 1,
    some starts are out of reach."""

    def apply(self, simulator: Any, cameras: Sequence[str]) -> None:
        """Changes a MetaWorld simulator that has just been built.

        Args:
            simulator: MetaWorld's own environment object.
            cameras: names of those that are moved.
        """
        from gymnasium.spaces import Box

        model = simulator.model
        for name in cameras:
            model.cam(name).pos[:] += self.camera
        for kind in ("ambient", "diffuse", "specular"):
            getattr(model, f"light_{kind}")[:] *= self.light
            getattr(model.vis.headlight, kind)[:] *= self.light
        model.geom_friction[:, 0] *= self.friction
        if self.start_range != 1:
            space = simulator._random_reset_space
            centre, half = (space.high + space.low) / 2, (space.high - space.low) / 2
            low, high = centre - self.start_range * half, centre + self.start_range * half
            simulator._random_reset_space = Box(low, high, dtype=space.dtype)
