# SPDX-License-Identifier: Apache-2.0
"""The episodes of a LeRobotDataset as an off-policy learner remembers them, as if they had been explored."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from accerl_lerobot.config.dataset import DatasetConfig
from accerl_lerobot.experience import REWARD, SUCCESS, Origin, Segment
from accerl_lerobot.policies.config import Load, PolicyConfig

logger = logging.getLogger(__name__)

ROWS, FRAMES = 5000, 20_000
"""Decisions, and env steps, that are read at most; of short datasets, decisions that begin at every step."""


@dataclass(frozen=True)
class WithDemonstrations:
    """Loads a policy whose trainer remembers demonstrations.

    Args:
        load: makes the adapter.
        dataset: the demonstrations.
        decision_cost: see `demonstrations`.
    """

    load: Load
    dataset: DatasetConfig
    decision_cost: float

    def __call__(self, config: PolicyConfig) -> Any:
        """The adapter, with its demonstrations."""
        adapter: Any = self.load(config)
        adapter.demonstrations = partial(demonstrations, self.dataset, self.decision_cost)
        return adapter


def unlike(meta: Any, wanted: dict[str, tuple[int, ...]]) -> str | None:
    """How a dataset's features differ from an environment's names and shapes; None: they do not."""
    for name, shape in wanted.items():
        offered = tuple(meta.features[name]["shape"]) if name in meta.features else None
        if offered != shape:
            return f"the dataset's {name} has shape {offered}, the environment's {shape}"
    return None


def demonstrations(dataset: DatasetConfig, decision_cost: float, like: Segment) -> Iterator[Segment]:
    """Reads whole episodes, each up to ``like.actions.shape[1]`` times: from its first step, its second, ….

    An episode ends with its first ``next.success``; without that feature, all episodes are successes. Rewards
    are ``next.reward``, or 1 for success. A dataset whose observations or actions are not those of the
    environment is not read, which is logged.

    Args:
        dataset: on the Hub or in a folder.
        decision_cost: taken off each decision's reward, as of explored ones.
        like: an explored episode, of which names and shapes are taken.
    """
    from accerl_lerobot.demos.dataset_files import checked, open_metadata, origin_of

    meta = open_metadata(dataset)
    wanted = {name: rows.shape[1:] for name, rows in like.observations.items()}
    wanted["action"] = like.actions.shape[2:]
    if (why := unlike(meta, wanted)) is not None:
        logger.warning("%s does not join the memory: %s", dataset.repo_id, why)
        return
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    chunk = like.actions.shape[1]
    phases = min(chunk, max(1, ROWS * chunk // meta.total_frames))
    share = min(1.0, min(ROWS * chunk, FRAMES) / meta.total_frames)
    episodes = math.ceil(share * meta.total_episodes)
    with checked(origin_of(dataset)):
        data = LeRobotDataset(
            meta.repo_id,
            root=meta.root,
            revision=meta.revision,
            episodes=list(range(episodes)),
            video_backend="pyav",
        )
        for index in range(episodes):
            first, last = (int(meta.episodes[index][f"dataset_{end}_index"]) for end in ("from", "to"))
            frames = [data[i] for i in range(first, last)]
            won = next((i for i, frame in enumerate(frames) if SUCCESS in frame and frame[SUCCESS]), None)
            if won is not None:
                frames = frames[: won + 1]
            success = won is not None or SUCCESS not in meta.features
            for phase in range(min(phases, len(frames))):
                segment = _segment(frames, wanted, phase, chunk, success)
                segment.reward -= np.float32(decision_cost)
                yield segment


def _segment(
    frames: list[Any], wanted: dict[str, tuple[int, ...]], phase: int, chunk: int, success: bool
) -> Segment:
    """The decisions of an episode of those frames, from env step `phase` on."""
    end = len(frames)
    starts = np.arange(phase, end, chunk)
    actions = np.stack([frame["action"].numpy().reshape(wanted["action"]) for frame in frames])
    steps = np.minimum(chunk, end - starts)
    t = len(starts)
    rewards: np.ndarray = np.zeros(end, np.float32)
    rewards[-1] = float(success)
    if REWARD in frames[0]:
        rewards = np.array([float(frame[REWARD]) for frame in frames], np.float32)
    reward = np.add.reduceat(rewards, starts)
    seen = [*starts, end - 1]
    return Segment(
        observations={
            name: np.stack([_array(frames[i][name], shape) for i in seen])
            for name, shape in wanted.items()
            if name != "action"
        },
        task=str(frames[0]["task"]),
        latent={},
        log_prob=np.zeros((t, 0), np.float32),
        value=np.zeros(t, np.float32),
        actions=actions.astype(np.float32)[np.minimum(starts[:, None] + np.arange(chunk), end - 1)],
        reward=reward,
        version=np.zeros(t, np.int64),
        steps=steps,
        terminated=True,
        truncated=False,
        success=success,
        key="demonstration",
        origin=Origin(task="", seed=0, decision=0),
        episode={"return": float(reward.sum()), "decisions": float(t)},
    )


def _array(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """A frame's numbers, uint8 (H, W, C) of an image, as environments give them."""
    if len(shape) < 3:
        return np.asarray(value.numpy(), np.float32).reshape(shape)
    pixels: np.ndarray = (value * 255).round().clamp(0, 255).byte().permute(1, 2, 0).numpy()
    return pixels
