# SPDX-License-Identifier: Apache-2.0
"""A state model of your own, which does not learn."""

from dataclasses import dataclass

import torch

from accerl_lerobot.world_model.config import StateModelConfig
from accerl_lerobot.world_model.states import StateModel


@StateModelConfig.register_subclass("small_picture")
@dataclass(frozen=True, kw_only=True)
class SmallPictureConfig(StateModelConfig):
    make = "small_picture:SmallPicture"


class SmallPicture(StateModel):
    """The first camera's image, shrunk to 4 x 4 pixels, and proprioception."""

    def __init__(self, spec, config):
        super().__init__()
        self.camera, channels = next(iter(spec.cameras.items()))
        self.size = 4 * 4 * channels + spec.state

    def encode(self, observations, tasks, elapsed):
        image = torch.from_numpy(observations[self.camera]).permute(0, 3, 1, 2).float() / 255
        small = torch.nn.functional.interpolate(image, (4, 4), mode="area").flatten(1)
        return torch.cat([small, torch.from_numpy(observations["observation.state"])], 1)
