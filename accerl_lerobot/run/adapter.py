# SPDX-License-Identifier: Apache-2.0
"""The policy's adapter of a run or of ``accerl offline``, and the demonstrations that an off-policy learner
remembers: the episodes of a LeRobotDataset, as if they had been explored.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
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

SUCCESS_ALONE = "success"
"""``env.reward`` of environments that pay 1 for success, and of those that have no other reward."""

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


def demonstrations_of(config: RunConfig, instructions: tuple[str, ...]) -> Reader | None:
    """The dataset that the run was given, or has recorded; None without one, or if nothing remembers it.

    `instructions` are the texts of the environment's tasks; empty: it has none.
    """
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
    return partial(
        demonstrations,
        replace(dataset, root=root),
        instructions=instructions,
        reward=getattr(config.env, "reward", SUCCESS_ALONE),
        decision_cost=config.rollout.decision_cost,
    )


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


def demonstrations(
    dataset: DatasetConfig, like: Segment, *, instructions: tuple[str, ...], reward: str, decision_cost: float
) -> Iterator[Segment]:
    """Reads whole episodes, each up to ``like.actions.shape[1]`` times: from its first step, its second, ….

    Names and shapes are those of `like`, an explored episode; a dataset of others is not read, which is
    logged. Episodes of other `instructions` are left out; without any, all are of the task of `like`. For
    `reward` see `recorded`.
    """
    meta = open_metadata(dataset)
    wanted = {name: rows.shape[1:] for name, rows in like.observations.items()}
    wanted["action"] = like.actions.shape[2:]
    if (why := unlike(meta, wanted)) is not None:
        logger.warning("%s does not join the memory: %s", dataset.repo_id, why)
        return
    chunk = like.actions.shape[1]
    most = min(ROWS, FRAMES // chunk)
    episodes, phases = some_of_each_task(meta, chunk, most, ROWS, instructions)
    if len(episodes) < meta.total_episodes:
        why = f"the others are of other tasks, or more than {most} decisions"
        logger.warning("%d of %d demonstrations join the memory: %s", len(episodes), meta.total_episodes, why)
    if not episodes:
        return
    for segment in recorded(
        dataset, meta, wanted, chunk, episodes, like.time_limit, phases, reward, decision_cost
    ):
        if not instructions:
            segment = replace(segment, task=like.task)
        yield segment


def some_of_each_task(
    meta: Any, chunk: int, most: int, enough: int, instructions: tuple[str, ...] = ()
) -> tuple[list[int], int]:
    """Indices of the episodes to be read, and `phases` for `recorded`.

    The episodes are whole ones of some `most` decisions in all, the same share of each task's. A short
    dataset is read in several phases, up to `enough` decisions. Without `instructions` all tasks count.
    """
    by_task: dict[str, list[int]] = {}
    for episode, texts in enumerate(meta.episodes["tasks"]):
        if not instructions or texts[0] in instructions:
            by_task.setdefault(texts[0], []).append(episode)
    lengths = meta.episodes["length"]
    frames = max(1, sum(sum(lengths[episode] for episode in episodes) for episodes in by_task.values()))
    share = min(1.0, most * chunk / frames)
    chosen: list[int] = []
    for episodes in by_task.values():
        chosen += episodes[: math.ceil(share * len(episodes))]
    return sorted(chosen), min(chunk, max(1, enough * chunk // frames))


def recorded(
    dataset: DatasetConfig,
    meta: Any,
    wanted: Shapes,
    chunk: int,
    episodes: Sequence[int],
    time_limit: int,
    phases: int = 1,
    reward: str = "",
    decision_cost: float = 0.0,
) -> Iterator[Segment]:
    """Reads whole episodes of a dataset, in decisions of `chunk` env steps.

    `wanted` are the shapes of the observations that are read and of ``action``, by name. Each episode is read
    from its first step on, then from its second, …, so many `phases`.

    Rewards are ``next.reward``, or 1 for success where `reward` is `SUCCESS_ALONE` or the dataset has none,
    less `decision_cost` for each decision. An episode ends with its success, unless the run's environment has
    another reward; one without labels is a success as a whole.
    """
    with opened(dataset, meta, episodes) as data:
        images: list[str] = []
        vectors: dict[str, np.ndarray] = {}
        for name, shape in wanted.items():
            if len(shape) > 2:
                images.append(name)
            else:
                vectors[name] = numbers(data, name, dataset).astype(np.float32)
        for episode in read_labels(data, dataset):
            success_at = episode.success_at
            success = episode.success or success_at is None
            end = len(episode.rows)
            if success_at is not None and success_at >= 0 and reward in ("", SUCCESS_ALONE):
                end = success_at + 1
            rewards = episode.rewards
            if rewards is None or (success_at is not None and reward == SUCCESS_ALONE):
                rewards = np.zeros(end, np.float32)
                rewards[-1] = success
            columns = observations(data, episode.rows[:end], vectors, images)
            actions = columns.pop("action")
            for phase in range(min(phases, end)):
                starts = np.arange(phase, end, chunk)
                seen = [*starts, end - 1]
                executed = starts[:, None] + np.arange(chunk)
                t = len(starts)
                summed = np.add.reduceat(rewards[:end], starts)
                yield Segment(
                    observations={name: rows[seen] for name, rows in columns.items()},
                    task=episode.tasks[0],
                    latent={},
                    log_prob=np.zeros((t, 0), np.float32),
                    actions=actions[np.minimum(executed, end - 1)],
                    reward=summed - np.float32(decision_cost),
                    version=np.zeros(t, np.int64),
                    steps=np.minimum(chunk, end - starts),
                    before=phase,
                    time_limit=time_limit,
                    terminated=True,
                    success=success,
                    key="demonstration",
                    origin=SegmentStart(task="", seed=episode.index, decision=0),
                )
