# SPDX-License-Identifier: Apache-2.0
"""Small LeRobotDatasets, written by LeRobot, that fit ``env.type=simulated``, and changes of their files."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from accerl_lerobot.config.ranges import DatasetConfig

FPS, STEPS, TASK = 80, 6, "Match the target"
FRONT, STATE, ACTION = "observation.images.front", "observation.state", "action"
IMAGE = {"dtype": "image", "shape": (32, 32, 3), "names": ["height", "width", "channels"]}
FEATURES: dict[str, dict[str, Any]] = {
    STATE: {"dtype": "float32", "shape": (4,), "names": None},
    ACTION: {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
}


def labels(dtype: str = "bool") -> dict[str, Any]:
    """The feature of one label."""
    return {"dtype": dtype, "shape": (1,), "names": None}


def write_dataset(
    root: Path,
    tasks: Sequence[str | Sequence[str]] = (TASK, TASK),
    more: dict[str, dict[str, Any]] | None = None,
    values: Callable[[str, int, int], Any] = lambda name, episode, step: None,
    without: Sequence[str] = (),
    fps: int = FPS,
) -> DatasetConfig:
    """One episode of `STEPS` frames for each of `tasks`, which may be one text or a text for each step.

    `more` are further features, `values` gives those that are not random.
    """
    features = {name: f for name, f in FEATURES.items() if name not in without} | (more or {})
    dataset = LeRobotDataset.create(
        "a/b", fps=fps, features=features, root=root, use_videos=False, video_backend="pyav"
    )
    rng = np.random.default_rng(0)
    for episode, task in enumerate(tasks):
        for step in range(STEPS):
            frame: dict[str, Any] = {"task": task if isinstance(task, str) else task[step]}
            for name, feature in features.items():
                value = values(name, episode, step)
                if value is None and feature["dtype"] in ("image", "video"):
                    value = rng.integers(0, 256, feature["shape"], np.uint8)
                elif value is None:
                    value = rng.uniform(-0.9, 0.9, feature["shape"])
                frame[name] = value if isinstance(value, str) else np.asarray(value, kind(feature))
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    return DatasetConfig(repo_id="a/b", root=str(root))


def kind(feature: dict[str, Any]) -> Any:
    """The NumPy type of a feature's values."""
    depth = (feature.get("info") or {}).get("is_depth_map")
    if feature["dtype"] in ("image", "video"):
        return np.uint16 if depth else np.uint8
    return np.dtype(feature["dtype"])


def rewrite(path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    """Replaces a parquet file by a change of it."""
    with pq.ParquetFile(path) as file:
        table = file.read()
    pq.write_table(change(table), path)


def edit_json(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Changes a JSON file in place."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def write_old(new: Path, root: Path) -> Path:
    """A dataset in the layout of LeRobot's format v2.1, from one of format v3.0 without videos."""
    info = json.loads((new / "meta/info.json").read_text())
    stats = json.loads((new / "meta/stats.json").read_text())
    info |= {
        "codebase_version": "v2.1",
        "total_chunks": 1,
        "total_videos": 0,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    }
    data = LeRobotDataset("a/b", root=new, video_backend="pyav")
    with pq.ParquetFile(new / "data/chunk-000/file-000.parquet") as file:
        table = file.read()
    (root / "meta").mkdir(parents=True)
    (root / "data/chunk-000").mkdir(parents=True)
    (root / "meta/info.json").write_text(json.dumps(info))
    tasks = [{"task_index": i, "task": text} for i, text in enumerate(data.meta.tasks.index)]
    episodes, statistics = [], []
    for index, episode in enumerate(data.meta.episodes):
        first, last = episode["dataset_from_index"], episode["dataset_to_index"]
        part = table.slice(first, last - first)
        pq.write_table(part, root / f"data/chunk-000/episode_{index:06d}.parquet")
        episodes.append({"episode_index": index, "tasks": episode["tasks"], "length": last - first})
        statistics.append({"episode_index": index, "stats": stats})
    for name, rows in (("tasks", tasks), ("episodes", episodes), ("episodes_stats", statistics)):
        lines = "".join(f"{json.dumps(row)}\n" for row in rows)
        (root / f"meta/{name}.jsonl").write_text(lines)
    return root
