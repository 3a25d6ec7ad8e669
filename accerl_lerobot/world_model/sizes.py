# SPDX-License-Identifier: Apache-2.0
"""World models of three sizes: ``--world_model.type=tiny`` (the default), ``small`` or ``serious``.

A size is a config, not another model: any of its fields can be given beside it. ``tiny`` is what all numbers
in the documents are of. The others have their place on a GPU; what they begin with is chosen by their size,
and no run has tuned it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from accerl_lerobot.config.ranges import Range
from accerl_lerobot.world_model.config import (
    LearnableModelConfig,
    LearnConfig,
    NetworkConfig,
    PixelModelConfig,
    WorldModelConfig,
)


@WorldModelConfig.register_subclass("tiny")
@dataclass(frozen=True, kw_only=True)
class TinyConfig(WorldModelConfig):
    """64 pixels, 1.8 million weights: learns in minutes on two CPU cores."""


@WorldModelConfig.register_subclass("small")
@dataclass(frozen=True, kw_only=True)
class SmallConfig(WorldModelConfig):
    """128 pixels, 19 million weights: for one consumer GPU."""

    model: LearnableModelConfig = field(
        default_factory=lambda: PixelModelConfig(
            network=NetworkConfig(channels=(96, 192, 288), blocks=2, condition=256)
        )
    )
    learn: LearnConfig = field(
        default_factory=lambda: LearnConfig(steps=20_000, batch=32, lr=3e-4, warmup=500, average=0.999)
    )
    image_size: Annotated[int, Range("[2, 1024]")] = 128
    """Height and width in pixels of the frames it dreams."""


@WorldModelConfig.register_subclass("serious")
@dataclass(frozen=True, kw_only=True)
class SeriousConfig(WorldModelConfig):
    """224 pixels, 85 million weights: for a GPU of 80 GB."""

    model: LearnableModelConfig = field(
        default_factory=lambda: PixelModelConfig(
            network=NetworkConfig(channels=(128, 256, 512, 512), blocks=2, condition=512, planes=16)
        )
    )
    learn: LearnConfig = field(
        default_factory=lambda: LearnConfig(steps=50_000, batch=64, lr=1e-4, warmup=1000, average=0.9995)
    )
    image_size: Annotated[int, Range("[2, 1024]")] = 224
    """Height and width in pixels of the frames it dreams."""
