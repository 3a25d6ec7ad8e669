# SPDX-License-Identifier: Apache-2.0
"""LeRobotDatasets as episodes: the committed one, and datasets that nothing can be learnt from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.demos.record import DemosConfig, record_demos
from accerl_lerobot.engine.config import DatasetConfig
from accerl_lerobot.envs import SimulatedConfig, make_world
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model import dataset as module
from accerl_lerobot.world_model.contract import WorldModelSpec
from accerl_lerobot.world_model.dataset import check_metadata, load_episodes

TINY = DatasetConfig(
    repo_id="accerl/metaworld_tiny", root=str(Path(__file__).parents[2] / "datasets" / "metaworld_tiny")
)
SPEC = WorldModelSpec(
    cameras=("observation.images.corner2",),
    image_size=(64, 64),
    state_dim=4,
    action_dim=4,
    chunk=10,
    context=2,
    fps=80,
    provides=frozenset({"pixels", "state"}),
)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[DatasetConfig, WorldModelSpec]:
    """Six episodes of the simulated world, some of which fail."""
    root = tmp_path_factory.mktemp("demos") / "dataset"
    env = SimulatedConfig(max_steps=60, hold=25, image_size=16)
    config = DemosConfig(episodes=6, failure_share=0.5, processes=1, root=str(root), repo_id="a/b")
    record_demos(env, config)
    world = make_world(env).spec
    spec = replace(
        SPEC, cameras=tuple(world.images), image_size=(16, 16), state_dim=world.state_dim,
        action_dim=world.action_dim, fps=world.fps,
    )  # fmt: skip
    return DatasetConfig(repo_id="a/b", root=str(root)), spec


def test_every_frame_and_action_is_the_dataset_s(recorded: tuple[DatasetConfig, WorldModelSpec]):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset, spec = recorded
    episodes = load_episodes(dataset, spec)
    data = LeRobotDataset(dataset.repo_id, root=dataset.root)
    assert len(episodes) == data.meta.total_episodes == 6 and sum(map(len, episodes)) == len(data)
    index = 0
    for episode in episodes:
        assert episode.source == "demo" and episode.task in data.meta.tasks.index
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


def test_images_are_brought_to_size(recorded: tuple[DatasetConfig, WorldModelSpec]):
    dataset, spec = recorded
    episodes = load_episodes(dataset, replace(spec, image_size=(8, 24)))
    for small, full in zip(episodes, load_episodes(dataset, spec), strict=True):
        assert small.frames.shape == (len(full), 1, 8, 24, 3) and small.frames.dtype == np.uint8
        assert abs(small.frames.mean() - full.frames.mean()) < 2


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
            "no observation.images.corner2: the dataset has observation.images.top; choose env.camera",
        ),
        (
            {"shapes": {"action": (7,)}},
            r"action has shape \(7,\), the world's has \(4,\): it is another",
        ),
        (
            {"shapes": {"observation.state": None}},
            "observation.state has shape None, the world's has",
        ),
        ({"shapes": {"next.success": None}}, "no next.success: record it, as accerl demos does"),
        ({"fps": 10}, "10 frames a second, and the world makes 80 steps"),
        ({"total_episodes": 1}, "a single episode; at least one to learn from and one to be judged on"),
    ],
)
def test_what_cannot_be_learnt_from(changes: dict[str, Any], why: str):
    check_metadata(metadata(), "a/b", SPEC)
    with pytest.raises(InputError, match=f"^dataset.repo_id='a/b': {why}"):
        check_metadata(metadata(**changes), "a/b", SPEC)


def test_a_world_without_a_state_does_not_ask_for_one():
    check_metadata(metadata(shapes={"observation.state": None}), "a/b", replace(SPEC, state_dim=0))


def test_only_successes():
    with pytest.raises(InputError, match="no failure among 4 episodes; add failures, see demos"):
        load_episodes(TINY, SPEC)
    assert len(load_episodes(TINY, SPEC, both=False)) == 4


def test_only_failures(recorded: tuple[DatasetConfig, WorldModelSpec], monkeypatch: pytest.MonkeyPatch):
    real = module._episode
    monkeypatch.setattr(module, "_episode", lambda *args: replace(real(*args), success_at=-1))
    with pytest.raises(InputError, match="no success among 6 episodes; add episodes that succeed"):
        load_episodes(*recorded)


def test_what_is_not_a_number(
    recorded: tuple[DatasetConfig, WorldModelSpec], monkeypatch: pytest.MonkeyPatch
):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    real = LeRobotDataset.__getitem__

    def broken(self: Any, index: int) -> Any:
        item = real(self, index)
        item["action"] = item["action"] * (np.nan if index == 3 else 1)
        return item

    monkeypatch.setattr(LeRobotDataset, "__getitem__", broken)
    with pytest.raises(InputError, match="episode 0 has a NaN state or action"):
        load_episodes(*recorded)
