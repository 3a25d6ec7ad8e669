# SPDX-License-Identifier: Apache-2.0
"""One LIBERO task in MuJoCo: LIBERO builds the scene and judges success, the loop between is ours.

robosuite computes in each simulation step three times what is needed once, and reads sensors that nobody
looks at. Here it is done once, with the same numbers. Importing this file loads neither MuJoCo nor LIBERO.
"""

from __future__ import annotations

import contextlib
import functools
import io
import re
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, NamedTuple
from unittest.mock import patch

import numpy as np

from accerl_lerobot.envs.base import SuiteEnvironment, unit_spec
from accerl_lerobot.envs.graphics import Renderers, diverged, draw_fast, import_mujoco
from accerl_lerobot.envs.libero import (
    FETCH,
    LEROBOT_NAMES,
    LiberoConfig,
    bddl_file,
    instruction,
    load_libero,
    recorded_states,
)  # fmt: skip
from accerl_lerobot.errors import InputError, in_one_line
from accerl_lerobot.seeds import EVAL_SEEDS

FPS = 20
MAX_OBJECTS = 4  # most objects that a task names as the objects of interest
STATE_NUMBERS = 25 + MAX_OBJECTS * 4 + 6 * 10  # of robot, objects, and vectors between them
SETTLING = 10  # env steps without motion before the first observation, as in LeRobot's own environment
MAX_FACES = 2000
ARENA = "64M"  # memory of a simulation's contacts and constraints; some 6 MB are used
SUBSTEPS = 25  # simulation steps of 2 ms in an env step
SENSOR_STEP = 23  # the simulation step in which robosuite's sensors read, once in each env step
NEAR = 0.03  # scale in m of the squashed vectors that a critic sees
STILL = np.array([0, 0, 0, 0, 0, 0, -1], np.float32)
_alone = threading.RLock()
"""Held where LIBERO uses what a process has one of: LeRobot plays tasks in threads."""


class LiberoEnvironment(SuiteEnvironment):
    """One LIBERO instance.

    Observations and actions are those of LeRobot's own environment: a policy that was trained on LeRobot's
    LIBERO datasets acts here as it is.
    """

    config: LiberoConfig

    def __init__(self, config: LiberoConfig) -> None:
        images = [f"observation.images.{LEROBOT_NAMES.get(camera, camera)}" for camera in config.cameras]
        spec = unit_spec(
            config, images, instruction, state=8, environment_state=STATE_NUMBERS, action=7, fps=FPS
        )
        # Datasets of LIBERO's demonstrations on the Hub say 10 Hz, whose actions were executed at 20 Hz.
        super().__init__(config, replace(spec, labelled_fps=(10,)))

    def _build(self, task: str) -> Simulator:
        return Simulator(task, self.config.rendering, self.config.assets)


class Arm(NamedTuple):
    """State that the controller reads, as views of MuJoCo's arrays."""

    jacobian: np.ndarray  # (2, 3, V): of the hand's position and rotation
    mass: np.ndarray  # (V, V)
    bias: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    position: np.ndarray
    rotation: np.ndarray  # (3, 3) of the hand


class Aim(NamedTuple):
    """Where the hand is to go, and how."""

    position: np.ndarray
    rotation: np.ndarray
    rest: np.ndarray  # (7,) joint positions that are kept where the hand leaves a choice
    gains: np.ndarray  # (2, 6): stiffness and damping


