# SPDX-License-Identifier: Apache-2.0
"""Labels, instructions and columns of a dataset's episodes, which all verbs read in this way.

Rows are found by ``episode_index`` and ``frame_index``, an instruction by ``task_index``. `docs/recorded.md`
says when an episode counts as a success.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from accerl_lerobot.demos.dataset_files import origin_of, task_texts
from accerl_lerobot.experience import REWARD, SUCCESS

if TYPE_CHECKING:
    from accerl_lerobot.config.ranges import DatasetConfig

LABEL = f"label the episodes with {SUCCESS}, as the page about recorded episodes shows"


@dataclass(frozen=True, kw_only=True)
class EpisodeLabels:
    """Rows of an episode in the order of time, and its labels; T env steps."""

    index: int  # its number in the dataset
    rows: np.ndarray  # int64 (T,), places in the loaded dataset
    tasks: tuple[str, ...]  # its instructions, in the order in which they first appear
    rewards: np.ndarray | None  # float32 (T,); None: the dataset has none
    success_at: int | None  # index of the step that achieved the task; -1 for never; None: not labelled

    @property
    def success(self) -> bool:
        """True if the episode is labelled as a success."""
        return self.success_at is not None and self.success_at >= 0


def read_labels(data: Any, dataset: DatasetConfig, one_task: bool = True) -> list[EpisodeLabels]:
    """The labels of the loaded episodes, in the order of their indices.

    With `one_task`, an episode whose instruction changes is refused.
    """
    origin, texts = origin_of(dataset), task_texts(data.meta)
    read = ("episode_index", "frame_index", "task_index", REWARD, SUCCESS)
    columns = {name: numbers(data, name, dataset) for name in read if name in data.meta.features}
    episode = columns["episode_index"]
    order = np.lexsort((columns["frame_index"], episode))
    ends = np.flatnonzero(np.diff(episode[order])) + 1
    found = []
    for rows in np.split(order, ends):
        own = {name: values[rows] for name, values in columns.items()}
        index = int(episode[rows[0]])
        tasks = tuple(texts[number] for number in dict.fromkeys(own["task_index"].tolist()))
        if one_task and len(tasks) > 1:
            hint = f"its instruction changes from {tasks[0]!r} to {tasks[1]!r}, and one is read here"
            raise origin.refuse(f"episode {index}", f"{hint}; split the episode, or use accerl sft")
        success_at, rewards = None, own.get(REWARD)
        if SUCCESS in own:
            success_at = step_of_success(own[SUCCESS])
        elif rewards is not None:
            success_at = step_of_reward(rewards)
            if success_at is None:
                hint = f"{REWARD} is above 0 at steps that do not end it, so that it tells no success"
                raise origin.refuse(f"episode {index}", f"{hint}; {LABEL}")
        if rewards is not None:
            rewards = rewards.astype(np.float32)
        found.append(
            EpisodeLabels(index=index, rows=rows, tasks=tasks, rewards=rewards, success_at=success_at)
        )
    return found


def step_of_success(flags: np.ndarray) -> int:
    """Index of the step that achieved the task, by ``next.success`` (T,); -1 for none.

    Where all steps have it, the episode as a whole is labelled, and its last step counts.
    """
    if flags.all():
        return len(flags) - 1
    return int(flags.argmax()) if flags.any() else -1


def step_of_reward(rewards: np.ndarray) -> int | None:
    """Index of the step that achieved the task, by ``next.reward`` (T,); -1 for none.

    None if rewards are dense: a reward above 0 tells success if it comes once, or stays until the end.
    """
    positive = np.flatnonzero(rewards > 0)
    if len(positive) == 0:
        return -1
    first = int(positive[0])
    stays = first > 0 and bool((rewards[first:] == rewards[first]).all())
    return first if len(positive) == 1 or stays else None


def numbers(data: Any, name: str, dataset: DatasetConfig) -> np.ndarray:
    """A column of finite numbers, one row per frame."""
    values = np.asarray(data.hf_dataset.with_format("numpy", columns=[name])[:][name])
    origin = origin_of(dataset)
    if values.dtype.kind not in "biuf":
        raise origin.refuse(name, "numbers are wanted, of the same shape in all rows; record it again")
    finite = np.isfinite(values).reshape(len(values), -1).all(1)
    if not finite.all():
        where = int(data.hf_dataset[int(finite.argmin())]["episode_index"])
        raise origin.refuse(name, f"a number that is not finite in episode {where}; leave the episode out")
    return values


def observations(
    data: Any, rows: np.ndarray, vectors: dict[str, np.ndarray], cameras: Collection[str]
) -> dict[str, np.ndarray]:
    """Contents of some rows: of `vectors`, columns of the dataset, and images uint8 (T, h, w, 3)."""
    found = {name: values[rows] for name, values in vectors.items()}
    frames = [data[int(row)] for row in rows] if cameras else []
    for camera in cameras:
        # LeRobot gives float (3, h, w) in [0, 1].
        images = [(frame[camera] * 255).round().byte().permute(1, 2, 0).numpy() for frame in frames]
        found[camera] = np.stack(images)
    return found
