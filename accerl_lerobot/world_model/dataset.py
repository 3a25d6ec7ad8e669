# SPDX-License-Identifier: Apache-2.0
"""A LeRobotDataset as episodes of a world model."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from accerl_lerobot.demos.dataset_files import checked, open_metadata, origin_of
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.contract import WorldModelSpec
from accerl_lerobot.world_model.episodes import Episode
from accerl_lerobot.world_model.frames import resized

if TYPE_CHECKING:
    from accerl_lerobot.config.dataset import DatasetConfig

SUCCESS = "next.success"


def load_episodes(
    dataset: DatasetConfig,
    spec: WorldModelSpec,
    source: str = "demo",
    *,
    both: bool = True,
    only: Sequence[int] | None = None,
) -> list[Episode]:
    """Reads it into memory, one uint8 image per env step and camera.

    Args:
        dataset: on the Hub, or in a folder.
        spec: the cameras, sizes and dims that are wanted; images are shrunk or enlarged to its size.
        source: see `Episode.source`.
        both: whether there must be successes and failures.
        only: indices of the episodes that are wanted; None: all.

    Raises:
        InputError: a camera, the success labels or the rate are not the world's; state or actions are another
            robot's; a single episode; only successes, or only failures.
    """
    meta = open_metadata(dataset)
    check_metadata(meta, dataset.repo_id or "", spec)
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    wanted = range(meta.total_episodes) if only is None else only
    with checked(origin_of(dataset)):
        # The default probes for FFmpeg's libraries, and prints their tracebacks where there are none.
        data = LeRobotDataset(meta.repo_id, root=meta.root, revision=meta.revision, video_backend="pyav")
        episodes = [_episode(data, meta, index, spec, source) for index in wanted]
    remedies = {True: "add episodes that succeed", False: "add failures, see demos.failure_share"}
    for outcome, remedy in remedies.items() if both else ():
        if not any(e.success is outcome for e in episodes):
            why = f"no {'success' if outcome else 'failure'} among {len(episodes)} episodes; {remedy}"
            raise InputError("dataset.repo_id", dataset.repo_id, why)
    return episodes


def fingerprint(meta: Any) -> str:
    """Hash that tells a dataset from others, whatever it is called: how long each of its episodes is, in
    their order, and statistics of its actions."""
    moments = [np.asarray(meta.stats["action"][k], np.float64).round(6).tolist() for k in ("mean", "std")]
    ends = [list(map(int, meta.episodes[f"dataset_{end}_index"])) for end in ("from", "to")]
    said = json.dumps([ends, meta.fps, moments])
    return hashlib.sha256(said.encode()).hexdigest()


def check_metadata(meta: Any, name: str, spec: WorldModelSpec) -> None:
    """Refuses a dataset that a world model of `spec` cannot learn from, before any image is read.

    Raises:
        InputError: see `load_episodes`.
    """

    def refuse(why: str) -> InputError:
        return InputError("dataset.repo_id", name, why)

    for camera in spec.cameras:
        if camera not in meta.features:
            there = ", ".join(meta.camera_keys) or "no camera"
            raise refuse(f"no {camera}: the dataset has {there}; choose env.camera accordingly")
    wanted = {"action": spec.action_dim} | ({"observation.state": spec.state_dim} if spec.state_dim else {})
    for key, size in wanted.items():
        shape = tuple(meta.features[key]["shape"]) if key in meta.features else None
        if shape != (size,):
            raise refuse(f"{key} has shape {shape}, the world's has ({size},): it is another robot's")
    if SUCCESS not in meta.features:
        raise refuse(f"no {SUCCESS}: record it, as accerl demos does, or add it to the dataset")
    if meta.fps != spec.fps:
        why = f"{meta.fps} frames a second, and the world makes {spec.fps} steps"
        raise refuse(f"{why}: its chunks would be other chunks; record at the world's rate")
    if meta.total_episodes < 2:
        raise refuse("a single episode; at least one to learn from and one to be judged on are needed")


def _episode(data: Any, meta: Any, index: int, spec: WorldModelSpec, source: str) -> Episode:
    first, last = (int(meta.episodes[index][f"dataset_{end}_index"]) for end in ("from", "to"))
    items = [data[i] for i in range(first, last)]
    success = np.array([bool(item[SUCCESS]) for item in items])
    state = [item["observation.state"].numpy() if spec.state_dim else np.zeros(0) for item in items]
    shown = [np.stack([_bytes(item[camera]) for item in items]) for camera in spec.cameras]
    actions = np.stack([item["action"].numpy() for item in items])
    if not (np.isfinite(actions).all() and np.isfinite(np.stack(state)).all()):
        raise InputError("dataset.repo_id", meta.repo_id, f"episode {index} has a NaN state or action")
    return Episode(
        frames=np.stack([resized(frames, spec.image_size) for frames in shown], 1),
        times=np.arange(len(items)),
        state=np.stack(state).astype(np.float32),
        actions=actions.astype(np.float32),
        success_at=int(success.argmax()) if success.any() else -1,
        task=str(items[0]["task"]),
        source=source,
    )


def _bytes(image: Any) -> np.ndarray:
    """uint8 (h, w, 3) from LeRobot's float (3, h, w) in [0, 1]."""
    bytes_: np.ndarray = (image * 255).round().clamp(0, 255).byte().permute(1, 2, 0).numpy()
    return bytes_
