# SPDX-License-Identifier: Apache-2.0
"""LeRobot's own processors around raw observations: they hold the tokeniser and the normalisation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from accerl_lerobot.experience import TASK, Request
from accerl_lerobot.policies.base import OBS_STATE

IMAGES = "observation.image"
"""How images' names begin: ``observation.images.<camera>``, or LeRobot's name for a lone camera."""


class Processing:
    """A policy's pre- and post-processor, fed with what worlds observe.

    Only observations and tasks pass through: a LeRobot preprocessor silently drops keys it does not know, so
    log-probs, rewards and versions travel beside it.

    Args:
        preprocessor: LeRobot's `PolicyProcessorPipeline` for inputs.
        postprocessor: the one for actions.
        device: where the network lives.
        rename_map: world feature name → policy feature name.
    """

    def __init__(
        self,
        preprocessor: Any,
        postprocessor: Any,
        device: torch.device,
        rename_map: dict[str, str] | None = None,
    ) -> None:
        self.preprocessor, self.postprocessor = preprocessor, postprocessor
        self.device = device
        self.rename_map = rename_map or {}

    def prepare(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> dict[str, Tensor]:
        """Normalises and tokenises. Images go from uint8 (..., H, W, 3) to float (..., 3, H, W) in [0, 1]."""
        batch: dict[str, Any] = {"task": list(tasks)}
        for key, array in observations.items():
            tensor = torch.from_numpy(np.ascontiguousarray(array)).to(self.device)
            if key.startswith(IMAGES):
                tensor = tensor.movedim(-1, -3).contiguous().float() / 255.0
            batch[self.rename_map.get(key, key)] = tensor
        return self.preprocessor(batch)

    def unnormalise(self, chunk: Tensor) -> Tensor:
        """(B, K, A) from normalised to environment units."""
        return self.postprocessor(chunk)

    def normalise(self, chunk: Tensor) -> Tensor:
        """(B, K, A) from environment to normalised units; every normalisation that LeRobot has is affine."""
        ends = torch.stack([torch.zeros_like(chunk[0]), torch.ones_like(chunk[0])])
        zero, one = self.unnormalise(ends.to(self.device)).to(chunk)
        return (chunk - zero) / (one - zero)


def example_observations(
    policy_config: Any, rename_map: dict[str, str]
) -> tuple[dict[str, np.ndarray], Sequence[str]]:
    """Two random observations as a world would give them to this policy, and instructions of unequal length.

    Args:
        policy_config: LeRobot's; names and sizes the inputs.
        rename_map: world feature name → policy feature name.
    """
    rng = np.random.default_rng(0)
    world_name = {policy: world for world, policy in rename_map.items()}
    observations: dict[str, np.ndarray] = {}
    for key, feature in policy_config.input_features.items():
        shape = tuple(feature.shape)
        batch = (2,) if policy_config.n_obs_steps == 1 else (2, policy_config.n_obs_steps)
        if key.startswith(IMAGES) and ".empty_camera_" not in key:
            size = (*batch, *shape[1:], shape[0])
            observations[world_name.get(key, key)] = rng.integers(0, 256, size, dtype=np.uint8)
        elif key == OBS_STATE:
            observations[world_name.get(key, key)] = rng.standard_normal((*batch, *shape), dtype=np.float32)
    return observations, ("Go", "Put the red cube on the plate")


def example_requests(policy_config: Any, rename_map: dict[str, str]) -> list[Request]:
    """`example_observations`, as rollout workers send them."""
    observations, tasks = example_observations(policy_config, rename_map)
    return [
        Request(observation={k: v[i] for k, v in observations.items()} | {TASK: task}, noise_seed=i)
        for i, task in enumerate(tasks)
    ]
