# SPDX-License-Identifier: Apache-2.0
"""The dreams of a run as a LeRobotDataset.

    accerl train … --imagination.record=1000
    accerl export --source=imagined --path=RUN --root=outputs/dreams

A dream goes a chunk at a time, and so does its dataset: one frame for each decision, which shows what the
policy was shown, and as action the whole chunk, K·A numbers, since there is no frame between its actions. The
first frame of an episode is real, the others are imagined; what is seen after the last decision has no
action, and is left out, as of real episodes. Neither pace nor action is that of a dataset of real episodes,
so the two are not mixed by mistake.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from accerl_lerobot.console import Console
from accerl_lerobot.demos.writing import new_dataset
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.recorded import Dreamt

VERSION, WORLD_VERSION = "policy_version", "world_model_version"
"""Features: updates behind the weights that decided; gradient steps behind the world model."""
IMAGINED, DEPTH = "imagined", "dream_depth"
"""True if the frame was imagined, and after how many imagined decisions it is seen."""
ORIGIN_SEED, ORIGIN_DECISION = "origin_seed", "origin_decision"
"""The real episode that the dream begins in, and after how many of its decisions."""
_NUMBERS = (VERSION, WORLD_VERSION, DEPTH, ORIGIN_SEED, ORIGIN_DECISION)


def write_dreams(
    dreams: list[Dreamt], root: Path, repo_id: str, robot_type: str, console: Console
) -> dict[str, Any]:
    """Writes a dataset.

    Args:
        dreams: at least one; all of one world.
        root: folder of the dataset.
        repo_id: its name.
        robot_type: LeRobot's word for the world.
        console: progress for people.

    Returns:
        ``episodes``, ``frames``, ``successes``, ``decisions_per_s``, ``actions_per_frame``.

    Raises:
        InputError: they are not of one world.
    """
    first = dreams[0]
    table, fps = features(first), max(1, round(first.decisions_per_s))
    tally = {"episodes": 0, "frames": 0, "successes": 0}
    with (
        console.stage("writing dreams", total=len(dreams)) as stage,
        new_dataset(root, repo_id, fps, robot_type, table) as dataset,
    ):
        for number, dream in enumerate(dreams, start=1):
            if features(dream) != table or dream.decisions_per_s != first.decisions_per_s:
                remedy = f"dream {dream.number} is of another world than dream {first.number}; remove one"
                raise InputError("path", str(root), remedy)
            for frame in frames(dream):
                dataset.add_frame(frame)
            dataset.save_episode()
            tally["episodes"] += 1
            tally["frames"] += len(dream)
            tally["successes"] += dream.success
            stage.update(number, f"{tally['successes']} successes")
    if fps != first.decisions_per_s:
        console.say(f"{first.decisions_per_s:g} decisions a second, which LeRobot is told are {fps}")
    pace = {"decisions_per_s": first.decisions_per_s, "actions_per_frame": first.actions.shape[1]}
    return tally | pace


def features(dream: Dreamt) -> dict[str, dict[str, Any]]:
    """LeRobot's feature table for dreams like this one."""
    table: dict[str, dict[str, Any]] = {}
    for key, rows in dream.observations.items():
        if rows.dtype == np.uint8 and rows.ndim == 4:
            names = ["height", "width", "channels"]
            table[key] = {"dtype": "image", "shape": rows.shape[1:], "names": names}
        else:
            table[key] = _vector(rows[0].size, "state")
    _, chunk, size = dream.actions.shape
    table["action"] = _vector(chunk * size, "action")
    table["action"]["names"] = [f"action_{k}_{i}" for k in range(chunk) for i in range(size)]
    table["next.reward"] = {"dtype": "float32", "shape": (1,), "names": None}
    for key in ("next.done", "next.success", IMAGINED):
        table[key] = {"dtype": "bool", "shape": (1,), "names": None}
    return table | {key: {"dtype": "int64", "shape": (1,), "names": None} for key in _NUMBERS}


def frames(dream: Dreamt) -> Iterator[dict[str, Any]]:
    """Its rows as ``LeRobotDataset.add_frame`` takes them."""
    _, seed, decision = dream.origin
    for t in range(len(dream)):
        last = t == len(dream) - 1
        numbers = (int(dream.versions[t]), dream.world_version, t, seed, decision)
        yield {
            **{key: rows[t] for key, rows in dream.observations.items()},
            "action": dream.actions[t].reshape(-1),
            "next.reward": dream.rewards[t : t + 1],
            "next.done": np.array([last and (dream.terminated or dream.truncated)]),
            "next.success": np.array([last and dream.success]),
            IMAGINED: np.array([t > 0]),
            **{key: np.array([n], np.int64) for key, n in zip(_NUMBERS, numbers, strict=True)},
            "task": dream.task,
        }


def _vector(size: int, name: str) -> dict[str, Any]:
    return {"dtype": "float32", "shape": (size,), "names": [f"{name}_{i}" for i in range(size)]}
