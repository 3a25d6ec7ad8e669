# SPDX-License-Identifier: Apache-2.0
"""Scripted experts for LIBERO: pick an object up from above and put it down where the task wants it.

They read the simulator's state. A grasp that has slipped, or that something was in the way of, is noticed and
tried again from another side.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from accerl_lerobot.envs.base import World
from accerl_lerobot.envs.libero import LiberoWorld
from accerl_lerobot.envs.libero_simulator import Simulator
from accerl_lerobot.errors import InputError

REACH = 0.045
"""Metres that an object may stand out above the fingertips before it touches the palm."""
PALM = 0.08
"""Metres from the fingertips to the palm, which reaches `PALM_HALF` to each side along the fingers' axis."""
PALM_HALF = 0.1
STEP = 0.05
"""Metres of a full Cartesian action."""
TURN = 0.5
"""Radians of a full turning action."""
CLOSING = 9
"""Env steps that the fingers take."""
STUCK = 50
"""Env steps after which something must be in the way."""
RIM = 0.05
"""Metres from the middle of a bowl to its rim."""


class PickAndPlace:
    """One episode's expert; call it for the next action, float32 (7,).

    Args:
        simulator: at the start of the episode.
    """

    def __init__(self, simulator: Simulator) -> None:
        self.sim = simulator
        (_, self.object, self.place), *_ = simulator.env.parsed_problem["goal_state"]
        self.bowl = self.object.startswith("akita")
        self.rotation = simulator.hand[1].copy()
        position = simulator.pose(self.object)[0]
        # Varied from episode to episode, and the same for equal starts.
        seed = np.concatenate([position, simulator.pose(self.place)[0]]) * 1e6
        rng = np.random.default_rng(np.abs(seed).astype(int))
        self.above, self.gain = rng.uniform(0.07, 0.11), rng.uniform(0.8, 1.2)
        self.shift = rng.normal(0, 0.003, 2)
        self.phase, self.waited = "above", 0
        self.bottom = position[2]
        # Directions from the object's middle in which it is grasped, and the turns of the hand for that.
        sides = np.array([0, np.pi, -np.pi / 2, np.pi / 2] if self.bowl else [0, 0.45, -0.45])
        room = np.array([min(self._room(position, side), 0.04) for side in sides])
        room += 1e-3 * rng.random(len(sides))
        self.sides = list(sides[np.argsort(-room)])

    def __call__(self) -> np.ndarray:
        hand, _ = self.sim.hand
        position, target = self.sim.pose(self.object)[0], self.sim.pose(self.place)[0]
        grasp, height = self._grasp(position), self._carry(hand)
        held = np.linalg.norm((hand - grasp)[:2]) < 0.04 and hand[2] - grasp[2] < 0.04
        over = target + (hand - position) * np.array([1, 1, 0])
        self.waited += 1
        if self.phase in ("lift", "over", "lower") and not held:
            self._try_another_side()
        if self.phase == "above":
            goal = grasp + np.array([0, 0, self.above])
            if np.linalg.norm(goal[:2] - hand[:2]) > 0.06:  # on the way there nothing may be in the way
                goal[2] = max(goal[2], hand[2])
            elif np.linalg.norm(goal[:2] - hand[:2]) < 0.015 and hand[2] < goal[2] + 0.03:
                self._go("down")
            if self.waited > STUCK:
                self._try_another_side()
        if self.phase == "down":
            goal = grasp
            if np.linalg.norm(goal[:2] - hand[:2]) > 0.03:
                self._go("above")
            elif hand[2] - goal[2] < 0.008 or self.waited > 20:  # the palm or the floor may be in the way
                self._go("close")
        if self.phase == "close":
            goal = grasp
            if self.waited > CLOSING:
                self._go("lift")
        if self.phase == "lift":
            goal = np.array([*hand[:2], height])
            if hand[2] > height - 0.02:
                self._go("over")
        if self.phase == "over":
            goal = np.array([*over[:2], height])
            if np.linalg.norm(goal[:2] - hand[:2]) < 0.012:
                self._go("lower")
        if self.phase == "lower":
            goal = np.array([*over[:2], self._release(hand, position, target)])
            if hand[2] < goal[2] + 0.01 or self.waited > STUCK:
                self._go("open")
        if self.phase == "open":
            goal = hand
            if self.waited > CLOSING:
                self._go("away")
        if self.phase == "away":
            goal = np.array([*hand[:2], height])
            if hand[2] > height - 0.02:
                self._go("above")
        return self._action(goal, closed=self.phase in ("close", "lift", "over", "lower"))

    def _go(self, phase: str) -> None:
        self.phase, self.waited = phase, 0

    def _try_another_side(self) -> None:
        self.sides.append(self.sides.pop(0))
        self._go("away")

    def _grasp(self, position: np.ndarray, side: float | None = None) -> np.ndarray:
        """Goal of the fingertips: the rim of a bowl, else the middle, as deep as the palm allows."""
        side = self.sides[0] if side is None else side
        if self.bowl:
            return position + np.array([-np.sin(side) * RIM, np.cos(side) * RIM, 0.03])
        low, high = self.sim.extent(self.object)
        centre = (low + high) / 2
        return np.array([*(centre[:2] + self.shift), max(centre[2], high[2] - REACH)])

    def _room(self, position: np.ndarray, side: float) -> float:
        """Metres between the palm and what stands around, where the hand grasps from this side."""
        grasp = self._grasp(position, side)
        along = np.linspace(-PALM_HALF, PALM_HALF, 9)[:, None] * np.array([-np.sin(side), np.cos(side)])
        room = np.inf
        for name in {**self.sim.env.objects_dict, **self.sim.env.fixtures_dict}:
            if name == self.object or name not in self.sim.env.obj_body_id:
                continue
            low, high = self.sim.extent(name)
            if high[2] > grasp[2] + PALM:
                points = grasp[:2] + along
                outside = np.maximum(np.maximum(low[:2] - points, points - high[:2]), 0)
                room = min(room, float(np.linalg.norm(outside, axis=1).min()))
        return room

    def _carry(self, hand: np.ndarray) -> float:
        """Height of the hand at which the object passes over everything."""
        if self.bowl:
            return max(1.12, self.bottom + 0.12)
        low, _ = self.sim.extent(self.object)
        return 0.18 + np.clip(hand[2] - low[2], 0.02, 0.1)

    def _release(self, hand: np.ndarray, position: np.ndarray, target: np.ndarray) -> float:
        """Height of the hand at which the fingers open."""
        if self.bowl:
            return target[2] + 0.012 + hand[2] - position[2]
        return max(0.13, 0.05 + hand[2] - self.sim.extent(self.object)[0][2])

    def _action(self, goal: np.ndarray, closed: bool) -> np.ndarray:
        """Towards `goal`, with the hand turned to the side of the grasp."""
        hand, rotation = self.sim.hand
        # The palm is symmetric: half a turn is none.
        yaw = (self.sides[0] + np.pi / 2) % np.pi - np.pi / 2
        cos, sin = np.cos(yaw), np.sin(yaw)
        wrong = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ self.rotation @ rotation.T
        turn = np.array([wrong[2, 1] - wrong[1, 2], wrong[0, 2] - wrong[2, 0], wrong[1, 0] - wrong[0, 1]]) / 2
        move = self.gain * (goal - hand) / STEP
        action = np.concatenate([move, turn / TURN, [1.0 if closed else -1.0]])
        return np.clip(action, -1, 1).astype(np.float32)


def libero_expert(world: World, task: str) -> Callable[[], np.ndarray]:
    """An expert for one episode; its plan is made at the first call, when the episode has begun.

    Raises:
        InputError: there is none for `task`.
    """
    assert isinstance(world, LiberoWorld)
    if not task.startswith(("libero_object/", "libero_spatial/")):
        remedy = "scripted experts exist for libero_object and libero_spatial; else name a dataset.repo_id"
        raise InputError("env.task", task, remedy)
    plan: list[PickAndPlace] = []

    def act() -> np.ndarray:
        if not plan:
            plan.append(PickAndPlace(world.simulator))
        return plan[0]()

    return act