class Simulator:
    """One task: LIBERO's scene, with robosuite's operational space controller in a loop of our own.

    What a policy sees is one simulation step old, as in robosuite, whose sensors read within a step.
    """

    def __init__(self, task: str, rendering: Literal["stock", "fast"], assets: str) -> None:
        self._mujoco = import_mujoco()
        self.env, self._bodies = _build(task, assets)
        model = self.env.sim.model._model
        data = self.env.sim.data._data
        self.model = model
        self.data = data
        self._recorded = recorded_states(task).reshape(-1, 1 + model.nq + model.nv)
        if rendering == "fast":
            _make_cheap(model)
        robot = self.env.robots[0]
        self._robot = robot
        self._fingers = robot._ref_gripper_joint_pos_indexes
        self._motors = np.array(robot._ref_joint_actuator_indexes)
        self._grip_motors = np.array(robot._ref_joint_gripper_actuator_indexes)
        low, high = model.actuator_ctrlrange[self._grip_motors].T
        self._grip_centre = 0.5 * (high + low)
        self._grip_half = 0.5 * (high - low)
        self._site = robot.eef_site_id
        self._hand = model.body(robot.robot_model.eef_name).id
        self._mass = np.zeros((model.nv, model.nv))
        self._jacobian = np.zeros((2, 3, model.nv))
        self._renderers = Renderers(model)
        self._visible = self._mujoco.MjvOption()
        self._visible.geomgroup[:2] = 0, 1  # visual meshes, not what collides
        self._position = data.site_xpos[self._site]
        self._rotation = data.site_xmat[self._site].reshape(3, 3)
        self._arm = Arm(
            self._jacobian, self._mass, data.qfrc_bias, data.qpos, data.qvel, self._position, self._rotation
        )  # fmt: skip
        # What is looked at: the data of the last reading of the sensors, without its velocities.
        self._seen = self._mujoco.MjData(model)

    def reset(self, seed: int) -> None:
        """To the start that `seed` stands for, at rest."""
        # An episode moves fixtures a little, and objects that begin on one are placed where it stood before.
        self.model.body_pos[:], self.model.body_quat[:] = self._bodies
        _placed(self.env.reset, seed)
        env = self.env
        if seed in EVAL_SEEDS:
            row = self._recorded[(seed - EVAL_SEEDS.start) % len(self._recorded)]
            env.sim.set_state_from_flattened(row)
            env.sim.forward()
        env._check_success()
        env._post_process()
        self._robot.gripper.current_action = np.zeros(1)
        self._fresh = True
        for _ in range(SETTLING):
            self.step(STILL)

    def step(self, action: np.ndarray) -> tuple[bool, bool]:
        """One env step with an action, float32 (7,) in [−1, 1]; True if the goal holds after it, and True if
        all numbers are finite."""
        model = self.model
        data = self.data
        mujoco = self._mujoco
        self._closing = np.array([-0.01, 0.01]) * np.sign(action[6])
        for i in range(SUBSTEPS):
            mujoco.mj_step1(model, data)
            # robosuite solves twice for the former torques before it has new ones; the solver starts there.
            mujoco.mj_fwdActuation(model, data)
            mujoco.mj_fwdAcceleration(model, data)
            mujoco.mj_fwdConstraint(model, data)
            mujoco.mj_fwdConstraint(model, data)
            if self._fresh:
                self._begin(action)
            else:
                self._control(action, i == 0)
            if i == SENSOR_STEP:
                self._seen.qpos[:] = data.qpos
            mujoco.mj_step2(model, data)
            if i == SENSOR_STEP:
                self._fingers_seen = data.qpos[self._fingers]
        success = bool(self.env._check_success())
        self.env._post_process()
        return success, not diverged(data)

    def _begin(self, action: np.ndarray) -> None:
        """The first simulation step is robosuite's own: its controller has the pose before the start."""
        robot = self._robot
        robot.control(action, policy_step=True)
        controller = robot.controller
        self._limits = controller.actuator_min, controller.actuator_max
        self._aim = Aim(
            position=np.array(controller.goal_pos),
            rotation=np.array(controller.goal_ori),
            rest=controller.initial_joint,
            gains=np.stack([controller.kp, controller.kd]),
        )
        self._grip = robot.gripper.current_action
        self._fresh = False

    def _control(self, action: np.ndarray, decided: bool) -> None:
        if decided:
            self._aim = self._new_aim(action)
        self._mujoco.mj_jacSite(self.model, self.data, *self._jacobian, self._site)
        self._mujoco.mj_fullM(self.model, self._mass, self.data.qM)
        torques = _compiled_torques()(self._arm, self._aim)
        self.data.ctrl[self._motors] = np.clip(torques, *self._limits)
        self._grip = np.clip(self._grip + self._closing, -1.0, 1.0)
        self.data.ctrl[self._grip_motors] = self._grip_centre + self._grip_half * self._grip

    def state(self) -> np.ndarray:
        """LeRobot's ``observation.state``, float32 (8,): hand's position and axis-angle, both fingers."""
        self._look()
        w, x, y, z = self._seen.xquat[self._hand].astype(np.float32)
        w = np.clip(w, -1, 1)
        sine = np.sqrt(np.maximum(1 - w * w, 0))
        axis = np.zeros(3, np.float32)
        if sine > 1e-10:
            axis = np.array([x, y, z]) / sine
        turn = axis * (2 * np.arccos(w))
        parts = (self._seen.site_xpos[self._site], turn, self._fingers_seen)
        return np.concatenate(parts).astype(np.float32)

    def everything(self) -> np.ndarray:
        """Robot and objects of interest as they are now, float64 (101,).

        An object has its position and its joint's; what there is not lies in the hand. Then come the vectors
        between all these, and again squashed. No turns: a bowl looks the same from all sides.
        """
        data = self.data
        robot = self._robot
        joints = data.qpos[robot._ref_joint_pos_indexes]
        speeds = data.qvel[robot._ref_joint_vel_indexes]
        finger_speeds = data.qvel[robot._ref_gripper_joint_vel_indexes]
        arm = (joints, speeds, self._position, data.xquat[self._hand])
        fingers = (data.qpos[self._fingers], finger_speeds)
        points = np.tile(self._position, (1 + MAX_OBJECTS, 1))
        openings = np.zeros(MAX_OBJECTS)
        for i, name in enumerate(self.env.obj_of_interest):
            points[1 + i] = self.position(name)
            openings[i] = self.opening(name)
        first, second = np.triu_indices(len(points), 1)
        vectors = (points[second] - points[first]).ravel()
        near = np.tanh(vectors / NEAR)
        return np.concatenate([*arm, *fingers, points[1:].ravel(), openings, vectors, near])

    def pose(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) and quaternion (4,), w first, of an object, a fixture or a region in the
        environment."""
        if name in self.env.obj_body_id:
            body = self.env.obj_body_id[name]
            return self.data.xpos[body].copy(), self.data.xquat[body].copy()
        site = self.model.site(name).id
        quaternion = np.zeros(4)
        self._mujoco.mju_mat2Quat(quaternion, self.data.site_xmat[site])
        return self.data.site_xpos[site].copy(), quaternion

    def position(self, name: str) -> np.ndarray:
        """Position (3,) of an object, a fixture or a region in the environment."""
        return self.pose(name)[0]

    @property
    def hand(self) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) in m and rotation (3, 3) of the point between the fingertips, as they are now."""
        return self._position.copy(), self._rotation.copy()

    def opening(self, name: str) -> float:
        """Position of the joint of a door or knob, sum of a cabinet's drawers; 0 for what has none."""
        # A region of the table has None for its joints.
        names = getattr(self.env.get_object(name), "joints", None) or ()
        hinges = [joint for joint in names if self.model.joint(joint).type[0] != 0]
        return float(sum(self.data.joint(joint).qpos[0] for joint in hinges))

    def render(self, camera: str, height: int, width: int) -> np.ndarray:
        """Frame of a camera, uint8 (height, width, 3), turned as LeRobot's datasets have it."""
        self._look()
        image = self._renderers.draw(height, width, self._seen, camera, self._visible)
        return np.ascontiguousarray(image[:, ::-1])

    def close(self) -> None:
        self._renderers.close()
        self.env.close()

    def _look(self) -> None:
        """Brings what is derived from the positions seen up to date."""
        mujoco = self._mujoco
        mujoco.mj_kinematics(self.model, self._seen)
        mujoco.mj_comPos(self.model, self._seen)
        mujoco.mj_camlight(self.model, self._seen)

    def _new_aim(self, action: np.ndarray) -> Aim:
        """The pose that an action leads to from the hand's own; without a turn, the former rotation."""
        from robosuite.utils.control_utils import set_goal_orientation

        delta = self._robot.controller.scale_action(action[:6])
        turn = delta[3:]
        rotation = self._aim.rotation
        if turn.any():
            rotation = set_goal_orientation(turn, self._rotation)
        return self._aim._replace(position=self._position + delta[:3], rotation=rotation)


