# SPDX-License-Identifier: Apache-2.0
"""MetaWorld, stepped a chunk at a time and rendered once per decision.

The same physics, state, camera and instruction as LeRobot's own wrapper, but the image has the size a small
policy needs, lights are cheap to draw in software, and nothing is rendered that no policy looks at.
Importing this file loads neither MuJoCo nor metaworld.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass, field, replace
from importlib.resources import files
from importlib.util import find_spec
from typing import Annotated, Any, Literal

import numpy as np

from accerl_lerobot.config.ranges import Range, Section
from accerl_lerobot.envs.base import EnvConfig, SuiteConfig, SuiteEnvironment, unit_spec
from accerl_lerobot.envs.graphics import Renderers, diverged, draw_fast, import_mujoco


@functools.cache
def _tables() -> dict[str, Any]:
    """LeRobot's MetaWorld tables: a JSON file, as importing the module that reads it costs seconds."""
    file = files("lerobot") / "envs" / "metaworld_config.json"
    return json.loads(file.read_text())


@functools.cache
def groups() -> dict[str, tuple[str, ...]]:
    """LeRobot's difficulty groups, plus ``all`` 50 tasks."""
    named = {name: tuple(tasks) for name, tasks in _tables()["DIFFICULTY_TO_TASKS"].items()}
    return named | {"all": tuple(sorted(_tables()["TASK_DESCRIPTIONS"]))}


def description(task: str) -> str:
    """The instruction text of `task`, as LeRobot's own datasets have it."""
    return _tables()["TASK_DESCRIPTIONS"][task]


def expert_name(task: str) -> str:
    """Class name in ``metaworld.policies`` of the scripted expert for `task`."""
    return _tables()["TASK_POLICY_MAPPING"][task]


Metres = Annotated[float, Range("[-2, 2]")]


@dataclass(frozen=True, kw_only=True)
class ShiftConfig(Section, section="env.shift"):
    """Deployment shift of a MetaWorld scene; the defaults change nothing. Demonstrations are without it."""

    camera: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    """Metres added to the position of every camera, along its body's x, y and z."""


STATE_DIM = 4


@EnvConfig.register_subclass("metaworld")
@dataclass(frozen=True, kw_only=True)
class MetaWorldConfig(SuiteConfig):
    """Which MetaWorld tasks, seen how."""

    expert = "accerl_lerobot.demos.record:metaworld_expert"
    environment = "accerl_lerobot.envs.metaworld:MetaWorld"
    groups = staticmethod(groups)
    CAMERAS = ("topview", "corner", "corner2", "corner3", "behindGripper", "gripperPOV")

    task: str = "drawer-open-v3"
    """Task names separated by commas, or LeRobot's groups: easy, medium, hard, very_hard, all."""
    camera: str = "corner2"
    """Camera names separated by commas; each becomes ``observation.images.<name>``."""
    image_size: Annotated[int, Range("[64, 480]")] = 64
    """Height and width of every image in pixels."""
    max_steps: Annotated[int, Range("[1, 500]")] = 500
    """Episode limit in env steps; reaching it truncates."""
    rendering: Literal["stock", "fast"] = "fast"
    """``stock`` or ``fast`` (no shadows, reflections or multisampling: ten times faster in software)."""
    environment_state: bool = False
    """True if observations hold ``observation.environment_state``: MetaWorld's own 39 numbers, objects and
    goal included, and the share of `max_steps` gone. For ``algorithm.type=chunk_critic``; a policy that was
    trained without it never reads it."""
    shift: ShiftConfig = field(default_factory=ShiftConfig)

    def nominal(self) -> MetaWorldConfig:
        return replace(self, shift=ShiftConfig())


class MetaWorld(SuiteEnvironment):
    """One MetaWorld instance.

    An episode in which the simulator diverges, so that MuJoCo had to reset it, ends as truncated.
    """

    config: MetaWorldConfig

    def __init__(self, config: MetaWorldConfig) -> None:
        if find_spec("metaworld") is None:
            raise ModuleNotFoundError("No module named 'metaworld'", name="metaworld")
        images = [f"observation.images.{camera}" for camera in config.cameras]
        spec = unit_spec(config, images, description, state=STATE_DIM, environment_state=39, action=4, fps=80)
        super().__init__(config, spec)

    def _build(self, task: str) -> Simulator:
        return Simulator(task, self.config)


class Simulator:
    """One task in MuJoCo."""

    def __init__(self, task: str, config: MetaWorldConfig) -> None:
        import_mujoco()
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS

        env = ALL_V3_ENVIRONMENTS[task]()
        self.env = env
        # What `set_task` with a task of the MT1 benchmark does, without first sampling its 50 goals: the goal
        # is visible in the raw observation, and `seed` decides where things are.
        env._partially_observable = False
        del env.sawyer_observation_space  # a cached property that depends on the line above
        env._set_task_called = True
        env._freeze_rand_vec = False
        env.seeded_rand_vec = True
        env.model.cam("corner2").pos[:] = (0.75, 0.075, 0.7)  # as LeRobot's wrapper does
        if config.rendering == "fast":
            draw_fast(env.model)
        for camera in config.cameras:
            env.model.cam(camera).pos[:] += config.shift.camera
        env.touching_object = functools.partial(touching_object, env)
        self._renderers = Renderers(env.model)

    def reset(self, seed: int) -> None:
        """To the start that `seed` stands for."""
        self.env.seed(seed)
        self._raw, _ = self.env.reset()
        # MetaWorld moves the goal marker after its last forward pass, so that the first frame would show an
        # older goal. This places the markers and leaves the physics as it is.
        import_mujoco().mj_kinematics(self.env.model, self.env.data)

    def step(self, action: np.ndarray) -> tuple[bool, bool]:
        """One env step; True if it succeeded, and True if the simulator has not diverged."""
        self._raw, _, _, _, info = self.env.step(action)
        return bool(info["success"]), not diverged(self.env.data)

    def state(self) -> np.ndarray:
        """``observation.state``, float32 (4,)."""
        return self._raw[:STATE_DIM].astype(np.float32)

    def everything(self) -> np.ndarray:
        """MetaWorld's own 39 numbers, float64, objects and goal included."""
        return self._raw

    def render(self, camera: str, height: int, width: int) -> np.ndarray:
        """Frame of a camera, uint8 (height, width, 3)."""
        image = self._renderers.draw(height, width, self.env.data, camera)
        if camera == "corner2":  # hangs upside down in MetaWorld's scene; LeRobot and its datasets turn it
            return np.ascontiguousarray(image[::-1, ::-1])
        return image

    def close(self) -> None:
        self._renderers.close()
        self.env.close()


def touching_object(sim: Any, geom: int) -> bool:
    """MetaWorld's function of this name, which loops over all contacts, with arrays.

    The rewards of 14 tasks ask for it at every env step, where loops took a quarter of the simulation.
    """
    contact = sim.data.contact
    force = sim.data.efc_force
    of_object = (contact.geom == geom).any(1)
    for name in ("leftpad_geom", "rightpad_geom"):
        pad = sim.data.geom(name).id
        pressing = of_object & (contact.geom == pad).any(1)
        if not force[contact.efc_address[pressing]].sum() > 0:
            return False
    return True
