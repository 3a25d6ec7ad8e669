# SPDX-License-Identifier: Apache-2.0
"""The latent world model with few first steps, as another package would register it."""

from __future__ import annotations

from dataclasses import dataclass

from accerl_lerobot.world_model.config import LatentConfig, StateModelConfig
from accerl_lerobot.world_model.latent import LatentModel


@StateModelConfig.register_subclass("small_latent")
@dataclass(frozen=True, kw_only=True)
class SmallLatentConfig(LatentConfig):
    make = "tests.world_model.small_latent:SmallLatent"

    latents: int = 8


class SmallLatent(LatentModel):
    first_steps = 20
