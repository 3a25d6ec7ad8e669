# SPDX-License-Identifier: Apache-2.0
"""LIBERO (Liu et al., 2023), stepped a chunk at a time and rendered once per decision.

Observations and actions are those of LeRobot's own environment: a policy that was trained on LeRobot's LIBERO
datasets acts here as it is. Importing this file loads neither MuJoCo nor LIBERO.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from accerl_lerobot.config.ranges import Range
from accerl_lerobot.envs.base import EnvConfig, SuiteConfig, SuiteEnvironment, unit_spec
from accerl_lerobot.envs.libero_simulator import FPS, NUMBERS, Simulator
from accerl_lerobot.envs.libero_tasks import instruction, suites

LEROBOT_NAMES = {"agentview": "image", "robot0_eye_in_hand": "image2"}
"""LeRobot's names of the two cameras that policies see."""
LIMITS = {"libero_spatial": 280, "libero_object": 280, "libero_goal": 300, "libero_10": 520, "libero_90": 400}
"""LeRobot's episode limits in env steps."""
LABELLED_FPS = (10,)
"""Datasets of LIBERO's demonstrations on the Hub say so, whose actions were executed at 20 Hz."""
STATE_DIM = 8
ACTION_DIM = 7


@EnvConfig.register_subclass("libero")
@dataclass(frozen=True, kw_only=True)
class LiberoConfig(SuiteConfig):
    """Which LIBERO tasks, seen how.

    Evaluation begins at the 50 recorded states of a task, demonstrations and exploration at placements drawn
    from the task's own regions, so that no evaluated start is trained on.
    """

    expert = "accerl_lerobot.demos.libero_expert:libero_expert"
    environment = "accerl_lerobot.envs.libero:LiberoEnvironment"
    groups = staticmethod(suites)
    STATE_NUMBERS = NUMBERS
    CAMERAS = (*LEROBOT_NAMES, "frontview", "birdview", "sideview", "galleryview", "robot0_robotview")

    task: str = "libero_object"
    """Suites (libero_spatial, libero_object, libero_goal, libero_10, libero_90), or single tasks such as
    libero_object/3 with LIBERO's numbers, separated by commas."""
    camera: str = "agentview,robot0_eye_in_hand"
    """Camera names separated by commas. These two become ``observation.images.image`` and ``.image2``, as in
    LeRobot, others ``observation.images.<name>``."""
    image_size: Annotated[int, Range("[32, 480]")] = 256
    """Height and width of every image in pixels."""
    max_steps: Annotated[int, Range("[0, 1000]")] = 0
    """Episode limit in env steps. 0: LeRobot's, which is 280 for libero_spatial and libero_object, 300 for
    libero_goal, 520 for libero_10, 400 for libero_90; of several suites the largest."""
    rendering: Literal["stock", "fast"] = "stock"
    """``stock`` (LeRobot's pixels) or ``fast`` (no shadows, reflections or multisampling, and coarser meshes:
    several times faster in software)."""
    assets: str = ""
    """Folder of LIBERO's meshes and textures; if empty, the installed package's or, where it has none, a copy
    of those on the Hub."""
    environment_state: bool = False
    """True if observations hold ``observation.environment_state``: joints and hand of the robot, positions
    of the objects that the task is about, distances between all these, and the share of `max_steps` gone. For
    ``algorithm.type=chunk_critic``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.max_steps:
            longest = max(LIMITS[task.split("/")[0]] for task in self.tasks)
            object.__setattr__(self, "max_steps", longest)


class LiberoEnvironment(SuiteEnvironment):
    """One LIBERO instance."""

    config: LiberoConfig

    def __init__(self, config: LiberoConfig) -> None:
        images = [f"observation.images.{LEROBOT_NAMES.get(camera, camera)}" for camera in config.cameras]
        spec = unit_spec(config, images, instruction, STATE_DIM, ACTION_DIM, FPS)
        super().__init__(config, replace(spec, labelled_fps=LABELLED_FPS))

    def _build(self, task: str) -> Simulator:
        return Simulator(task, self.config.rendering, self.config.assets)
