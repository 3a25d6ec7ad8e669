# SPDX-License-Identifier: Apache-2.0
"""Imagined rollouts on disk, and as a LeRobotDataset.

    accerl train … --imagination.record=1000
    accerl export --source=imagined --path=RUN --root=outputs/imagined

``RUN/imagined/`` has one safetensors file for each of the newest, named by its number. A resumed run
overwrites those that were imagined after its checkpoint.

In the dataset there is one frame per decision, with the observation that the policy got, and as action the
whole chunk, K·A numbers. The first frame of an episode is real, the others are imagined; the observation
after the last decision has no action and is left out, as in datasets of real episodes. Frame rate and action
differ from those of real episodes, so the two are not mixed by mistake.
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
from accerl_lerobot.console import Console
from accerl_lerobot.demos.writing import new_dataset
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Segment

FOLDER = "imagined"
"""Folder of a run."""
METADATA = "rollout"
"""Key of the JSON in a file's metadata."""
OBSERVATION = "observation."
"""Prefix of observations in LeRobot's names."""
POLICY_VERSION, WORLD_VERSION = "policy_version", "world_model_version"
"""Features: updates of the policy; gradient steps of the world model in the run."""
IMAGINED, DEPTH = "imagined", "imagined_depth"
"""Features: True if the frame was imagined; imagined decisions before it."""
ORIGIN_SEED, ORIGIN_DECISION = "origin_seed", "origin_decision"
"""Features: the real episode that the rollout starts in, and the decisions before."""
_NUMBERS = (POLICY_VERSION, WORLD_VERSION, DEPTH, ORIGIN_SEED, ORIGIN_DECISION)


@dataclass(frozen=True, kw_only=True)
class ImaginedEpisode:
    """A recorded rollout of T decisions, K actions each."""

    number: int
    observations: dict[str, np.ndarray]
    """Each (T + 1, ...) under LeRobot's names; the first is real, the others are imagined."""
    actions: np.ndarray
    """float32 (T, K, A)."""
    rewards: np.ndarray
    """float32 (T,), less costs."""
    versions: np.ndarray
    """int64 (T,), of the policy."""
    task: str
    """The instruction."""
    origin: tuple[str, int, int]
    """Task and seed of the real episode it starts in, and decisions before."""
    world_version: int
    """Gradient steps of the world model in the run."""
    success: bool
    terminated: bool
    truncated: bool
    decisions_per_s: float
    """In simulated time."""

    def __len__(self) -> int:
        return len(self.rewards)


class Recorder:
    """Keeps the newest rollouts.

    Args:
        folder: is made; files in it stay until they are too old.
        most: rollouts that are kept, at least 1.
        decisions_per_s: in simulated time.
    """

    def __init__(self, folder: Path, most: int, decisions_per_s: float) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._most, self._pace = folder, most, decisions_per_s
        self._kept = deque(sorted(_numbers(folder)))

    def write(self, segment: Segment) -> None:
        """Records an imagined segment."""
        number = int(segment.key.rsplit(".", 1)[1])
        while self._kept and self._kept[-1] >= number:  # imagined after the checkpoint that was resumed
            self._remove(self._kept.pop())
        while len(self._kept) >= self._most:
            self._remove(self._kept.popleft())
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
        contiguous = {name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}
        save_file(contiguous, new, metadata={METADATA: json.dumps(about)})
        os.replace(new, path)
        self._kept.append(number)

    def _remove(self, number: int) -> None:
        _path(self._folder, number).unlink(missing_ok=True)


def read_imagined(folder: Path, field: str = "path") -> Iterator[ImaginedEpisode]:
    """Reads recorded rollouts, in order; errors name `field`.

    Raises:
        InputError: there is none, or a file is broken.
    """
    numbers = sorted(_numbers(folder)) if folder.is_dir() else []
    if not numbers:
        remedy = "no imagined rollout was recorded: run it with --imagination.record=1000, say"
        raise InputError(field, str(folder.parent), remedy)
    origin = Origin(field, str(folder))
    for number in numbers:
        path = _path(folder, number)
        tensor_shapes(path, origin)
        try:
            with safe_open(path, framework="np") as file:
                about = json.loads((file.metadata() or {})[METADATA])
            yield _episode(number, load_file(path), about)
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise origin.refuse(path.name, f"not an imagined rollout ({brief(error)}); remove it") from error