@functools.cache
def _compiled_torques() -> Any:
    """`operational_space_torques`, compiled with numba, which comes with robosuite."""
    import numba

    return numba.njit(cache=True)(operational_space_torques)


def operational_space_torques(arm: Arm, aim: Aim) -> np.ndarray:
    """Torques (7,) in Nm of operational space control (Khatib, 1987) with the settings of robosuite's
    OSC_POSE.

    Position and rotation are uncoupled; what freedom is left to the joints goes to the pose of rest.
    """
    n = len(aim.rest)  # joints of the arm, which come first
    mass = np.ascontiguousarray(arm.mass[:n, :n])
    joined = np.ascontiguousarray(arm.jacobian.reshape(6, arm.jacobian.shape[2])[:, :n])
    qpos = arm.qpos[:n]
    qvel = arm.qvel[:n]
    velocity = np.dot(joined, qvel)
    error = np.zeros(6)
    error[:3] = aim.position - arm.position
    for k in range(3):
        error[3:] += 0.5 * np.cross(arm.rotation[:, k], aim.rotation[:, k])
    stiffness = aim.gains[0]
    damping = aim.gains[1]
    wanted = stiffness * error - damping * velocity
    weighed = np.linalg.solve(mass, joined.T)
    inertia = np.dot(joined, weighed)  # inverse of the hand's
    free = 10.0 * (aim.rest - qpos) - 2 * np.sqrt(10.0) * qvel
    wrench = -np.linalg.solve(inertia, np.dot(joined, free))
    wrench[:3] += np.linalg.solve(np.ascontiguousarray(inertia[:3, :3]), wanted[:3])
    wrench[3:] += np.linalg.solve(np.ascontiguousarray(inertia[3:, 3:]), wanted[3:])
    return np.dot(joined.T, wrench) + np.dot(mass, free) + arm.bias[:n]


