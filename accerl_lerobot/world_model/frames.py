# SPDX-License-Identifier: Apache-2.0
"""Observations in the world model's format."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from accerl_lerobot.experience import TASK, Observation

if TYPE_CHECKING:
    from accerl_lerobot.envs.base import WorldSpec
    from accerl_lerobot.world_model.contract import WorldModelSpec


def resized(frames: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Frames uint8 (B, h, w, 3) at size (H, W); the same array if that is theirs."""
    if frames.shape[1:3] == size:
        return frames
    import torch
    from torch.nn import functional

    tall = torch.from_numpy(frames).permute(0, 3, 1, 2).float()
    tall = functional.interpolate(tall, size=size, mode="bilinear", antialias=True)
    shrunk: np.ndarray = tall.round().clamp(0, 255).byte().permute(0, 2, 3, 1).contiguous().numpy()
    return shrunk


def seen(observations: dict[str, np.ndarray], spec: WorldModelSpec) -> tuple[np.ndarray, np.ndarray]:
    """Frames uint8 (N, V, H, W, 3) and states float32 (N, S) of N observations, as a model knows them."""
    pictures = [resized(observations[camera], spec.image_size) for camera in spec.cameras]
    robot = (
        observations["observation.state"] if spec.state_dim else np.zeros((len(pictures[0]), 0), np.float32)
    )
    return np.stack(pictures, 1), robot


def observed(
    frames: np.ndarray, robot: np.ndarray, task: str, spec: WorldModelSpec, world: WorldSpec
) -> Observation:
    """A policy's observation of frames (V, H, W, 3) and a state (S,), in the sizes of its world."""
    observation: Observation = {TASK: task}
    for v, camera in enumerate(spec.cameras):
        if camera in world.images:
            observation[camera] = resized(frames[v : v + 1], world.images[camera][:2])[0]
    if world.state_dim:
        observation["observation.state"] = robot
    return observation


def executed(chunks: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """The actions (t, A) of chunks (T, K, A) of which the first `steps` (T,) each were made."""
    made: np.ndarray = chunks[np.arange(chunks.shape[1]) < steps[:, None]]
    return made