def _episode(number: int, tensors: dict[str, np.ndarray], about: dict[str, Any]) -> ImaginedEpisode:
    task, seed, decision = about["origin"]
    episode = ImaginedEpisode(
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
    count = len(episode)
    observed = {len(t) - 1 for t in episode.observations.values()}
    lengths = {len(episode.actions), len(episode.versions), *observed}
    if count == 0 or lengths != {count} or episode.actions.ndim != 3 or not observed:
        raise ValueError("its parts are of different lengths")
    if not episode.decisions_per_s > 0:
        raise ValueError("it has no rate")
    return episode


def _path(folder: Path, number: int) -> Path:
    return folder / f"{number:08d}.safetensors"


def _numbers(folder: Path) -> Iterator[int]:
    return (int(path.stem) for path in folder.glob("*.safetensors") if path.stem.isdecimal())


# As a LeRobotDataset.


def write_dataset(
    episodes: list[ImaginedEpisode], root: Path, repo_id: str, robot_type: str, console: Console
) -> dict[str, Any]:
    """Writes at least one rollout as a dataset.

    Returns:
        ``episodes``, ``frames``, ``successes``, ``decisions_per_s``, ``actions_per_frame``.

    Raises:
        InputError: they are not of one environment.
    """
    first = episodes[0]
    table, fps = features(first), max(1, round(first.decisions_per_s))
    tally = {"episodes": 0, "frames": 0, "successes": 0}
    with (
        console.stage("writing imagined rollouts", total=len(episodes)) as stage,
        new_dataset(root, repo_id, fps, robot_type, table) as dataset,
    ):
        for number, episode in enumerate(episodes, start=1):
            if features(episode) != table or episode.decisions_per_s != first.decisions_per_s:
                remedy = f"rollout {episode.number} is of another world than {first.number}; remove one"
                raise InputError("path", str(root), remedy)
            for frame in frames(episode):
                dataset.add_frame(frame)
            dataset.save_episode()
            tally["episodes"] += 1
            tally["frames"] += len(episode)
            tally["successes"] += episode.success
            stage.update(number, f"{tally['successes']} successes")
    if fps != first.decisions_per_s:
        console.say(f"{first.decisions_per_s:g} decisions a second, recorded in the dataset as {fps}")
    pace = {"decisions_per_s": first.decisions_per_s, "actions_per_frame": first.actions.shape[1]}
    return tally | pace


def features(episode: ImaginedEpisode) -> dict[str, dict[str, Any]]:
    """LeRobot's feature table."""
    table: dict[str, dict[str, Any]] = {}
    for key, rows in episode.observations.items():
        if rows.dtype == np.uint8 and rows.ndim == 4:
            names = ["height", "width", "channels"]
            table[key] = {"dtype": "image", "shape": rows.shape[1:], "names": names}
        else:
            table[key] = _vector(rows[0].size, "state")
    _, chunk, size = episode.actions.shape
    table["action"] = _vector(chunk * size, "action")
    table["action"]["names"] = [f"action_{k}_{i}" for k in range(chunk) for i in range(size)]
    table["next.reward"] = {"dtype": "float32", "shape": (1,), "names": None}
    for key in ("next.done", "next.success", IMAGINED):
        table[key] = {"dtype": "bool", "shape": (1,), "names": None}
    return table | {key: {"dtype": "int64", "shape": (1,), "names": None} for key in _NUMBERS}


def frames(episode: ImaginedEpisode) -> Iterator[dict[str, Any]]:
    """Rows for ``LeRobotDataset.add_frame``."""
    _, seed, decision = episode.origin
    for t in range(len(episode)):
        last = t == len(episode) - 1
        numbers = (int(episode.versions[t]), episode.world_version, t, seed, decision)
        yield {
            **{key: rows[t] for key, rows in episode.observations.items()},
            "action": episode.actions[t].reshape(-1),
            "next.reward": episode.rewards[t : t + 1],
            "next.done": np.array([last and (episode.terminated or episode.truncated)]),
            "next.success": np.array([last and episode.success]),
            IMAGINED: np.array([t > 0]),
            **{key: np.array([n], np.int64) for key, n in zip(_NUMBERS, numbers, strict=True)},
            "task": episode.task,
        }


def _vector(size: int, name: str) -> dict[str, Any]:
    return {"dtype": "float32", "shape": (size,), "names": [f"{name}_{i}" for i in range(size)]}
