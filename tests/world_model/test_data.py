# SPDX-License-Identifier: Apache-2.0
"""Windows whose numbers are known by hand, and LeRobotDatasets as episodes."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lerobot.datasets.dataset_tools import merge_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

from accerl_lerobot.engines.config import DatasetConfig
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model import contract
from accerl_lerobot.world_model.contract import Episode, WindowStart, WorldModelSpec, cut_windows
from tests.tiny_datasets import record_dataset

K = 3
SPEC = WorldModelSpec(
    cameras=("observation.images.front",), image_size=(16, 16), state_dim=4, action_dim=2, chunk=K, fps=80,
)  # fmt: skip


def an_episode(steps: int, times: Sequence[int] | None = None, success: bool = False) -> Episode:
    """Frame and state say which env step they show, by default each but the last; action i is (i, −1 − i)."""
    at = np.arange(steps) if times is None else np.array(times)
    return Episode(
        frames=np.broadcast_to(at[:, None, None, None, None], (len(at), 1, 2, 2, 3)).astype(np.uint8),
        times=at,
        state=at[:, None].astype(np.float32),
        actions=np.stack([np.arange(steps), -1 - np.arange(steps)], 1).astype(np.float32),
        success=success,
        task="go",
    )


def cut(episode: Episode, frame: int, chunks: int | None) -> Any:
    return cut_windows([WindowStart(episode, frame)], SPEC, chunks)


def shown(frames: Tensor) -> list[int]:
    return frames[0, ..., 0, 0, 0, 0].int().tolist()


def test_a_window_inside_an_episode():
    windows = cut(an_episode(20), 7, 2)
    context = windows.context
    assert shown(context.frames) == [4, 7] and shown(windows.frames) == [10, 13]
    assert context.robot[0, :, 0].tolist() == [4, 7] and windows.robot[0, :, 0].tolist() == [10, 13]
    assert context.actions[0, :, 0].tolist() == [4, 5, 6]
    assert windows.actions[0, :, :, 0].tolist() == [[7, 8, 9], [10, 11, 12]]
    assert windows.steps.tolist() == [[3, 3]] and windows.known.all() and not windows.success.any()
    assert windows.tasks == ("go",) and shown(context.first_frame) == 0 == context.first_robot.item()
    assert context.commanded_sum.tolist() == [[21, -28]], "actions 0 to 6"


def test_an_episode_that_ends_within_a_chunk_repeats_its_last_frame_and_action():
    """Demonstrations have no frame after the last step: frames 0 to 7, actions 0 to 7."""
    windows = cut(an_episode(8, success=True), 3, 3)
    assert shown(windows.frames) == [6, 7, 7] and windows.steps.tolist() == [[3, 1, 0]]
    assert windows.actions[0, :, :, 0].tolist() == [[3, 4, 5], [6, 7, 7], [7, 7, 7]]
    assert windows.success.tolist() == [[False, True, False]]
    assert windows.known.tolist() == [[True, True, False]]


def test_an_episode_with_a_frame_for_each_decision():
    episode = an_episode(8, [0, 3, 6, 8], success=True)
    assert len(contract.starts_of([episode, episode])) == 6
    whole, third = cut(episode, 0, None), cut(episode, 2, 2)
    assert shown(whole.context.frames) == [0, 0] and shown(whole.frames) == [3, 6, 8]
    assert not whole.context.actions.any(), "there were none before"
    assert whole.steps.tolist() == [[3, 3, 2]] and whole.success.tolist() == [[False, False, True]]
    assert shown(third.context.frames) == [3, 6] and shown(third.frames) == [8, 8]
    assert third.known.tolist() == [[True, False]] == third.success.tolist()


def test_every_frame_and_action_is_the_dataset_s_once(tmp_path: Path):
    """Of episodes of which some fail, in a dataset that has each of them twice."""
    env = SimulatedConfig(max_steps=60, hold=25, image_size=16)
    dataset = record_dataset(tmp_path / "once", env, episodes=6, failure_share=0.5)
    rows = LeRobotDataset("a/b", root=dataset.root)
    merge_datasets([rows, rows], output_repo_id="a/b", output_dir=tmp_path / "twice")
    episodes = contract.load_episodes(replace(dataset, root=str(tmp_path / "twice")), SPEC)
    assert len(episodes) == 6 and sum(len(episode.actions) for episode in episodes) == len(rows)
    index = 0
    for episode in episodes:
        assert episode.task == "Match the target"
        successes = []
        for t in range(len(episode.actions)):
            row = rows[index + t]
            image = (row[SPEC.cameras[0]] * 255).round().numpy()
            assert np.array_equal(episode.frames[t, 0].transpose(2, 0, 1), image)
            assert np.array_equal(episode.state[t], row["observation.state"].numpy())
            assert np.array_equal(episode.actions[t], row["action"].numpy())
            successes.append(bool(row["next.success"]))
        assert not any(successes[:-1]) and successes[-1] == episode.success
        index += len(successes)
    assert {episode.success for episode in episodes} == {True, False}


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"observation.images.front": None}, "no 'observation.images.front': the dataset has no camera"),
        ({"action": (7,)}, r"action has shape \(7,\), the environment's has \(2,\)"),
        ({"observation.state": None}, "observation.state has shape None, the environment's has"),
        ({"next.success": None}, "no next.success: record it, as accerl demos does"),
        ({"fps": 10}, "10 frames a second, and the environment makes 80 steps"),
    ],
)
def test_what_cannot_be_learned_from(changes: dict[str, Any], why: str, monkeypatch: pytest.MonkeyPatch):
    shapes: dict[str, Any] = {"observation.images.front": (16, 16, 3), "observation.state": (4,)}
    shapes |= {"action": (2,), "next.success": (1,)} | changes
    features = {name: {"shape": shape} for name, shape in shapes.items() if isinstance(shape, tuple)}
    meta = SimpleNamespace(features=features, fps=changes.get("fps", 80), camera_keys=[])
    monkeypatch.setattr(contract, "open_metadata", lambda dataset: meta)
    with pytest.raises(InputError, match=f"^dataset.repo_id='a/b': {why}"):
        contract.check_dataset(DatasetConfig(repo_id="a/b"), SPEC)
    if "fps" in changes:  # as datasets of LIBERO's demonstrations are labelled
        contract.check_dataset(DatasetConfig(repo_id="a/b"), replace(SPEC, labelled_fps=(10,)))
