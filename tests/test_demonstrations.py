# SPDX-License-Identifier: Apache-2.0
"""Demonstrations in an off-policy learner's memory, against the dataset's frames."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from accerl_lerobot.algorithms import ChunkCriticConfig
from accerl_lerobot.algorithms.chunk_critic import ChunkCriticUpdate
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.demos.dataset_files import open_metadata
from accerl_lerobot.envs import SimulatedConfig, make_environment
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import ENVIRONMENT_STATE, Segment, SegmentStart
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.loading import load_adapter
from accerl_lerobot.policies.teacher import with_teacher
from accerl_lerobot.run import adapter as module
from accerl_lerobot.run.adapter import demonstrations, recorded
from accerl_lerobot.run.preflight import check_start
from accerl_lerobot.world_model.config import SimulatorStateConfig
from tests.replay.segments import make_segment
from tests.runs import off_policy_run
from tests.tiny_datasets import labels, record_dataset, write_dataset

ENV = SimulatedConfig(max_steps=16, environment_state=True)
K, COST = 4, 0.25
GIVEN: dict[str, Any] = {"instructions": (), "reward": "success", "decision_cost": COST}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> DatasetConfig:
    """Three successes and a failure."""
    root = tmp_path_factory.mktemp("demos") / "dataset"
    return record_dataset(root, ENV, episodes=4, failure_share=0.25)


@pytest.fixture
def like() -> Segment:
    """An explored episode of one decision."""
    observation = make_environment(ENV).reset(3, "match")
    seen = {name: np.stack([value] * 2) for name, value in observation.items() if name != "task"}
    return make_segment(
        "explored", 1, observations=seen, task=str(observation["task"]),
        actions=np.zeros((1, K, 2), np.float32), steps=np.array([K]),
        terminated=True, time_limit=ENV.max_steps, origin=SegmentStart("match", 0, 0),
    )  # fmt: skip


def test_decisions_are_the_frames_from_every_step_on(dataset: DatasetConfig, like: Segment):
    data = LeRobotDataset("a/b", root=dataset.root)
    ends = zip(*(data.meta.episodes[f"dataset_{end}_index"] for end in ("from", "to")), strict=True)
    episodes = [[data[i] for i in range(first, last)] for first, last in ends]
    read = list(demonstrations(dataset, like, **GIVEN))
    expected = [(frames, phase) for frames in episodes for phase in range(min(K, len(frames)))]
    for segment, (frames, phase) in zip(read, expected, strict=True):
        won = any(bool(frame["next.success"]) for frame in frames)
        assert segment.success is won
        np.testing.assert_allclose(segment.reward, [*[-COST] * (len(segment) - 1), won - COST])
        late = segment.observations[ENVIRONMENT_STATE][:-1, -1]
        np.testing.assert_allclose(segment.elapsed, late, atol=1e-6)
        for t in range(len(segment)):
            at = phase + K * t
            for name in ("observation.state", ENVIRONMENT_STATE):
                np.testing.assert_array_equal(segment.observations[name][t], frames[at][name].numpy())
            image = next(name for name in segment.observations if "images" in name)
            pixels = (255 * frames[at][image]).round().byte().permute(1, 2, 0).numpy()
            np.testing.assert_array_equal(segment.observations[image][t], pixels)
            for k in range(K):
                last = min(at + k, len(frames) - 1)  # what was not executed repeats the last
                np.testing.assert_array_equal(segment.actions[t, k], frames[last]["action"].numpy())
            assert segment.steps[t] == min(K, len(frames) - at)
    assert {segment.success for segment in read} == {True, False}


@pytest.mark.parametrize(
    ("label", "rewards", "success"),
    [
        ({"next.success": [0, 0, 1, 1, 1, 1]}, [0, 0, 1], True),
        ({"next.success": [1] * 6}, [0, 0, 0, 0, 0, 1], True),  # the episode's label, at every frame
        ({"next.success": [0] * 6}, [0] * 6, False),
        ({"next.success": [0, 1, 0, 0, 0, 0]}, [0, 1], True),
        ({"next.success": [0, 1, 1, 1, 1, 1], "next.reward": [-1, -2, 0, 0, 0, 0]}, [-1, -2], True),
        ({"next.reward": [0, 0, 0, 1, 1, 1]}, [0, 0, 0, 1], True),
        ({"next.reward": [0] * 6}, [0] * 6, False),
        ({}, [0, 0, 0, 0, 0, 1], True),
    ],
)
def test_labels_of_an_episode(label: dict[str, list[int]], rewards: list[int], success: bool, tmp_path: Path):
    dataset = write_dataset(
        tmp_path / "data", ("go",), {name: labels("float32") for name in label},
        lambda name, episode, step: [label[name][step]] if name in label else None,
    )  # fmt: skip
    shapes = {"observation.state": (4,), "action": (2,)}
    (segment,) = recorded(dataset, open_metadata(dataset), shapes, 1, range(1), time_limit=100)
    assert (segment.reward.tolist(), segment.success, segment.task) == (rewards, success, "go")
    assert segment.observations["observation.state"].shape == (len(rewards) + 1, 4)


def test_of_a_long_dataset_only_a_part_is_read(dataset: DatasetConfig, like: Segment, monkeypatch):
    frames = open_metadata(dataset).total_frames
    monkeypatch.setattr(module, "ROWS", frames // K // 2)
    read = list(demonstrations(dataset, like, **GIVEN))
    assert len(read) == 2 and sum(map(len, read)) <= frames // K // 2 + 2


def test_of_each_task_of_the_run_as_large_a_share_is_read(like: Segment, tmp_path: Path, monkeypatch, caplog):
    texts = ("a", "a", "a", "a", "b", "b", "c", "b", "b")
    dataset = write_dataset(tmp_path / "data", texts)
    like = replace(like, observations={"observation.state": like.observations["observation.state"]})

    def read(*instructions: str, reward: str = "success") -> list[tuple[str, int]]:
        given = GIVEN | {"instructions": instructions, "reward": reward}
        found = demonstrations(dataset, like, **given)
        return [(segment.task, segment.origin.seed) for segment in found if not segment.before]

    assert read("b", "a", "d") == [(texts[i], i) for i in (0, 1, 2, 3, 4, 5, 7, 8)]
    assert "8 of 9 demonstrations join the memory" in caplog.text
    assert read() == [(like.task, i) for i in range(9)], "the environment has no text"
    monkeypatch.setattr(module, "FRAMES", 24)
    assert read("b", "a") == [(texts[i], i) for i in (0, 1, 4, 5)]
    assert read("d") == []


def test_rewards_and_ends_are_those_of_the_environment(like: Segment, tmp_path: Path):
    given: dict[str, Any] = {"next.success": [0, 0, 1, 1, 0, 0], "next.reward": [1, 2, 3, 4, 5, 6]}
    dataset = write_dataset(
        tmp_path / "data", ("go",), {"next.success": labels(), "next.reward": labels("float32")},
        lambda name, episode, step: [given[name][step]] if name in given else None,
    )  # fmt: skip
    like = replace(like, observations={"observation.state": like.observations["observation.state"]})
    for reward, expected in (("success", [1 - COST]), ("env", [10 - COST, 11 - COST])):
        first = next(demonstrations(dataset, like, **GIVEN | {"reward": reward}))
        assert first.success and first.reward.tolist() == expected


def test_the_memory_begins_with_them_and_is_restored_without(dataset, like: Segment, tiny_checkpoint: Path):
    policy = PolicyConfig(path=str(tiny_checkpoint), device="cpu")
    adapter = with_teacher(load_adapter, SimulatorStateConfig(), 5, policy)  # numbers of its state
    adapter.demonstrations = partial(demonstrations, dataset, **GIVEN)
    config = TrainerConfig(value_warmup_updates=100)
    update = ChunkCriticUpdate(adapter, ChunkCriticConfig(), config)
    rows = sum(map(len, demonstrations(dataset, like, **GIVEN)))
    assert update.step([like])["memory_decisions"] == rows + 1
    assert update.memory["success"][:-1].any() and not update.memory["success"][-1]
    again = ChunkCriticUpdate(adapter, ChunkCriticConfig(), config)
    again.restore(update.state())
    assert again.step([like])["memory_decisions"] == rows + 2


def test_they_are_looked_at_before_the_run_begins(dataset, tiny_checkpoint: Path, tmp_path: Path, caplog):
    config = off_policy_run(tiny_checkpoint, env=ENV, dataset=dataset)
    check_start(config)
    assert "does not join" not in caplog.text
    check_start(replace(config, env=replace(ENV, image_size=48)))
    assert "does not join the memory: the dataset's observation.images.front has shape" in caplog.text
    with pytest.raises(InputError, match=r"^dataset\.root="):
        check_start(replace(config, dataset=DatasetConfig(repo_id="a/b", root=str(tmp_path))))
