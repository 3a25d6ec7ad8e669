# SPDX-License-Identifier: Apache-2.0
"""Scripted experts for LIBERO that read the simulator's own state.

A script is a generator of actions. It reads the simulation before each action, and grasps a lost object
again. Positions are in metres in the world's frame, rotations in radians.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.linalg import norm
from scipy.spatial.transform import Rotation

from accerl_lerobot.envs.base import Environment
from accerl_lerobot.envs.libero_simulator import LiberoEnvironment, Simulator
from accerl_lerobot.errors import InputError

Goal = Callable[[], np.ndarray]  # a position (3,), which may move
Condition = Callable[[], bool]
Script = Generator[np.ndarray, None, bool]
"""Yields actions, float64 (7,); returns True if the movement was completed."""

SUITES = ("libero_object", "libero_spatial", "libero_goal", "libero_10")
REACH = 0.05  # movement in m for an action of 1
TURN = 0.5  # turn in rad for an action of 1
GRIP_STEPS = 10  # env steps in which the fingers open or close
OFFSETS = {
    "basket": (0, 0, -0.055),
    "heating_region": (-0.04, -0.01, -0.06),
    "bottom_region": (0, -0.022, 0.033),
    "moka_pot_1": (-0.05, 0, 0.035),
    "moka_pot_2": (0.05, 0, 0.035),
    "cook_region": (0, 0, 0.035),
    "wine_rack": (0, -0.01, 0.008),
    "plate_right_region": (0, 0.015, 0.035),
    "bowl": (0, 0, 0.03),
}
"""Target of an object's lowest point, relative to the position of the object or region it is placed on, by
the object's name or a part of the region's."""
HANDLES = {
    "top": (-0.002, -0.1015, 0.184),
    "middle": (-0.002, -0.1015, 0.1105),
    "bottom": (-0.002, -0.1015, 0.041),
}
"""Centre of the handle of each of a cabinet's drawers, in the drawer's frame."""
BESIDE_DRAWER = (-0.07, 0, 0.005)
"""Movement of an object that was grasped below an open drawer, before the object is lifted."""
LID = (0, 0, 0.077)  # place of the fingers at the knob of a moka pot's lid, in the pot's frame
MUG_HANDLE = (0.062, 0, 0.068)  # centre of the yellow and white mug's handle in its frame
DOOR = (0.2, 0.06)  # point on a microwave's door: distance from its hinge, and height above its middle
KNOB = 0.038  # height of the grasp above the origin of the stove's knob
PRESS = 0.008  # height of the fingers above a plate's origin while they push it
WIDEST = 0.068  # widest object that fits between the open fingers with some room, in m
RIM = 0.012  # distance of the grip site from the outside of a rim, in m
DEPTH = 0.015  # distance of the grip site below an object's top; the palm is 2.4 cm above the grip site
MARGIN = 0.004  # distance at which a point counts as inside an object, in m
CLEARANCE = 0.08  # distance of objects beside the hand's way that it rises above, in m
EASY_REACH = 0.72  # distance from the robot's base that a hand pointing straight down reaches easily, in m
DOWN = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
"""Rotation of a hand that points down; its fingers close along the world's y axis."""
_CORNERS = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
_FINGERS = product((-0.053, -0.043, 0.043, 0.053), (-0.01, 0.01), (0.008, -0.02))
_PALM = product(np.linspace(-0.1, 0.1, 11), np.linspace(-0.034, 0.034, 5), np.arange(-0.026, -0.11, -0.016))
HAND = np.array([*_FINGERS, *_PALM])
"""Points of the open hand in its own frame, (P, 3): along the fingers' axis, across it, and ahead."""


class Grasp(NamedTuple):
    """Pose of the hand that takes an object."""

    offset: np.ndarray  # (3,) of the grip site from the object's position
    yaw: float  # turn of the hand about the vertical
    lean: float  # tilt of the hand, so that it points more to the side
    ahead: np.ndarray | None = None  # (2,) direction in which it then points; None: away from the robot


