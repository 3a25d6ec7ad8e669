# SPDX-License-Identifier: Apache-2.0
"""Episodes and windows, cut slowly by hand and compared, and LeRobotDatasets as episodes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lerobot.datasets.dataset_tools import merge_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from accerl_lerobot.demos.record import DemosConfig, record_demos
from accerl_lerobot.engines.config import DatasetConfig
from accerl_lerobot.envs import SimulatedConfig, make_environment
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.contract import WorldModelSpec
from accerl_lerobot.world_model.data import (
    ONLINE,
    Episode,
    Windows,
    WindowStart,
    check_metadata,
    cut_windows,
    hold_last_action,
    load_datasets,
    shuffle_actions,
    split_episodes,
    window_starts,
)

K = 3


def an_episode(steps: int = 8, *, every: int = 1, success_at: int = -1, last: bool = False) -> Episode:
    """Frame and state say which env step they show; action i is (i, −i)."""
    times = np.arange(0, steps, every)
    if last:
        times = np.append(times[times < steps], steps)
    return Episode(
        frames=np.broadcast_to(times[:, None, None, None, None], (len(times), 1, 2, 2, 3)).astype(np.uint8),
        times=times.astype(np.int64),
        state=times[:, None].astype(np.float32),
        actions=np.stack([np.arange(steps), -np.arange(steps)], 1).astype(np.float32),
        success_at=success_at,
        task="go",
        own=False,
    )


def cut(episodes: list[Episode], at: list[WindowStart], context: int, chunks: int, **options: Any) -> Windows:
    spec = replace(SPEC, chunk=K, context=context)
    return cut_windows(episodes, at, spec, chunks, **options)


def shown(frames: np.ndarray) -> list[int]:
    return frames[..., 0, 0, 0, 0].astype(int).tolist()


def test_a_window_inside_an_episode():
    windows = cut([an_episode(20)], [WindowStart(0, 7)], 3, 2)
    assert shown(windows.frames[0]) == [1, 4, 7, 10, 13] and shown(windows.anchor) == [7]
    assert windows.state[0, :, 0].tolist() == [1, 4, 7, 10, 13] and windows.context == 3
    assert windows.before[0, :, :, 0].tolist() == [[1, 2, 3], [4, 5, 6]]
    assert windows.actions[0, :, :, 0].tolist() == [[7, 8, 9], [10, 11, 12]]
    assert windows.steps.tolist() == [[3, 3]] and windows.valid.all() and not windows.success.any()
    assert windows.task == ("go",) and len(windows) == 1
    assert windows.commanded_sum.tolist() == [[21, -21]], "actions 0 to 6"
    assert windows.initial_state.tolist() == [[0]]


def test_context_and_anchor_stop_at_the_first_frame():
    windows = cut([an_episode(20)], [WindowStart(0, 4)] * 3, 3, 1, anchors=[0, 1, 5])
    assert shown(windows.frames[0]) == [0, 1, 4, 7]
    assert windows.before[0, :, :, 1].tolist() == [[0, 0, 0], [-1, -2, -3]]
    assert shown(windows.anchor) == [4, 1, 0]


def test_an_episode_that_ends_within_a_chunk():
    """Demonstrations have no frame after the last step: frames 0 to 7, actions 0 to 7."""
    windows = cut([an_episode(8, success_at=7)], [WindowStart(0, 3)], 1, 3)
    assert shown(windows.frames[0]) == [3, 6, 7, 7]
    assert windows.steps.tolist() == [[3, 1, 0]] and windows.valid.tolist() == [[True, True, False]]
    assert windows.actions[0, :, :, 0].tolist() == [[3, 4, 5], [6, 0, 0], [0, 0, 0]]
    assert windows.success.tolist() == [[False, True, False]]


def test_chunks_are_made_whole_by_holding_the_last_action():
    windows = cut([an_episode(8, success_at=7)], [WindowStart(0, 3)], 1, 3)
    whole = hold_last_action(windows.actions, windows.steps)
    assert whole[0, :, :, 0].tolist() == [[3, 4, 5], [6, 6, 6], [6, 6, 6]]
    assert whole[0, :, :, 1].tolist() == [[-3, -4, -5], [-6, -6, -6], [-6, -6, -6]]
    cut_short = hold_last_action(windows.actions, np.array([[1, 0, 0]]))
    assert cut_short[0, :, :, 0].tolist() == [[3, 3, 3]] * 3
    assert windows.actions[0, 1, 1, 0] == 0, "they themselves stay"


def test_an_episode_that_was_looked_at_when_decisions_were_due():
    episode = an_episode(8, every=K, success_at=7, last=True)
    assert episode.times.tolist() == [0, 3, 6, 8]
    windows = cut([episode], [WindowStart(0, 0), WindowStart(0, 2)], 2, 3)
    assert shown(windows.frames[0]) == [0, 0, 3, 6, 8] and windows.steps[0].tolist() == [3, 3, 2]
    assert windows.success[0].tolist() == [False, False, True] and windows.valid[0].all()
    assert shown(windows.frames[1]) == [3, 6, 8, 8, 8] and windows.valid[1].tolist() == [True, False, False]


def test_windows_start_at_every_frame_that_is_followed_by_another():
    episodes = [an_episode(9, success_at=4), an_episode(15), an_episode(7, every=K, last=True)]
    at = window_starts(episodes)
    assert len(at) == 8 + 14 + 3 and at[8] == WindowStart(1, 0)
    assert cut(episodes, at, 2, 2).valid[:, 0].all(), "something follows every place"


def test_every_success_is_in_exactly_one_chunk_of_a_chain():
    for at in range(8):
        windows = cut([an_episode(8, success_at=at)], [WindowStart(0, 0)], 1, 3)
        assert windows.success.sum() == 1 and windows.success[0, at // K]


def test_a_split_has_every_outcome_on_both_sides():
    episodes = [an_episode(success_at=3 if i % 4 == 0 else -1) for i in range(20)]
    learn, held = split_episodes(episodes, 0.25, np.random.default_rng(0))
    assert {*map(id, learn + held)} == {*map(id, episodes)} and len(held) == 1 + 4
    for part in (learn, held):
        assert {episode.success for episode in part} == {True, False}
    again, other = (split_episodes(episodes, 0.25, np.random.default_rng(seed))[0] for seed in (0, 1))
    assert [*map(id, again)] == [*map(id, learn)] != [*map(id, other)]


@pytest.mark.parametrize("share", [0.01, 0.99])
def test_no_part_of_a_split_is_empty(share: float):
    episodes = [an_episode(), an_episode(), an_episode(success_at=1), an_episode(success_at=1)]
    learn, held = split_episodes(episodes, share, np.random.default_rng(0))
    assert len(learn) == len(held) == 2


SPEC = WorldModelSpec(
    cameras=("observation.images.corner2",),
    image_size=(64, 64),
    state_dim=4,
    action_dim=4,
    chunk=10,
    context=2,
    fps=80,
)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[DatasetConfig, WorldModelSpec]:
    """Six episodes of the simulated environment, some of which fail."""
    root = tmp_path_factory.mktemp("demos") / "dataset"
    env = SimulatedConfig(max_steps=60, hold=25, image_size=16)
    config = DemosConfig(episodes=6, failure_share=0.5)
    record_demos(env, config, str(root))
    environment = make_environment(env).spec
    spec = replace(
        SPEC, cameras=tuple(environment.images), image_size=(16, 16), state_dim=environment.state_dim,
        action_dim=environment.action_dim, fps=environment.fps,
    )  # fmt: skip
    return DatasetConfig(repo_id="a/b", root=str(root)), spec


def load(dataset: DatasetConfig, spec: WorldModelSpec, section: str = "dataset") -> list[Episode]:
    return load_datasets({section: dataset, "other": DatasetConfig()}, spec)[section]


def test_every_frame_and_action_is_the_dataset_s(recorded: tuple[DatasetConfig, WorldModelSpec]):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset, spec = recorded
    episodes = load(dataset, spec, ONLINE)
    data = LeRobotDataset(dataset.repo_id, root=dataset.root)
    assert len(episodes) == data.meta.total_episodes == 6 and sum(map(len, episodes)) == len(data)
    index = 0
    for episode in episodes:
        assert episode.own and episode.task in data.meta.tasks.index
        found = -1
        for t in range(len(episode)):
            item = data[index + t]
            image = (item[spec.cameras[0]] * 255).round().numpy()
            assert np.array_equal(episode.frames[t, 0].transpose(2, 0, 1), image)
            assert np.array_equal(episode.state[t], item["observation.state"].numpy())
            assert np.array_equal(episode.actions[t], item["action"].numpy())
            if found < 0 and bool(item["next.success"]):
                found = t
        assert episode.success_at == found
        index += len(episode)
    assert {e.success for e in episodes} == {True, False}
    assert len({e.key for e in episodes}) == 6, "by which they are known in any dataset"


def metadata(**changes: Any) -> SimpleNamespace:
    shapes = {
        "observation.images.corner2": (64, 64, 3), "observation.state": (4,), "action": (4,),
        "next.success": (1,),
    }  # fmt: skip
    shapes |= changes.pop("shapes", {})
    features = {k: {"shape": v} for k, v in shapes.items() if v is not None}
    cameras = [k for k in features if "images" in k]
    return SimpleNamespace(
        **({"features": features, "camera_keys": cameras, "fps": 80, "total_episodes": 9} | changes)
    )


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        (
            {"shapes": {"observation.images.corner2": None, "observation.images.top": (64, 64, 3)}},
            "no 'observation.images.corner2': the dataset has observation.images.top; choose env.camera",
        ),
        (
            {"shapes": {"action": (7,)}},
            r"action has shape \(7,\), the environment's has \(4,\): it is another",
        ),
        ({"shapes": {"observation.state": None}}, "observation.state has shape None, the environment's has"),
        ({"shapes": {"next.success": None}}, "no next.success: record it, as accerl demos does"),
        ({"fps": 10}, "10 frames a second, and the environment makes 80 steps"),
        ({"total_episodes": 1}, "a single episode; at least one to train on and one to hold out"),
    ],
)
def test_what_cannot_be_learned_from(changes: dict[str, Any], why: str):
    check_metadata(metadata(), "a/b", SPEC)
    with pytest.raises(InputError, match=f"^dataset.repo_id='a/b': {why}"):
        check_metadata(metadata(**changes), "a/b", SPEC)


def test_a_world_without_a_state_does_not_ask_for_one():
    check_metadata(metadata(shapes={"observation.state": None}), "a/b", replace(SPEC, state_dim=0))


def test_an_episode_that_is_there_twice_is_used_once(
    recorded: tuple[DatasetConfig, WorldModelSpec], tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    dataset, spec = recorded
    twice = [LeRobotDataset("a/b", root=dataset.root)] * 2
    merge_datasets(twice, output_repo_id="a/b", output_dir=tmp_path / "twice")
    (episodes,) = load_datasets({"dataset": replace(dataset, root=str(tmp_path / "twice"))}, spec).values()
    assert len(episodes) == len({episode.key for episode in episodes}) == 6
    assert "6 episodes are in it more than once, and are used once" in caplog.text


def test_one_window_alone_keeps_its_actions():
    one = cut([an_episode(8)], [WindowStart(0, 3)], 1, 1)
    assert np.array_equal(shuffle_actions(one, np.random.default_rng(0)).actions, one.actions)


def test_datasets_that_share_episodes(recorded: tuple[DatasetConfig, WorldModelSpec], tmp_path: Path):
    dataset, spec = recorded
    same = replace(dataset, repo_id="c/d")
    with pytest.raises(InputError, match="^online.repo_id='c/d': 6 of its episodes are in the other"):
        load_datasets({"dataset": dataset, "online": same}, spec)
    with pytest.raises(InputError, match="^online.root='nowhere': no meta/info.json there"):
        load_datasets({"dataset": dataset, "online": replace(dataset, root="nowhere")}, spec)
