# SPDX-License-Identifier: Apache-2.0
"""Labels, instructions and columns of a dataset's episodes, which all verbs read in this way.

Rows are found by ``episode_index`` and ``frame_index``, an instruction by ``task_index``. `docs/recorded.md`
says when an episode counts as a success.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from accerl_lerobot.demos.dataset_files import origin_of
from accerl_lerobot.experience import REWARD, SUCCESS

if TYPE_CHECKING:
    from accerl_lerobot.config.ranges import DatasetConfig

LABEL = f"label the episodes with {SUCCESS}, as the page about recorded episodes shows"


@dataclass(frozen=True, kw_only=True)
class EpisodeLabels:
    """Rows of an episode in the order of time, and what is known of them; T env steps."""

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
    meta, origin = data.meta, origin_of(dataset)
    episode, step, task = (column(data, f"{name}_index", dataset) for name in ("episode", "frame", "task"))
    rewards = column(data, REWARD, dataset) if REWARD in meta.features else None
    flags = column(data, SUCCESS, dataset) if SUCCESS in meta.features else None
    if flags is not None and not np.isin(flags, (0, 1)).all():
        raise origin.refuse(SUCCESS, f"a value other than 0 and 1; {LABEL}")
    texts = [str(text) for text in meta.tasks.index]
    order = np.lexsort((step, episode))
    ends = np.flatnonzero(np.diff(episode[order])) + 1
    found = []
    for rows in np.split(order, ends):
        index = int(episode[rows[0]])
        numbers_of_tasks = dict.fromkeys(task[rows].tolist())
        names = tuple(texts[int(number)] for number in numbers_of_tasks)
        if one_task and len(names) > 1:
            hint = f"its instruction changes from {names[0]!r} to {names[1]!r}, and one is read here"
            raise origin.refuse(f"episode {index}", f"{hint}; split the episode, or use accerl sft")
        given = None if rewards is None else rewards[rows].astype(np.float32)
        success_at = None
        if flags is not None:
            success_at = step_of_success(flags[rows])
        elif given is not None:
            success_at = step_of_reward(given)
            if success_at is None:
                hint = f"{REWARD} is above 0 at steps that do not end it, so that it tells no success"
                raise origin.refuse(f"episode {index}", f"{hint}; {LABEL}")
        labels = EpisodeLabels(index=index, rows=rows, tasks=names, rewards=given, success_at=success_at)
        found.append(labels)
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
    if not len(positive):
        return -1
    first, last = int(positive[0]), int(positive[-1])
    held = last == len(rewards) - 1 and len(positive) == last - first + 1
    same = bool((rewards[positive] == rewards[first]).all())
    if len(positive) == 1 or (held and same and first > 0):
        return first
    return None


def column(data: Any, name: str, dataset: DatasetConfig) -> np.ndarray:
    """A column of one finite number per row, (N,)."""
    values = numbers(data, name, dataset)
    if values.size != len(values):
        raise origin_of(dataset).refuse(name, f"shape {values.shape[1:]} at each step; one number is wanted")
    return values.reshape(-1)


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


def check_images(data: Any, shapes: Mapping[str, tuple[int, ...]], dataset: DatasetConfig) -> None:
    """Refuses a dataset whose first images have not the shapes (channels, height, width) that it names."""
    first = data[0] if shapes else {}
    for name, shape in shapes.items():
        if (found := tuple(first[name].shape)) != shape:
            hint = f"its images have shape {found}, and meta/info.json says {shape}; record it again"
            raise origin_of(dataset).refuse(name, hint)


def observations(
    data: Any, rows: np.ndarray, vectors: dict[str, np.ndarray], cameras: Collection[str]
) -> dict[str, np.ndarray]:
    """Contents of some rows: of `vectors`, columns of the dataset, and images uint8 (T, h, w, 3)."""
    found = {name: values[rows] for name, values in vectors.items()}
    frames = [data[int(row)] for row in rows] if cameras else []
    return found | {camera: np.stack([_pixels(frame[camera]) for frame in frames]) for camera in cameras}


def _pixels(image: Any) -> np.ndarray:
    """uint8 (h, w, 3) from LeRobot's float (3, h, w) in [0, 1]."""
    pixels: np.ndarray = (image * 255).round().clamp(0, 255).byte().permute(1, 2, 0).numpy()
    return pixels