class Scene:
    """Collision geometry of the objects and fixtures, as boxes.

    Args:
        simulator: at the start of an episode.
    """

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        model = simulator.model
        self.base = simulator.data.body("robot0_base").xpos[:2].copy()
        self._root = model.body_rootid[model.geom_bodyid]
        solid = (model.geom_contype | model.geom_conaffinity) > 0
        self._solid = solid & np.isin(self._root, list(simulator.env.obj_body_id.values()))

    def _geoms(self, name: str, others: bool) -> np.ndarray:
        own = self._root == self.simulator.env.obj_body_id[name]
        return np.flatnonzero(self._solid & (own != others))

    def corners(self, name: str, others: bool = False) -> np.ndarray:
        """Corners (G, 8, 3) of the boxes of one object, or of all others."""
        geoms = self._geoms(name, others)
        data = self.simulator.data
        boxes = self.simulator.model.geom_aabb[geoms][:, None]
        middle, half = np.split(boxes, 2, axis=-1)
        corners = middle + _CORNERS * half
        turn = data.geom_xmat[geoms].reshape(-1, 3, 3)
        return corners @ turn.transpose(0, 2, 1) + data.geom_xpos[geoms][:, None]

    def collisions(self, name: str, points: np.ndarray) -> np.ndarray:
        """Number of points (..., P, 3) that are inside an object other than `name`, int (...)."""
        model = self.simulator.model
        data = self.simulator.data
        centre = points.reshape(-1, 3).mean(0)
        spread = norm(points - centre, axis=-1).max() + MARGIN
        inside = np.zeros(points.shape[:-1], bool)
        for geom in self._geoms(name, others=True):
            position = data.geom_xpos[geom]
            middle, half = model.geom_aabb[geom].reshape(2, 3)
            reach = spread + norm(middle) + norm(half)
            if norm(position - centre) >= reach:
                continue
            turn = data.geom_xmat[geom].reshape(3, 3)
            local = (points - position) @ turn - middle
            inside |= (np.abs(local) < half + MARGIN).all(-1)
        return inside.sum(-1)

    def height(self, name: str, start: np.ndarray, goal: np.ndarray) -> float:
        """Highest point of the objects that are, seen from above, within `CLEARANCE` of a line."""
        corners = self.corners(name, others=True)
        low = corners.min(1)
        high = corners.max(1)
        shares = np.linspace(0, 1, 12)[:, None, None]
        line = start[:2] + shares * (goal - start)[:2]
        gap = np.maximum(low[:, :2] - line, line - high[:, :2]).max(-1)
        near = (gap < CLEARANCE).any(0)
        lowest = self.corners(name)[..., 2].min()
        return float(high[near, 2].max(initial=lowest))

    def turn(self, grasp: Grasp, at: np.ndarray) -> np.ndarray:
        """Rotation (3, 3) of a hand at position `at` that holds a grasp."""
        ahead = grasp.ahead
        if ahead is None:
            ahead = at[:2] - self.base
        x, y = ahead / norm(ahead)
        lean = Rotation.from_rotvec(grasp.lean * np.array([y, -x, 0]))
        yaw = Rotation.from_euler("z", grasp.yaw)
        return (lean * yaw).as_matrix() @ DOWN

    def grasp(self, name: str, goal: np.ndarray, rng: np.random.Generator) -> Grasp:
        """Choose a grasp from above: across the narrow side, or at the rim of an object that is too wide.

        `goal` is the position (3,) where the object is to be placed, as the hand must fit there too; `rng`
        chooses among grasps of similar cost.
        """
        corners = self.corners(name)
        position = self.simulator.position(name)
        heights = corners[..., 2]
        bottom = heights.min(1)
        top = heights.max(1)
        middle = (top.max() + bottom.min()) / 2
        height = max(top.max() - DEPTH, middle)
        yaws = np.radians(np.arange(-90, 90, 7.5))
        sine = np.sin(yaws)
        cosine = np.cos(yaws)
        across = np.stack([-sine, cosine], -1)  # axes of the fingers
        along = np.stack([cosine, sine], -1)
        flat = corners[..., :2].reshape(-1, 2)
        width = np.ptp(flat @ across.T, axis=0)
        if width.min() < WIDEST:  # across it, in the middle or toward an end
            level = (bottom < height) & (top > height)
            level |= np.abs(heights - height).min(1) < 0.005
            flat = corners[level, :, :2].reshape(-1, 2)
            width = np.ptp(flat @ across.T, axis=0)
            length = np.ptp(flat @ along.T, axis=0)
            to_end = along * np.maximum(length / 2 - 0.022, 0)[:, None]
            offsets = np.concatenate([0 * along, to_end, -to_end])
            cost = np.where(width < WIDEST, 40 * (width - width.min()), np.inf)
            at_end = cost + 0.5
            cost = np.concatenate([cost, at_end, at_end])
        else:
            to_rim = across * (width / 2 - RIM)[:, None]
            offsets = np.concatenate([to_rim, -to_rim])
            cost = np.repeat([1.0, 0.0], len(across))  # the side of −y, if it is free
        points = (flat.min(0) + flat.max(0)) / 2 + offsets
        yaws = np.tile(yaws, len(points) // len(yaws))
        hands = np.insert(points, 2, height, axis=1)
        both_ends = np.stack([hands, hands + goal - position])
        reach = norm(both_ends[..., :2] - self.base, axis=-1).max(0)
        far = np.maximum(reach - EASY_REACH, 0)
        leans = np.minimum(3 * far, 0.35)
        grasps = [Grasp(*each) for each in zip(hands - position, yaws, leans, strict=True)]
        turns = np.stack([self.turn(grasp, position) for grasp in grasps])
        spread = hands[:, None] + HAND @ turns.transpose(0, 2, 1)
        cost += self.collisions(name, spread) + self.collisions(name, spread + goal - position)
        cost += 30 * far + 0.7 * np.abs(yaws) + rng.normal(0, 0.3, len(yaws))
        return grasps[np.argmin(cost)]

    def leaning_grasp(self, name: str) -> Grasp:
        """A grasp at the rim toward +y, with a hand that comes from the robot's side."""
        corners = self.corners(name).reshape(-1, 3)
        low = corners.min(0)
        high = corners.max(0)
        rim = np.array([(low[0] + high[0]) / 2, high[1] - RIM, high[2] - DEPTH])
        return Grasp(rim - self.simulator.position(name), 0.0, 0.5)


class Hand:
    """Movements of the robot's hand in a scene; `rng` is for the differences between episodes."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.simulator = scene.simulator
        self.rng = rng
        self.speed = rng.uniform(0.85, 1)
        self.grip = -1.0
        self.held = np.zeros(3)  # offset of the grasped object from the hand
        self.pose: Grasp | None = None  # gives the wanted orientation; None: straight down

    @property
    def position(self) -> np.ndarray:
        """Position (3,) of the point between the fingertips, as it is now."""
        return self.simulator.hand[0]

    def toward(self, goal: np.ndarray) -> np.ndarray:
        """Action toward a position and the wanted orientation."""
        delta = (goal - self.position) / REACH
        turn = self.rotation_error().as_rotvec() / TURN
        return np.concatenate([self._limited(delta), self._limited(turn), [self.grip]])

    def _limited(self, movement: np.ndarray) -> np.ndarray:
        """A movement in the same direction that is no faster than this hand."""
        largest = max(np.abs(movement).max(), 1e-9)
        return movement * min(1.0, self.speed / largest)

    def rotation_error(self) -> Rotation:
        """Rotation from the hand's current orientation to the wanted one."""
        position, rotation = self.simulator.hand
        wanted = DOWN if self.pose is None else self.scene.turn(self.pose, position)
        return Rotation.from_matrix(wanted @ rotation.T)

    def move(
        self, goal: Goal, within: float = 0.012, steps: int = 60, given: Condition = lambda: True
    ) -> Script:
        """Moves straight to a goal that may itself move, for at most `steps` and while `given` is true."""
        lag: np.ndarray = np.zeros(3)
        for _ in range(steps):
            if not given():
                return False
            error = goal() - self.position
            distance = norm(error)
            if distance < within and self.rotation_error().magnitude() < 0.2:
                return True
            if distance < 0.03:  # the controller has no integral part, and a stretched arm lags behind
                lag = np.clip(lag + 0.1 * error, -0.03, 0.03)
            yield self.toward(goal() + lag)
        return True

    def set_grip(self, grip: float, place: np.ndarray, steps: int = GRIP_STEPS) -> Script:
        """Opens (-1) or closes (1) the fingers at a place."""
        self.grip = grip
        for _ in range(steps):
            yield self.toward(place)
        return True

    def shift(self, by: Sequence[float], steps: int) -> Script:
        """Moves by a vector (3,)."""
        goal = self.position + by
        return (yield from self.move(lambda: goal, steps=steps))

    def rise(self, height: float, steps: int) -> Script:
        """Moves straight up."""
        return (yield from self.shift([0, 0, height], steps))

    def over(self, goal: Goal, height: float, given: Condition = lambda: True) -> Script:
        """Moves to `height` above a goal: up first, then sideways."""

        def waypoint() -> np.ndarray:
            position = self.position
            aim = goal()
            below = height - position[2]
            late = np.clip(below / 0.03 - 0.3, 0, 1)  # 1: stay above the current place
            aim = aim + late * (position - aim)
            return np.array([*aim[:2], height])

        return (yield from self.move(waypoint, within=0.02, given=given))

    def pick(
        self, name: str, place: Goal, known: Grasp | None = None, aside: Sequence[float] | None = None
    ) -> Script:
        """Grasps an object, moves it `aside` and lifts it a little; repeats until it holds the object."""
        scene = self.scene
        simulator = self.simulator
        while True:
            if self.grip > 0:  # the object was lost
                yield from self.set_grip(-1.0, self.position, 5)
                yield from self.rise(0.08, 12)
            grasp = known or scene.grasp(name, place(), self.rng)
            self.pose = grasp
            start = self.position

            def goal(offset: np.ndarray = grasp.offset) -> np.ndarray:
                return simulator.position(name) + offset

            above_others = scene.height(name, start, goal()) + 0.03
            above_goal = goal()[2] + self.rng.uniform(0.04, 0.08)
            yield from self.over(goal, max(above_others, above_goal))
            yield from self.move(goal, within=0.008, steps=25)
            yield from self.set_grip(1.0, goal())
            if aside is not None:
                yield from self.shift(aside, steps=12)
            self.held = simulator.position(name) - self.position
            yield from self.rise(0.06, 8)
            if self.holds(name):
                return True

    def holds(self, name: str) -> bool:
        """True if the object has hardly moved relative to the hand since the grasp."""
        offset = self.simulator.position(name) - self.position
        return bool(norm(offset - self.held) < 0.05)


def pick_and_place(hand: Hand, name: str, region: str) -> Script:
    """Carries an object to a region or another object and releases it there."""
    scene = hand.scene
    simulator = hand.simulator
    heights = scene.corners(name)[..., 2] - simulator.position(name)[2]
    known = (offset for part, offset in OFFSETS.items() if part == name or part in region)
    x, y, up = next(known, (0, 0, 0.01))
    up = up - heights.min()
    if "basket" in region:  # the palm stays above the basket's rim
        up = max(up, 0.045 - heights.max())

    def place() -> np.ndarray:
        return simulator.position(region) + [x, y, up]

    def goal() -> np.ndarray:
        return place() + hand.position - simulator.position(name)

    def held() -> bool:
        return hand.holds(name)

    grasp = aside = None
    if "moka_pot" in name:
        grasp = Grasp(np.array(LID), 0.0, 0.0)
    if region == "wooden_cabinet_1_top_region":  # the open drawer is above the object
        grasp = scene.leaning_grasp(name)
        aside = BESIDE_DRAWER
    yield from hand.pick(name, place, grasp, aside)
    position = hand.position
    below = position[2] - scene.corners(name)[..., 2].min()
    clear = scene.height(name, position, goal()) + below + hand.rng.uniform(0.02, 0.04)
    if not (yield from hand.over(goal, clear, held)):
        return False
    if not (yield from hand.move(goal, given=held)):
        return False
    yield from hand.set_grip(-1.0, hand.position)
    return (yield from hand.rise(0.1, 15))


def slide(hand: Hand, name: str, region: str) -> Script:
    """Slides a plate to a region with closed fingers that push its rim from inside."""
    simulator = hand.simulator

    def ahead(distance: float, height: float) -> np.ndarray:
        position = simulator.position(name)
        way = (simulator.position(region) - position)[:2]
        x, y = distance * way / max(norm(way), 1e-6)
        return position + [x, y, height]

    def follows() -> bool:
        offset = hand.position - simulator.position(name)
        return bool(norm(offset) < 0.075)

    hand.grip = 1.0
    yield from hand.move(lambda: ahead(0.02, 0.08), within=0.02)
    yield from hand.move(lambda: ahead(0.02, PRESS), steps=25)
    yield from hand.move(lambda: ahead(0.065, PRESS), steps=80, given=follows)
    return (yield from hand.rise(0.08, 12))


def put_in_microwave(hand: Hand, name: str, region: str) -> Script:
    """Carries a mug by its handle into a microwave, whose door is toward −y."""
    simulator = hand.simulator
    turn = Rotation.from_quat(simulator.pose(name)[1], scalar_first=True)
    grasp = Grasp(turn.apply(MUG_HANDLE), np.pi / 2, 1.4, np.array([0.0, 1]))

    def place() -> np.ndarray:
        return simulator.position(region) + OFFSETS["heating_region"]

    def goal(ahead: float = 0.0) -> np.ndarray:
        return place() + hand.position - simulator.position(name) - [0, ahead, 0]

    def held() -> bool:
        return hand.holds(name)

    yield from hand.pick(name, place, grasp)
    yield from hand.move(lambda: goal(0.2), within=0.02, given=held)
    if not (yield from hand.move(goal, given=held)):
        return False
    yield from hand.set_grip(-1.0, hand.position)
    back = hand.position - [0, 0.12, 0]
    return (yield from hand.move(lambda: back, within=0.02))


def approach(hand: Hand, goal: Goal, height: float) -> Script:
    """Moves closed fingers to a goal from above."""
    hand.grip = 1.0
    yield from hand.over(goal, height)
    return (yield from hand.move(goal, within=0.02))


def close_microwave(hand: Hand, name: str) -> Script:
    """Pushes a microwave's door from outside until it is closed."""
    door = hand.simulator.data.body(f"{name}_microdoorroot")

    def outside(distance: float, height: float = 0.0) -> np.ndarray:
        point = [DOOR[0], -distance, DOOR[1] + height]
        return door.xpos + door.xmat.reshape(3, 3) @ point

    hand.pose = None
    yield from approach(hand, lambda: outside(0.1), outside(0, 0.15)[2])
    return (yield from hand.move(lambda: outside(-0.06), steps=150))


def in_front(hand: Hand, region: str, yaw: float, lean: float) -> Callable[..., np.ndarray]:
    """Turns the hand toward a cabinet; returns positions ahead of the handle of this region's drawer."""
    simulator = hand.simulator
    cabinet, level, _ = region.rsplit("_", 2)
    drawer = simulator.data.body(f"{cabinet}_cabinet_{level}")
    turn = Rotation.from_quat(simulator.pose(cabinet)[1], scalar_first=True)
    front = turn.apply([0, -1.0, 0])
    hand.pose = Grasp(np.zeros(3), yaw, lean, -front[:2])

    def handle(ahead: float = 0.0) -> np.ndarray:
        return drawer.xpos + turn.apply(HANDLES[level]) + ahead * front

    return handle


def open_drawer(hand: Hand, region: str) -> Script:
    """Opens the drawer with this region: grasps the handle from the front, pulls, and lets it go."""
    handle = in_front(hand, region, 0.0, 1.4)

    def holds() -> bool:
        offset = handle() - hand.position
        return bool(norm(offset) < 0.03)

    yield from hand.move(lambda: handle(0.1), within=0.02)
    yield from hand.move(handle, steps=30)
    yield from hand.set_grip(1.0, handle())
    pulled = handle(0.2)
    yield from hand.move(lambda: pulled, steps=40, given=holds)
    yield from hand.set_grip(-1.0, hand.position, 5)
    return (yield from hand.move(lambda: handle(0.1), within=0.02))


def close_drawer(hand: Hand, region: str) -> Script:
    """Closes the drawer with this region: pushes its handle with closed fingers."""
    _, rotation = hand.simulator.hand
    yaw = np.copysign(np.pi / 2, -rotation[0, 0])  # the one that needs the smaller turn
    handle = in_front(hand, region, yaw, 0.8)
    yield from approach(hand, lambda: handle(0.06), handle()[2] + 0.15)
    return (yield from hand.move(lambda: handle(-0.05), steps=80))


def turn_knob(hand: Hand, name: str) -> Script:
    """Turns on a stove: grasps its knob from above and turns the hand."""
    simulator = hand.simulator
    knob = simulator.data.body(f"{name}_button").xpos + [0, 0, KNOB]

    def turn_by(angle: float) -> None:
        yaw = simulator.opening(name) + angle
        hand.pose = Grasp(np.zeros(3), yaw, 0.0)

    turn_by(0.0)
    yield from hand.move(lambda: knob + [0, 0, 0.08])
    turn_by(0.0)
    yield from hand.move(lambda: knob, steps=25)
    yield from hand.set_grip(1.0, knob)
    turn_by(1.2)
    yield from hand.set_grip(1.0, knob, 15)
    yield from hand.set_grip(-1.0, knob)
    return (yield from hand.rise(0.08, 12))


SKILLS: dict[str, Callable[..., Script]] = {
    "in": pick_and_place,
    "on": pick_and_place,
    "open": open_drawer,
    "turnon": turn_knob,
    "close": close_drawer,
    "microwave_1": close_microwave,
    "microwave_1_heating_region": put_in_microwave,
    "main_table_stove_front_region": slide,
}
"""Skill that makes a predicate of LIBERO's true, by the name of its last object or else by its own name."""
PLANS = {
    "libero_goal/3": [
        ["open", "wooden_cabinet_1_top_region"],
        ["in", "akita_black_bowl_1", "wooden_cabinet_1_top_region"],
    ],
    "libero_10/3": [
        ["in", "akita_black_bowl_1", "white_cabinet_1_bottom_region"],
        ["close", "white_cabinet_1_bottom_region"],
    ],
    "libero_10/6": [
        ["on", "chocolate_pudding_1", "living_room_table_plate_right_region"],
        ["on", "porcelain_mug_1", "plate_1"],
    ],
}
"""Predicates of LIBERO's that a task needs, in the order of work, where its goal alone does not tell them."""


def script(environment: LiberoEnvironment, task: str) -> Script:
    """The script of an episode, which works at the first predicate that is not true yet.

    It begins at its first action, when the episode has begun. Equal starts give equal scripts.
    """
    simulator: Simulator = environment.simulator
    rng = np.random.default_rng(simulator.data.qpos.view(np.uint32))
    hand = Hand(Scene(simulator), rng)
    plan = PLANS.get(task, simulator.env.parsed_problem["goal_state"])
    while True:
        missing = [step for step in plan if not simulator.env._eval_predicate(step)]
        verb, *names = (missing or plan)[0]
        skill = SKILLS.get(names[-1]) or SKILLS[verb]
        yield from skill(hand, *names)


def libero_expert(environment: Environment, task: str) -> Callable[[], np.ndarray]:
    """The expert of a task.

    Raises:
        InputError: there is none for this task.
    """
    assert isinstance(environment, LiberoEnvironment)
    if task.split("/")[0] not in SUITES:
        hint = f"scripted experts exist for {', '.join(SUITES)}; name other tasks"
        raise InputError("env.task", task, hint)
    actions = script(environment, task)
    return lambda: next(actions)
