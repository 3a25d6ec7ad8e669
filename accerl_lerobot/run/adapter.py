# SPDX-License-Identifier: Apache-2.0
"""The policy's adapter of a run or of ``accerl offline``, and the demonstrations that an off-policy learner
remembers: the episodes of a LeRobotDataset, as if they had been explored.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from accerl_lerobot.algorithms import AlgorithmConfig, ChunkCriticConfig, OffPolicyConfig
from accerl_lerobot.checkpoint.layout import DEMOS
from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.demos.dataset_files import numbers, observations, open_metadata, opened, read_labels
from accerl_lerobot.demos.record import REPO_ID
from accerl_lerobot.experience import Segment, SegmentStart
from accerl_lerobot.policies.config import Load, PolicyConfig, loader
from accerl_lerobot.policies.features import Shapes, dataset_shapes
from accerl_lerobot.world_model.config import StateModelConfig

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import RunConfig

logger = logging.getLogger(__name__)

ROWS, FRAMES = 5000, 20_000
"""Decisions, and env steps, that are read at most; of short datasets, decisions that begin at every step."""

Reader = Callable[[Segment], Iterator[Segment]]
"""Reads demonstrations with the names and shapes of an explored segment, see `demonstrations`."""


def make_adapter(
    algorithm: AlgorithmConfig,
    state_model: StateModelConfig,
    policy: PolicyConfig,
    *,
    environment_state: int,
    remembered: Reader | None,
    load: Load | None,
) -> Any:
    """The adapter of a policy, with the teacher and the demonstrations that the algorithm learns from.

    `environment_state` is the number of numbers that the simulator tells; `remembered` is `demonstrations_of`
    the run; `load` loads the policy, None: a LeRobot checkpoint.
    """
    if isinstance(algorithm, ChunkCriticConfig):
        from accerl_lerobot.policies.teacher import with_teacher

        adapter: Any = with_teacher(loader(load), state_model, environment_state, policy)
    else:
        adapter = loader(load)(policy)
    if remembered is not None:
        adapter.demonstrations = remembered
    return adapter


def demonstrations_of(config: RunConfig) -> Reader | None:
    """The dataset that the run was given, or has recorded; None without one, or if nothing remembers it."""
    if not isinstance(config.algorithm, OffPolicyConfig):
        return None
    dataset = config.dataset
    root = dataset.root
    if dataset.repo_id is None:
        if config.folder is None or not (config.folder / DEMOS).is_dir():
            return None
        dataset = replace(dataset, repo_id=REPO_ID)
        root = str(config.folder / DEMOS)
    elif root is not None:
        root = str(Path(root).expanduser().absolute())
    return partial(demonstrations, replace(dataset, root=root), config.rollout.decision_cost)


def unlike(meta: Any, wanted: Shapes) -> str | None:
    """How a dataset's features differ from an environment's names and shapes; None: they do not."""
    shapes = dataset_shapes(meta)
    for name, shape in wanted.items():
        if name not in shapes:
            return f"the dataset has no {name}"
        offered = shapes[name]
        if len(offered) == 3:
            offered = offered[1:] + offered[:1]  # environments have (height, width, channels)
        if offered != shape:
            return f"the dataset's {name} has shape {offered}, the environment's {shape}"
    return None


def demonstrations(dataset: DatasetConfig, decision_cost: float, like: Segment) -> Iterator[Segment]:
    """Reads whole episodes, each up to ``like.actions.shape[1]`` times: from its first step, its second, ….

    Rewards are ``next.reward``, or 1 for success, less `decision_cost` for each decision. An episode ends
    with its success; one without labels is a success as a whole. Names and shapes are those of `like`, an
    explored episode; a dataset of others is not read, which is logged.
    """
    meta = open_metadata(dataset)
    wanted = {name: rows.shape[1:] for name, rows in like.observations.items()}
    wanted["action"] = like.actions.shape[2:]
    if (why := unlike(meta, wanted)) is not None:
        logger.warning("%s does not join the memory: %s", dataset.repo_id, why)
        return
    chunk = like.actions.shape[1]
    most = min(ROWS, FRAMES // chunk)
    yield from recorded(dataset, meta, wanted, chunk, most, ROWS, like.time_limit, decision_cost)


def recorded(
    dataset: DatasetConfig,
    meta: Any,
    wanted: Shapes,
    chunk: int,
    most: int,
    enough: int,
    time_limit: int,
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
        images: list[str] = []
        vectors: dict[str, np.ndarray] = {}
        for name, shape in wanted.items():
            if len(shape) > 2:
                images.append(name)
            else:
                vectors[name] = numbers(data, name, dataset).astype(np.float32)
        for episode in read_labels(data, dataset):
            success = episode.success or episode.success_at is None
            end = len(episode.rows)
            if episode.success_at is not None and episode.success_at >= 0:
                end = episode.success_at + 1
            rewards = episode.rewards
            if rewards is None:
                rewards = np.zeros(end, np.float32)
                rewards[-1] = success
            columns = observations(data, episode.rows[:end], vectors, images)
            actions = columns.pop("action")
            for phase in range(min(phases, end)):
                starts = np.arange(phase, end, chunk)
                seen = [*starts, end - 1]
                executed = starts[:, None] + np.arange(chunk)
                t = len(starts)
                reward = np.add.reduceat(rewards[:end], starts)
                yield Segment(
                    observations={name: rows[seen] for name, rows in columns.items()},
                    task=episode.tasks[0],
                    latent={},
                    log_prob=np.zeros((t, 0), np.float32),
                    actions=actions[np.minimum(executed, end - 1)],
                    reward=reward - np.float32(decision_cost),
                    version=np.zeros(t, np.int64),
                    steps=np.minimum(chunk, end - starts),
                    before=phase,
                    time_limit=time_limit,
                    terminated=True,
                    success=success,
                    key="demonstration",
                    origin=SegmentStart(task="", seed=episode.index, decision=0),
                )
