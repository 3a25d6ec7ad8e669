# SPDX-License-Identifier: Apache-2.0
"""Training of world model and success model: held-out losses, divergence, two cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from accerl_lerobot.world_model.config import (
    PixelModelConfig,
    SuccessLearnConfig,
    WorldModelConfig,
)
from accerl_lerobot.world_model.data import Episode, Windows
from accerl_lerobot.world_model.learners import (
    Examples,
    SuccessLearner,
    new_success_model,
)
from accerl_lerobot.world_model.pixels import PixelWorldModel
from tests.world_model.test_pixels import CHANNELS, SIZE, SPEC, K, dots, rollout, windows
from tests.world_model.test_validate import Deterministic, with_successes

CONFIG = WorldModelConfig(success=SuccessLearnConfig(batch=8), longest=2)


def examples(seed: int) -> Examples:
    return Examples(with_successes(dots(30, seed=seed)), K)


def new() -> SuccessLearner:
    torch.manual_seed(0)
    return SuccessLearner(new_success_model(K), CONFIG, seed=0)


def test_a_model_that_diverges_is_an_error_and_stays_as_it_was():
    learner, of, world = new(), examples(1), Deterministic("exact")
    learner.step(of, world)
    with torch.no_grad():
        learner.model.out.bias.fill_(torch.nan)
    before = {k: v.clone() for k, v in learner.model.state_dict().items()}
    with pytest.raises(
        FloatingPointError,
        match=r"^the success model's .* not finite at step 2; lower world_model.success.lr",
    ):
        learner.step(of, world)
    now = learner.model.state_dict()
    assert all(torch.equal(v, now[k]) for k, v in before.items() if k != "out.bias")


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


def two_cameras(seed: int = 0) -> PixelWorldModel:
    torch.manual_seed(seed)
    return PixelWorldModel(TWO, PixelModelConfig(channels=CHANNELS))


def swapped(of: Windows) -> Windows:
    """Each camera shows what the other one did."""
    return replace(of, frames=of.frames[:, :, ::-1].copy(), anchor=of.anchor[:, ::-1].copy())


def test_frames_go_in_and_come_out_in_the_order_of_the_cameras():
    """A new model is a copy of the last frame."""
    of = windows(seen_twice(dots(2), 1)[0])
    for shown in (of, swapped(of)):
        frames = rollout(two_cameras(), shown)[0].frames.numpy()
        assert frames.shape[1:] == (2, SIZE, SIZE, 3) and np.array_equal(frames, shown.frames[:, 1])
    assert not np.array_equal(of.frames[:, 1, 0], of.frames[:, 1, 1])
