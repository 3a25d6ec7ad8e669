# SPDX-License-Identifier: Apache-2.0
"""The episodes of a LeRobotDataset as an off-policy learner remembers them, as if they had been explored."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from accerl_lerobot.config.dataset import DatasetConfig
from accerl_lerobot.experience import SUCCESS, Origin, Segment
from accerl_lerobot.policies.config import Load, PolicyConfig

logger = logging.getLogger(__name__)

ROWS = 5000
"""Decisions that are read at most; of short datasets, those that begin at every env step."""


@dataclass(frozen=True)
class WithDemonstrations:
    """Loads a policy whose trainer remembers demonstrations.

    Args:
        load: makes the adapter.
        dataset: the demonstrations.
    """

    load: Load
    dataset: DatasetConfig

    def __call__(self, config: PolicyConfig) -> Any:
        """The adapter, with its demonstrations."""
        adapter: Any = self.load(config)
        adapter.demonstrations = self.dataset
        return adapter


def demonstrations(dataset: DatasetConfig, like: Segment) -> Iterator[Segment]:
    """Reads whole episodes, each up to ``like.actions.shape[1]`` times: from its first step, its second, ….

    An episode ends with its first ``next.success``; without that feature, all episodes are successes. A
    dataset whose observations or actions are not those of the environment is not read, which is logged.

    Args:
        dataset: on the Hub or in a folder.
        like: an explored episode, of which names and shapes are taken.
    """
    from accerl_lerobot.demos.dataset_files import checked, open_metadata, origin_of

    meta = open_metadata(dataset)
    wanted = {name: rows.shape[1:] for name, rows in like.observations.items()}
    wanted["action"] = like.actions.shape[2:]
    for name, shape in wanted.items():
        offered = tuple(meta.features[name]["shape"]) if name in meta.features else None
        if offered != shape:
            why = f"the dataset's {name} has shape {offered}, the environment's {shape}"
            logger.warning("%s does not join the memory: %s", dataset.repo_id, why)
            return
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    chunk = like.actions.shape[1]
    phases = min(chunk, max(1, ROWS * chunk // meta.total_frames))
    episodes = min(meta.total_episodes, math.ceil(ROWS * chunk / meta.total_frames * meta.total_episodes))
    with checked(origin_of(dataset)):
        data = LeRobotDataset(meta.repo_id, root=meta.root, revision=meta.revision, video_backend="pyav")
        for index in range(episodes):
            first, last = (int(meta.episodes[index][f"dataset_{end}_index"]) for end in ("from", "to"))
            frames = [data[i] for i in range(first, last)]
            for phase in range(min(phases, len(frames))):
                yield _segment(frames, wanted, phase, chunk)


def _segment(frames: list[Any], wanted: dict[str, Any], phase: int, chunk: int) -> Segment:
    """The decisions of an episode from env step `phase` on."""
    won = [
        bool(frame[SUCCESS]) if SUCCESS in frame else i + 1 == len(frames) for i, frame in enumerate(frames)
    ]
    success = any(won[phase:])
    end = won.index(True, phase) + 1 if success else len(frames)
    starts = np.arange(phase, end, chunk)
    actions = np.stack([frame["action"].numpy() for frame in frames]).astype(np.float32)
    steps = np.minimum(chunk, end - starts)
    t = len(starts)
    reward = np.zeros(t, np.float32)
    reward[-1] = float(success)
    seen = [*starts, end - 1]
    return Segment(
        observations={
            name: np.stack([_array(frames[i][name], len(shape) == 3) for i in seen])
            for name, shape in wanted.items()
            if name != "action"
        },
        task=str(frames[0]["task"]),
        latent={},
        log_prob=np.zeros((t, 0), np.float32),
        value=np.zeros(t, np.float32),
        actions=actions[np.minimum(starts[:, None] + np.arange(chunk), end - 1)],
        reward=reward,
        version=np.zeros(t, np.int64),
        steps=steps,
        terminated=True,
        truncated=False,
        success=success,
        key="demonstration",
        origin=Origin(task="", seed=0, decision=0),
        episode={"return": float(success), "decisions": float(t)},
    )


def _array(value: Any, image: bool) -> np.ndarray:
    """A frame's numbers, uint8 (H, W, C) of an image, as environments give them."""
    if not image:
        return np.asarray(value.numpy(), np.float32)
    pixels: np.ndarray = (value * 255).round().clamp(0, 255).byte().permute(1, 2, 0).numpy()
    return pixels