def _placed[Result](make: Callable[[], Result], seed: int) -> Result:
    """Result of LIBERO's code that places objects, which draws from NumPy's global generator; silent."""
    from robosuite.utils.errors import RandomizationError

    with _alone, contextlib.redirect_stdout(io.StringIO()):
        state = np.random.get_state()
        np.random.seed(seed)
        try:
            while True:
                with contextlib.suppress(RandomizationError):  # the objects did not fit: it draws again
                    return make()
        finally:
            np.random.set_state(state)


def liberos_own(task: str) -> Any:
    """LIBERO's own environment of a task, without cameras and without an end; `load_libero` comes first."""
    from libero.libero.envs.env_wrapper import ControlEnv

    file = str(bddl_file(task))
    return ControlEnv(file, use_camera_obs=False, has_offscreen_renderer=False, ignore_done=True)


def _build(task: str, assets: str) -> tuple[Any, list[np.ndarray]]:
    """robosuite's environment of a task, which draws nothing, and its bodies' positions and quaternions."""
    with _alone:
        load_libero(assets)
    from robosuite.utils.binding_utils import MjSim

    bodies: list[np.ndarray] = []

    def smaller(xml: str) -> Any:
        """Space for 5,000 contacts is 1.3 GB of addresses for each simulation: no process could be forked."""
        simulation = compiled(re.sub(r"<size [^>]*>", f'<size memory="{ARENA}"/>', xml))
        bodies[:] = simulation.model.body_pos.copy(), simulation.model.body_quat.copy()
        return simulation

    with _alone:
        compiled = MjSim.from_xml_string
        try:
            with patch.object(MjSim, "from_xml_string", smaller):
                env = _placed(lambda: liberos_own(task).env, 0)
        except (OSError, ValueError) as error:
            why = f"the scene of {task} does not load ({in_one_line(error)})"
            raise InputError("env.assets", assets, f"{why}; if the folder is incomplete, {FETCH}") from error
    env.hard_reset = False  # the scene is always the same: no need to compile it anew for each episode
    return env, bodies


