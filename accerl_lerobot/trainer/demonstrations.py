# SPDX-License-Identifier: Apache-2.0
"""The episodes of a LeRobotDataset as an off-policy learner remembers them, as if they had been explored."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.demos.dataset_files import frames_of, open_metadata, opened, pixels_of
from accerl_lerobot.experience import REWARD, SUCCESS, Origin, Segment
from accerl_lerobot.policies.config import Load, PolicyConfig

logger = logging.getLogger(__name__)

ROWS, FRAMES = 5000, 20_000
"""Decisions, and env steps, that are read at most; of short datasets, decisions that begin at every step."""


def with_demonstrations(
    load: Load, dataset: DatasetConfig, decision_cost: float, config: PolicyConfig
) -> Any:
    """Loads a policy whose trainer remembers demonstrations."""
    adapter: Any = load(config)
    adapter.demonstrations = partial(demonstrations, dataset, decision_cost)
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

    Rewards are ``next.reward``, or 1 for success, less `decision_cost` for each decision; ends and success
    are those of `_episode`. Names and shapes are those of `like`, an explored episode; a dataset of others is
    not read, which is logged.
    """
    meta = open_metadata(dataset)
    wanted = {name: rows.shape[1:] for name, rows in like.observations.items()}
    wanted["action"] = like.actions.shape[2:]
    if (why := unlike(meta, wanted)) is not None:
        logger.warning("%s does not join the memory: %s", dataset.repo_id, why)
        return
    chunk = like.actions.shape[1]
    yield from recorded(dataset, meta, wanted, chunk, min(ROWS, FRAMES // chunk), ROWS, decision_cost)


def recorded(
    dataset: DatasetConfig,
    meta: Any,
    wanted: dict[str, tuple[int, ...]],
    chunk: int,
    most: int,
    enough: int,
    decision_cost: float = 0.0,
) -> Iterator[Segment]:
    """Reads whole episodes as `demonstrations` does, in decisions of `chunk` env steps.

    `wanted` are the shapes of the observations that are read and of ``action``, by name. `most` decisions are
    of one reading of the dataset; it is read again, from second steps on, …, up to `enough` in all.
    """
    phases = min(chunk, max(1, enough * chunk // meta.total_frames))
    share = min(1.0, most * chunk / meta.total_frames)
    episodes = range(math.ceil(share * meta.total_episodes))
    with opened(dataset, meta, episodes) as data:
        for index in episodes:
            columns, rewards, success, task = _episode(frames_of(data, index), wanted)
            end, actions = len(rewards), columns.pop("action")
            for phase in range(min(phases, end)):
                starts = np.arange(phase, end, chunk)
                t, reward = len(starts), np.add.reduceat(rewards, starts)
                yield Segment(
                    observations={name: rows[[*starts, end - 1]] for name, rows in columns.items()},
                    task=task,
                    latent={},
                    log_prob=np.zeros((t, 0), np.float32),
                    actions=actions[np.minimum(starts[:, None] + np.arange(chunk), end - 1)],
                    reward=reward - np.float32(decision_cost),
                    version=np.zeros(t, np.int64),
                    steps=np.minimum(chunk, end - starts),
                    terminated=True,
                    success=success,
                    key="demonstration",
                    origin=Origin(task="", seed=index, decision=0),
                )


def _episode(
    frames: Iterator[dict[str, Any]], wanted: dict[str, tuple[int, ...]]
) -> tuple[dict[str, np.ndarray], np.ndarray, bool, str]:
    """Observations and actions, each (T, ...), and rewards (T,) of an episode; its success, and its task.

    It ends with the first ``next.success``, unless its first frame has that already: then all of them are
    labelled, and it ends with the last one. Without the feature a reward above 0 is success, and without
    rewards too each episode is one.
    """
    rows: list[dict[str, np.ndarray]] = []
    rewards: list[float] = []
    labelled = False
    for frame in frames:
        rows.append({name: _numbers(frame[name], shape) for name, shape in wanted.items()})
        rewards.append(float(frame.get(REWARD, 0.0)))
        task, success = str(frame["task"]), bool(frame.get(SUCCESS, False))
        labelled |= success and len(rows) == 1
        if success and not labelled:
            break
    if SUCCESS not in frame:
        success = REWARD not in frame or max(rewards) > 0
    if REWARD not in frame:
        rewards[-1] = float(success)
    columns = {name: np.stack([row[name] for row in rows]) for name in wanted}
    return columns, np.array(rewards, np.float32), success, task


def _numbers(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    return pixels_of(value) if len(shape) > 2 else np.asarray(value.numpy(), np.float32).reshape(shape)
