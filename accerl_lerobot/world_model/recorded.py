# SPDX-License-Identifier: Apache-2.0
"""Dreams on disk: what the policy was shown in them, what it did, and what that was said to be worth.

``RUN/imagined/`` has one safetensors file for each of the newest ones, named by its number. A run that goes
on from a checkpoint counts on from there, so what had been dreamt after it gives way. `demos.export_dreams`
makes a LeRobotDataset of them. NumPy only.
"""

from __future__ import annotations

import json
import os
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from accerl_lerobot.checkpoint.safety import Origin, brief, tensor_shapes
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Segment

DREAMS = "imagined"
"""Folder of a run's."""
ABOUT = "dream"
"""Name of the JSON in a file's metadata."""
OBSERVATION = "observation."
"""How names of what was shown begin, LeRobot's names."""


@dataclass(frozen=True, kw_only=True)
class Dreamt:
    """A dream of T decisions, K actions each."""

    number: int
    observations: dict[str, np.ndarray]
    """Each (T + 1, ...) under LeRobot's names; the first is real, the others are imagined."""
    actions: np.ndarray
    """float32 (T, K, A)."""
    rewards: np.ndarray
    """float32 (T,), costs taken off."""
    versions: np.ndarray
    """int64 (T,), of the weights behind each decision."""
    task: str
    """The instruction."""
    origin: tuple[str, int, int]
    """Task and seed of the real episode it begins in, and decisions before."""
    world_version: int
    """Version of the world model, in gradient steps of the run."""
    success: bool
    terminated: bool
    truncated: bool
    decisions_per_s: float
    """In the world's time."""

    def __len__(self) -> int:
        return len(self.rewards)


class DreamRecorder:
    """Keeps the newest dreams.

    Args:
        folder: is made; what is in it stays until it is too old.
        most: how many, at least 1.
        decisions_per_s: of the world.
    """

    def __init__(self, folder: Path, most: int, decisions_per_s: float) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._most, self._pace = folder, most, decisions_per_s
        self._kept = deque(sorted(_numbers(folder)))

    def write(self, segment: Segment) -> None:
        """Records an imagined segment."""
        number = int(segment.key.rsplit(".", 1)[1])
        while self._kept and self._kept[-1] >= number:  # of a future that has been forgotten
            self._forget(self._kept.pop())
        while len(self._kept) >= self._most:
            self._forget(self._kept.popleft())
        about = {
            "task": segment.task,
            "origin": list(segment.origin),
            "world_version": segment.world_version,
            "success": segment.success,
            "terminated": segment.terminated,
            "truncated": segment.truncated,
            "decisions_per_s": self._pace,
        }
        tensors = dict(segment.observations) | {
            "actions": segment.actions,
            "rewards": segment.reward,
            "versions": segment.version,
        }
        path = _path(self._folder, number)
        new = path.with_name(f".{path.name}.new")
        whole = {name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}
        save_file(whole, new, metadata={ABOUT: json.dumps(about)})
        os.replace(new, path)
        self._kept.append(number)

    def _forget(self, number: int) -> None:
        _path(self._folder, number).unlink(missing_ok=True)


def read_dreams(folder: Path, field: str = "path") -> Iterator[Dreamt]:
    """Reads recorded dreams, in order.

    Args:
        folder: of `DreamRecorder`.
        field: that named it, for the error.

    Raises:
        InputError: there is none, or a file in it is broken.
    """
    numbers = sorted(_numbers(folder)) if folder.is_dir() else []
    if not numbers:
        remedy = "nothing was recorded of its dreams: run it with --imagination.record=1000, say"
        raise InputError(field, str(folder.parent), remedy)
    origin = Origin(field, str(folder))
    for number in numbers:
        path = _path(folder, number)
        tensor_shapes(path, origin)
        try:
            with safe_open(path, framework="np") as file:
                about = json.loads((file.metadata() or {})[ABOUT])
            yield _dreamt(number, load_file(path), about)
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise origin.refuse(path.name, f"not a dream ({brief(error)}); remove it") from error


def _dreamt(number: int, tensors: dict[str, np.ndarray], about: dict[str, Any]) -> Dreamt:
    task, seed, decision = about["origin"]
    dream = Dreamt(
        number=number,
        observations={name: t for name, t in tensors.items() if name.startswith(OBSERVATION)},
        actions=tensors["actions"],
        rewards=tensors["rewards"],
        versions=tensors["versions"],
        task=str(about["task"]),
        origin=(str(task), int(seed), int(decision)),
        world_version=int(about["world_version"]),
        success=bool(about["success"]),
        terminated=bool(about["terminated"]),
        truncated=bool(about["truncated"]),
        decisions_per_s=float(about["decisions_per_s"]),
    )
    count = len(dream)
    lengths = {len(dream.actions), len(dream.versions), *(len(t) - 1 for t in dream.observations.values())}
    if count == 0 or lengths != {count} or dream.actions.ndim != 3 or not dream.observations:
        raise ValueError("its parts are of different lengths")
    if not dream.decisions_per_s > 0:
        raise ValueError("it has no pace")
    return dream


def _path(folder: Path, number: int) -> Path:
    return folder / f"{number:08d}.safetensors"


def _numbers(folder: Path) -> Iterator[int]:
    return (int(path.stem) for path in folder.glob("*.safetensors") if path.stem.isdecimal())
