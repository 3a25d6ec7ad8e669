# SPDX-License-Identifier: Apache-2.0
"""The committed dataset is what its card says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from accerl_lerobot.demos.record import SIDECAR
from accerl_lerobot.envs import EnvConfig, make_world

ROOT = Path(__file__).parents[2] / "datasets" / "metaworld_tiny"


def test_its_size_and_place():
    assert sum(path.stat().st_size for path in ROOT.rglob("*") if path.is_file()) < 5_000_000
    assert not list(ROOT.parent.rglob("__init__.py")), "a package here would shadow Hugging Face's datasets"


def test_replaying_its_actions_gives_its_frames():
    draccus = pytest.importorskip("draccus")
    pytest.importorskip("metaworld")
    lerobot_dataset = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    dataset = lerobot_dataset.LeRobotDataset("accerl/metaworld_tiny", root=ROOT, video_backend="pyav")
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (4, 365, 80)
    sidecar = json.loads((ROOT / SIDECAR).read_text())
    world = make_world(draccus.decode(EnvConfig, sidecar["env"]))
    observation, reward = world.reset(0, "drawer-open-v3"), 0.0
    for index in range(dataset.meta.episodes[0]["length"]):
        row = dataset[index]
        # Bit-equal on the machine that recorded it; another processor or OpenGL may round differently.
        assert np.allclose(row["observation.state"].numpy(), observation["observation.state"], atol=1e-3)
        if index % 10 == 0:
            stored = (row["observation.images.corner2"] * 255).round().byte().permute(1, 2, 0).numpy()
            assert np.abs(stored - observation["observation.images.corner2"].astype(int)).mean() < 2
        result = world.step_chunk(row["action"].numpy()[None])
        observation, reward = result.observation, float(row["next.reward"])
        assert result.rewards[0] == reward
    assert result.terminated and reward == 1.0
    world.close()