def _make_cheap(model: Any) -> None:
    """No shadows, multisampling or reflections, and at most `MAX_FACES` faces of each mesh.

    What collides is not touched: that are hulls of vertices, which all stay.
    """
    draw_fast(model)
    for mesh in range(model.nmesh):
        at = model.mesh_faceadr[mesh]
        count = model.mesh_facenum[mesh]
        if count <= MAX_FACES:
            continue
        rows = slice(at, at + count)
        faces = model.mesh_face[rows]
        first = model.mesh_vertadr[mesh]
        vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        kept, merged = _coarser_once(vertices.tobytes(), faces.tobytes())
        corners = model.mesh_facetexcoord[rows][kept] + model.mesh_texcoordadr[mesh]
        if model.mesh_texcoordnum[mesh] == 3 * count:  # each corner has its own place in the texture
            places = model.mesh_texcoord[corners]
            model.mesh_texcoord[corners] = moved_texture(vertices[faces[kept]], vertices[merged], places)
        left = slice(at, at + len(kept))
        for array in (model.mesh_facenormal, model.mesh_facetexcoord):
            array[left] = array[rows][kept]
        model.mesh_face[left] = merged
        model.mesh_facenum[mesh] = len(kept)


@functools.cache
def _coarser_once(vertices: bytes, faces: bytes) -> tuple[np.ndarray, np.ndarray]:
    """`coarser` of a mesh, computed once in a process: the robot and most objects are in many scenes."""
    points = np.frombuffer(vertices, np.float32).reshape(-1, 3)
    corners = np.frombuffer(faces, np.int32).reshape(-1, 3)
    return coarser(points, corners)


def coarser(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fewer faces for a mesh, between vertices that it has (vertex clustering, Rossignac and Borrel, 1993).

    Vertices (V, 3) in the same cell of a grid become the one that is nearest to their mean; faces, int (F,
    3), that this leaves without an area go. The grid is the finest of some that leaves at most
    `MAX_FACES`. Gives which faces stay, int (f,), and their vertices now, int (f, 3).
    """
    extent = float(np.ptp(vertices, axis=0).max())
    for cells in (96, 64, 48, 36, 27, 20, 15, 11, 8, 6):
        side = extent / cells
        grid = np.floor((vertices - vertices.min(0)) / side).astype(np.int64)
        _, cell = np.unique(grid @ np.array([1, 1000, 1000000]), return_inverse=True)
        counts = np.bincount(cell)
        means = np.stack([np.bincount(cell, axis) / counts for axis in vertices.T], 1)
        distance = ((vertices - means[cell]) ** 2).sum(1)
        order = np.lexsort((distance, cell))
        nearest = np.searchsorted(cell[order], np.arange(len(counts)))
        middle = order[nearest]
        merged = middle[cell[faces]]
        a, b, c = merged.T
        kept = np.flatnonzero((a != b) & (b != c) & (c != a))
        if len(kept) <= MAX_FACES:
            break
    return kept, merged[kept]


def moved_texture(before: np.ndarray, after: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Places in the texture, (f, 3, 2), of faces whose corners have moved, so that their picture does not.

    `before` and `after` are the corners, (f, 3, 3); each face's own affine map is continued.
    """
    corner = before[:, :1]
    place = places[:, :1]
    edges = (before[:, 1:] - corner).astype(np.float64)
    slope = np.linalg.pinv(edges, rcond=1e-4) @ (places[:, 1:] - place)
    moved = place + (after - corner) @ slope
    return np.clip(moved, places.min(), places.max())
