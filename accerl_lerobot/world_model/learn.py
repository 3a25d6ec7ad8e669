# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""One gradient step of a world model, and many of them on recorded episodes.

Learns from real frames only; what it dreams is seen as context, never as a target. The weights that serve are
a running average of those that are trained.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.episodes import Episode, Place, Windows, cut, places
from accerl_lerobot.world_model.pixels import PixelWorldModel

STATISTICS = 2048
"""Windows from which means and sizes are taken."""


@dataclass(frozen=True, kw_only=True)
class LearnConfig:
    """How a world model is trained."""

    steps: int = 2000
    """Gradient steps of the pre-training, at least 1."""
    batch: int = 16
    """Windows in each."""
    lr: float = 1e-3
    """Peak; falls to a tenth by a cosine."""
    warmup: int = 50
    """Steps in which it rises."""
    weight_decay: float = 1e-2
    grad_clip: float = 1.0
    """Largest gradient norm; > 0."""
    average: float = 0.99
    """[0, 1): how slowly the weights that serve follow those that are trained."""
    chunks: int = 2
    """Length of a window. From its second chunk on, the model learns from its own dream."""
    anchors: int = 8
    """The anchor lies up to so many chunks back, as far as dreams will go."""

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "chunks"):
            if getattr(self, name) < 1:
                raise InputError(f"learn.{name}", getattr(self, name), "use at least 1")
        for name in ("warmup", "weight_decay", "anchors"):
            if not getattr(self, name) >= 0:
                raise InputError(f"learn.{name}", getattr(self, name), "use 0 or more")
        if not 0 < self.lr < 1:
            raise InputError("learn.lr", self.lr, "use a value in (0, 1), e.g. 1e-3")
        if not self.grad_clip > 0:
            raise InputError("learn.grad_clip", self.grad_clip, "use a positive norm")
        if not 0 <= self.average < 1:
            raise InputError("learn.average", self.average, "use a value in [0, 1)")

    def lr_at(self, step: int) -> float:
        """The learning rate of a step, counted from 0; beyond `steps` it stays at its end."""
        if step < self.warmup:
            return self.lr * (step + 1) / self.warmup
        done = min(1.0, (step - self.warmup) / max(1, self.steps - self.warmup))
        return self.lr * (0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * done)))


class Learner:
    """The optimiser around a world model.

    Example:
        >>> learner = Learner(model, LearnConfig(), seed=0)
        >>> learner.step(windows)["image"]
        >>> dream = learner.serving.step(state, actions, seeds)

    Args:
        model: with its statistics fitted.
        config: how it is trained.
        seed: of noise and of what is drawn.
    """

    def __init__(self, model: PixelWorldModel, config: LearnConfig, seed: int) -> None:
        self.model, self.config = model, config
        self.serving = copy.deepcopy(model).requires_grad_(False)
        self.count = 0
        self.rng = np.random.default_rng((seed, 1))
        self._generator = torch.Generator().manual_seed(seed)
        self._optimizer = torch.optim.AdamW(model.parameters(), weight_decay=config.weight_decay)

    def draw(self, episodes: Sequence[Episode], at: Sequence[Place], count: int | None = None) -> Windows:
        """Windows at random places, all equally likely."""
        chosen = self.rng.integers(len(at), size=count or self.config.batch)
        back = self.rng.integers(self.config.anchors + 1, size=len(chosen))
        spec = self.model.spec
        return cut(
            episodes,
            [at[i] for i in chosen],
            chunk=spec.chunk,
            context=spec.context,
            chunks=self.config.chunks,
            anchors=back.tolist(),
        )

    def step(self, windows: Windows) -> dict[str, float]:
        """Learns from them once; returns the losses and ``grad_norm``."""
        for group in self._optimizer.param_groups:
            group["lr"] = self.config.lr_at(self.count)
        loss, metrics = self.model.loss(windows, self._generator)
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.config.grad_clip)
        if bool(torch.isfinite(norm)):
            self._optimizer.step()
            self._average()
        self.count += 1
        return metrics | {"loss": loss.item(), "grad_norm": norm.item()}

    def _average(self) -> None:
        # Early on, when few steps are behind it, the average is short.
        share = min(self.config.average, (1 + self.count) / (10 + self.count))
        with torch.no_grad():
            for mean, now in zip(self.serving.parameters(), self.model.parameters(), strict=True):
                mean.lerp_(now, 1 - share)


def pretrain(
    model: PixelWorldModel,
    episodes: Sequence[Episode],
    config: LearnConfig,
    seed: int,
    on_step: Callable[[int, dict[str, float]], None] = lambda step, metrics: None,
) -> Learner:
    """Fits the statistics and trains from the beginning.

    Args:
        model: new.
        episodes: to learn from; others are for judging.
        config: how.
        seed: of everything random.
        on_step: told of each step and its losses.
    """
    at = places(episodes)
    learner = Learner(model, config, seed)
    model.fit_statistics(learner.draw(episodes, at, min(STATISTICS, 4 * len(at))))
    learner.serving.load_state_dict(model.state_dict())
    for step in range(config.steps):
        on_step(step + 1, learner.step(learner.draw(episodes, at)))
    return learner
