# SPDX-License-Identifier: Apache-2.0
"""Labels and instructions of recorded episodes, which all verbs read by one reader."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.algorithms.demonstrations import recorded
from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.demos.dataset_files import (
    EpisodeLabels,
    open_metadata,
    opened,
    read_labels,
    step_of_reward,
    step_of_success,
)
from accerl_lerobot.demos.sft import picked
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.contract import WorldModelSpec
from accerl_lerobot.world_model.data import load_episodes
from tests.tiny_datasets import ACTION, FPS, FRONT, IMAGE, STATE, STEPS, labels, write_dataset

SUCCESS, REWARD = "next.success", "next.reward"


@pytest.mark.parametrize(
    ("flags", "step"),
    [
        ([0, 0, 1, 1], 2),
        ([0, 1, 0, 0], 1),
        ([1, 1, 1, 1], 3),  # the episode's label, at every frame
        ([1, 0, 0, 0], 0),
        ([0, 0, 0, 0], -1),
    ],
)
def test_the_step_of_success(flags: list[int], step: int):
    assert step_of_success(np.array(flags)) == step


@pytest.mark.parametrize(
    ("rewards", "step"),
    [
        ([0, 0, 0, 1], 3),
        ([0, 0, 5, 5], 2),
        ([-0.1, 10, -0.1, -0.1], 1),
        ([-3, -2, -1, 0], -1),
        ([0.1, 0.2, 0.3, 0.4], None),  # dense: no step tells success
        ([1, 1, 1, 1], None),  # a reward for being alive
        ([0, 0.1, 0.5, 0.9], None),
        ([0, 1, 0, 1], None),
    ],
)
def test_a_reward_tells_success_where_it_is_sparse(rewards: list[float], step: int | None):
    assert step_of_reward(np.array(rewards)) == step


def read(dataset: DatasetConfig, one_task: bool = True) -> list[EpisodeLabels]:
    with opened(dataset, open_metadata(dataset)) as data:
        return read_labels(data, dataset, one_task)


def outcomes(dataset: DatasetConfig) -> dict[str, list[bool]]:
    """Which episodes are successes, by each verb that reads labels."""
    shapes = {STATE: (4,), ACTION: (2,)}
    segments = recorded(dataset, open_metadata(dataset), shapes, STEPS, 1000, 1, time_limit=100)
    spec = WorldModelSpec(
        cameras=(FRONT,), image_size=(32, 32), state_dim=4, action_dim=2, chunk=2, context=1, fps=FPS
    )
    episodes = load_episodes(dataset, spec)
    chosen = picked(dataset, "successes") or []
    return {
        "memory": [segment.success for segment in segments],
        "world model": [episode.success for episode in episodes],
        "pick": [index in chosen for index in range(len(episodes))],
    }


@pytest.mark.parametrize(
    ("name", "dtype", "values"),
    [
        (SUCCESS, "bool", [[0, 0, 0, 0, 1, 1], [0] * 6, [1] * 6]),
        (SUCCESS, "int64", [[0, 0, 1, 0, 0, 0], [0] * 6, [1] * 6]),
        (SUCCESS, "float32", [[0, 0, 0, 0, 0, 1], [0] * 6, [1] * 6]),
        (REWARD, "float32", [[0, 0, 0, 0, 0, 1], [0, -1, 0, 0, 0, 0], [0, 0, 0, 2, 2, 2]]),
    ],
)
def test_all_verbs_read_a_label_in_the_same_way(tmp_path: Path, name: str, dtype: str, values: Any):
    dataset = write_dataset(
        tmp_path / "data", ("go",) * 3, {FRONT: IMAGE, name: labels(dtype)},
        lambda feature, episode, step: [values[episode][step]] if feature == name else None,
    )  # fmt: skip
    assert outcomes(dataset) == dict.fromkeys(("memory", "world model", "pick"), [True, False, True])


@pytest.mark.parametrize(
    ("name", "value", "why"),
    [
        (REWARD, lambda step: 0.1 * step, "above 0 at steps that do not end it.*label the episodes"),
        (REWARD, lambda step: np.nan, "a number that is not finite in episode 0"),
    ],
)
def test_labels_that_tell_no_success_are_refused(tmp_path: Path, name: str, value: Any, why: str):
    dataset = write_dataset(
        tmp_path / "data", more={name: labels("float32")},
        values=lambda feature, episode, step: [value(step)] if feature == name else None,
    )  # fmt: skip
    for verb in (lambda: read(dataset), lambda: picked(dataset, "successes")):
        with pytest.raises(InputError, match=f"^dataset.root=.*{why}"):
            verb()


def test_an_instruction_that_changes_is_refused_where_one_is_read(tmp_path: Path):
    dataset = write_dataset(tmp_path / "data", ("go", ["go"] * 3 + ["stop"] * 3))
    assert [episode.tasks for episode in read(dataset, one_task=False)] == [("go",), ("go", "stop")]
    with pytest.raises(InputError, match="episode 1: its instruction changes from 'go' to 'stop'"):
        read(dataset)
    with opened(dataset, open_metadata(dataset)) as data:  # SFT reads it where it stands
        assert [data[i]["task"] for i in (STEPS + 2, STEPS + 3)] == ["go", "stop"]
