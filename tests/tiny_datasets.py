# SPDX-License-Identifier: Apache-2.0
"""Small LeRobotDatasets that fit ``env.type=simulated``, and changes of their files."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.demos import record
from accerl_lerobot.envs import EnvConfig, make_environment

FPS, STEPS, TASK = 80, 6, "Match the target"
FRONT, STATE, ACTION = "observation.images.front", "observation.state", "action"
IMAGE = {"dtype": "image", "shape": (32, 32, 3), "names": ["height", "width", "channels"]}
FEATURES: dict[str, dict[str, Any]] = {
    STATE: {"dtype": "float32", "shape": (4,), "names": None},
    ACTION: {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
}


def labels(dtype: str = "bool") -> dict[str, Any]:
    return {"dtype": dtype, "shape": (1,), "names": None}


def write_dataset(
    root: Path,
    tasks: Sequence[str | Sequence[str]] = (TASK, TASK),
    more: dict[str, dict[str, Any]] | None = None,
    values: Callable[[str, int, int], Any] = lambda name, episode, step: None,
    without: Sequence[str] = (),
    fps: int = FPS,
    **options: Any,
) -> DatasetConfig:
    """One episode of `STEPS` frames for each of `tasks`, which may be one text or a text for each step.

    `more` are further features, `values` gives those that are not random; `options` are LeRobot's.
    """
    features = {name: f for name, f in FEATURES.items() if name not in without} | (more or {})
    videos = any(feature["dtype"] == "video" for feature in features.values())
    dataset = LeRobotDataset.create(
        "a/b", fps=fps, features=features, root=root, use_videos=videos, video_backend="pyav", **options
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
    if feature["dtype"] in ("image", "video"):
        return np.uint16 if (feature.get("info") or {}).get("is_depth_map") else np.uint8
    return np.dtype(feature["dtype"])


def rewrite(path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    with pq.ParquetFile(path) as file:
        table = file.read()
    pq.write_table(change(table), path)


@contextmanager
def one_process() -> Iterator[None]:
    """Episodes are played in this process, not in new ones that first import everything."""

    with pytest.MonkeyPatch.context() as patch:

        @contextmanager
        def pool(*_: Any, initargs: tuple[EnvConfig], **options: Any) -> Iterator[Any]:
            with closing(make_environment(*initargs)) as environment:
                patch.setattr(record, "_environment", environment, raising=False)
                yield SimpleNamespace(
                    submit=lambda work, *given: SimpleNamespace(result=lambda: work(*given))
                )

        patch.setattr(record, "ProcessPoolExecutor", pool)
        yield


def record_dataset(
    root: Path, env: EnvConfig, episodes: int, failure_share: float = 0.0, seed: int = 0
) -> DatasetConfig:
    """Demonstrations as ``accerl demos`` records them, but in this process."""
    config = record.DemosConfig(episodes=episodes, failure_share=failure_share)
    with one_process():
        record.record_demos(env, config, str(root), seed=seed)
    return DatasetConfig(repo_id="a/b", root=str(root))
