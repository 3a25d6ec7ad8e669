# SPDX-License-Identifier: Apache-2.0
"""Grasps for LIBERO's objects, found from the geometry of the scene.

Positions are in metres in the world's frame, turns in radians.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from accerl_lerobot.envs.libero_simulator import Simulator

WIDEST = 0.068  # widest object that fits between the open fingers with some room, in m
DEPTH = 0.015  # distance of the grip site below an object's top; the palm is 2.4 cm above the grip site
EASY_REACH = 0.72  # distance from the robot's base that a hand pointing straight down reaches easily, in m
DOWN = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
"""Rotation of a hand that points down; its fingers close along the world's y axis."""
_CORNERS = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
_FINGERS = itertools.product((-0.053, -0.043, 0.043, 0.053), (-0.01, 0.01), (0.008, -0.02))
_PALM = itertools.product(
    np.linspace(-0.1, 0.1, 11), np.linspace(-0.034, 0.034, 5), np.arange(-0.026, -0.11, -0.016)
)
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
        geoms, data = self._geoms(name, others), self.simulator.data
        middle, half = np.split(self.simulator.model.geom_aabb[geoms][:, None], 2, axis=-1)
        turn = data.geom_xmat[geoms].reshape(-1, 3, 3)
        return (middle + _CORNERS * half) @ turn.transpose(0, 2, 1) + data.geom_xpos[geoms][:, None]

    def collisions(self, name: str, points: np.ndarray, margin: float = 0.004) -> np.ndarray:
        """Number of points (..., P, 3) that are inside an object other than `name`, int (...)."""
        model, data = self.simulator.model, self.simulator.data
        centre = points.reshape(-1, 3).mean(0)
        spread = np.linalg.norm(points - centre, axis=-1).max() + margin
        inside = np.zeros(points.shape[:-1], bool)
        for geom in self._geoms(name, others=True):
            position, (middle, half) = data.geom_xpos[geom], model.geom_aabb[geom].reshape(2, 3)
            if np.linalg.norm(position - centre) < spread + np.linalg.norm(middle) + np.linalg.norm(half):
                local = (points - position) @ data.geom_xmat[geom].reshape(3, 3) - middle
                inside |= (np.abs(local) < half + margin).all(-1)
        return inside.sum(-1)

    def height(self, name: str, start: np.ndarray, goal: np.ndarray, margin: float = 0.08) -> float:
        """Highest point of the objects that are, seen from above, within `margin` of a line."""
        corners = self.corners(name, others=True)
        low, high = corners.min(1), corners.max(1)
        way = start[:2] + np.linspace(0, 1, 12)[:, None] * (goal - start)[:2]
        gap = np.maximum(low[:, :2] - way[:, None], way[:, None] - high[:, :2]).max(-1)
        return float(high[(gap < margin).any(0), 2].max(initial=self.corners(name)[..., 2].min()))

    def turn(self, grasp: Grasp, at: np.ndarray) -> np.ndarray:
        """Rotation (3, 3) of a hand at position `at` that holds a grasp."""
        ahead = at[:2] - self.base if grasp.ahead is None else grasp.ahead
        x, y = ahead / np.linalg.norm(ahead)
        lean = Rotation.from_rotvec(grasp.lean * np.array([y, -x, 0]))
        return (lean * Rotation.from_euler("z", grasp.yaw)).as_matrix() @ DOWN

    def grasp(self, name: str, goal: np.ndarray, rng: np.random.Generator) -> Grasp:
        """Choose a grasp from above: across the narrow side, or at the rim of an object that is too wide.

        `goal` is the position (3,) where the object is to be placed, as the hand must fit there too; `rng`
        chooses among grasps of similar cost.
        """
        corners, position = self.corners(name), self.simulator.pose(name)[0]
        bottom, top = corners[..., 2].min(1), corners[..., 2].max(1)
        height = max(top.max() - DEPTH, (top.max() + bottom.min()) / 2)
        yaws = np.radians(np.arange(-90, 90, 7.5))
        across = np.stack([-np.sin(yaws), np.cos(yaws)], -1)  # axes of the fingers
        along = np.stack([np.cos(yaws), np.sin(yaws)], -1)
        flat = corners[..., :2].reshape(-1, 2)
        if np.ptp(flat @ across.T, axis=0).min() < WIDEST:  # across it, in the middle or toward an end
            level = (bottom < height) & (top > height) | (np.abs(corners[..., 2] - height).min(1) < 0.005)
            flat = corners[level, :, :2].reshape(-1, 2)
            width = np.ptp(flat @ across.T, axis=0)
            length = np.ptp(flat @ along.T, axis=0)
            to_end = along * np.maximum(length / 2 - 0.022, 0)[:, None]
            offsets = np.concatenate([0 * along, to_end, -to_end])
            cost = np.where(width < WIDEST, 40 * (width - width.min()), np.inf)
            cost = np.concatenate([cost, cost + 0.5, cost + 0.5])
        else:
            to_rim = across * (np.ptp(flat @ across.T, axis=0) / 2 - 0.012)[:, None]
            offsets = np.concatenate([to_rim, -to_rim])
            cost = np.repeat([1.0, 0.0], len(across))  # the side of −y, if it is free
        points = (flat.min(0) + flat.max(0)) / 2 + offsets
        yaws = np.tile(yaws, len(points) // len(yaws))
        hands = np.column_stack([points, np.full(len(points), height)])
        moved = hands + goal - position
        reach = np.maximum(*(np.linalg.norm(at[:, :2] - self.base, axis=-1) for at in (hands, moved)))
        far = np.maximum(reach - EASY_REACH, 0)
        leans = np.minimum(3 * far, 0.35)
        grasps = [Grasp(*each) for each in zip(hands - position, yaws, leans, strict=True)]
        turns = np.stack([self.turn(grasp, position) for grasp in grasps])
        spread = hands[:, None] + HAND @ turns.transpose(0, 2, 1)
        cost += self.collisions(name, spread) + self.collisions(name, spread + goal - position)
        cost += 30 * far + 0.7 * np.abs(yaws) + rng.normal(0, 0.3, len(yaws))
        return grasps[np.argmin(cost)]
