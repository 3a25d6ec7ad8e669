# SPDX-License-Identifier: Apache-2.0
"""Two cameras that have nothing to do with each other: a dot in either, which goes its own way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from accerl_lerobot.world_model.config import LearnConfig, PixelModelConfig
from accerl_lerobot.world_model.episodes import Episode, Windows
from accerl_lerobot.world_model.judge import skill, squared_errors
from accerl_lerobot.world_model.learn import pretrain
from accerl_lerobot.world_model.pixels import PixelWorldModel
from tests.world_model.test_pixels import NETWORK, SIZE, SPEC, dots, dream, windows

TWO = replace(SPEC, cameras=("observation.images.top", "observation.images.wrist"))


def drawn(at: np.ndarray) -> np.ndarray:
    """A black square on light grey, uint8 (H, W, 3)."""
    frame = np.full((SIZE, SIZE, 3), 180, np.uint8)
    y, x = np.round(at).astype(int)
    frame[y : y + 4, x : x + 4] = 20
    return frame


def gone(at: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Where the second camera's dot is after these actions (K, A): it goes the other way."""
    for action in actions:
        at = np.clip(at - 2 * action, 0, SIZE - 4)
    return at


def seen_twice(episodes: list[Episode], seed: int) -> tuple[list[Episode], list[np.ndarray]]:
    """With a second camera, and where its dot is at each frame."""
    rng, made, paths = np.random.default_rng(seed), [], []
    for episode in episodes:
        path = [rng.uniform(2, SIZE - 6, 2)]
        for action in episode.actions[:-1]:
            path.append(gone(path[-1], action[None]))
        second = np.stack([drawn(at) for at in path])[:, None]
        made.append(replace(episode, frames=np.concatenate([episode.frames, second], 1)))
        paths.append(np.stack(path))
    return made, paths


def new(seed: int = 0) -> PixelWorldModel:
    torch.manual_seed(seed)
    return PixelWorldModel(TWO, PixelModelConfig(network=NETWORK))


def swapped(of: Windows) -> Windows:
    """Each camera shows what the other one did."""
    return replace(of, frames=of.frames[:, :, ::-1].copy(), anchor=of.anchor[:, ::-1].copy())


def test_frames_go_in_and_come_out_in_the_order_of_the_cameras():
    """A new model is a copy of the last frame."""
    of = windows(seen_twice(dots(2), 1)[0])
    for shown in (of, swapped(of)):
        frames = dream(new(), shown)[0].frames.numpy()
        assert frames.shape[1:] == (2, SIZE, SIZE, 3) and np.array_equal(frames, shown.frames[:, 1])
    assert not np.array_equal(of.frames[:, 1, 0], of.frames[:, 1, 1])


@pytest.fixture(scope="module")
def learnt() -> PixelWorldModel:
    config = LearnConfig(steps=200, batch=16, lr=2e-3, warmup=10, anchors=3)
    return pretrain(new(), seen_twice(dots(60), 1)[0], config, seed=0).serving


def skills(frames: np.ndarray, wanted: np.ndarray, newest: np.ndarray, of: Windows) -> list[float]:
    """Skill for each camera, frames uint8 (B, V, H, W, 3)."""
    return [
        skill(
            squared_errors(frames[:, v : v + 1], wanted[:, v : v + 1]),
            squared_errors(newest[:, v : v + 1], wanted[:, v : v + 1]),
            of.episode,
        ).value
        for v in range(2)
    ]


def test_either_camera_is_dreamt_in_its_place(learnt: PixelWorldModel):
    of = windows(seen_twice(dots(12, seed=5), 6)[0])
    frames, wanted = dream(learnt, of)[0].frames.numpy(), of.frames[:, 2]
    assert min(skills(frames, wanted, of.frames[:, 1], of)) > 0.4
    # Each looks like its own camera, and nothing like the other one.
    crossed = squared_errors(frames[:, ::-1], wanted).mean()
    assert crossed > 10 * squared_errors(frames, wanted).mean()


def test_what_a_camera_will_show_is_told_by_what_it_has_shown(learnt: PixelWorldModel):
    """The second one shows another episode, the first one and the actions are as they were."""
    episodes, paths = seen_twice(dots(12, seed=5), 6)
    of = windows(episodes)
    count = len(of) // len(episodes)
    donors = np.roll(np.arange(len(of)), count)
    frames, anchor = of.frames.copy(), of.anchor.copy()
    frames[:, :, 1], anchor[:, 1] = of.frames[donors, :, 1], of.anchor[donors, 1]
    mixed = replace(of, frames=frames, anchor=anchor)
    starts = [paths[e][i % count] for i, e in enumerate(of.episode)]
    second = np.stack([drawn(gone(starts[j], of.actions[i, 0])) for i, j in enumerate(donors)])
    wanted = np.stack([of.frames[:, 2, 0], second], 1)
    got, before = (dream(learnt, shown)[0].frames.numpy() for shown in (mixed, of))
    assert min(skills(got, wanted, mixed.frames[:, 1], of)) > 0.3
    # The first camera hardly notices.
    moved = [squared_errors(got[:, v : v + 1], before[:, v : v + 1]).mean() for v in range(2)]
    assert moved[0] < moved[1] / 10
