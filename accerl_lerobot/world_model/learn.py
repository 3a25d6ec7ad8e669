# SPDX-License-Identifier: Apache-2.0
"""One gradient step of a world model, and many of them on recorded episodes.

Learns from real frames only; what it dreams is seen as context, never as a target. The weights that serve are
a running average of those that are trained.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from accerl_lerobot.checkpoint.tensors import copied, optimizer_state, restore_optimizer
from accerl_lerobot.world_model.config import LearnConfig
from accerl_lerobot.world_model.contract import LearnableWorldModel, WorldModelSpec
from accerl_lerobot.world_model.episodes import Episode, Place, Windows, cut, places
from accerl_lerobot.world_model.judge import shuffled

STATISTICS = 2048
"""Windows from which means and sizes are taken."""
VALIDATED = 64
"""Held-out windows at most of which the loss is taken."""


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
        shuffle: learn with the actions of other windows, as a placebo.
    """

    def __init__(
        self, model: LearnableWorldModel, config: LearnConfig, seed: int, shuffle: bool = False
    ) -> None:
        self.model, self.config, self._shuffle = model, config, shuffle
        self.serving = copy.deepcopy(model).requires_grad_(False).eval()
        model.train()
        self.count = 0
        self.rng = np.random.default_rng((seed, 1))
        self._generator = torch.Generator().manual_seed(seed)
        self._optimizer = torch.optim.AdamW(model.parameters(), weight_decay=config.weight_decay)

    def draw(self, episodes: Sequence[Episode], at: Sequence[Place], count: int | None = None) -> Windows:
        """Windows at random places, all equally likely."""
        chosen = self.rng.integers(len(at), size=count or self.config.batch)
        return self.windows(episodes, [at[i] for i in chosen])

    def windows(self, episodes: Sequence[Episode], at: Sequence[Place]) -> Windows:
        """Windows at these places, with anchors as far back as dreams will go."""
        windows = _windows(episodes, at, self.model.spec, self.config, self.rng)
        if self._shuffle:
            donors = shuffled(len(windows), windows.episode.tolist(), self.rng)
            windows = replace(windows, actions=windows.actions[donors])
        return windows

    def step(self, windows: Windows) -> dict[str, float]:
        """Learns from them once; returns the losses and ``grad_norm``.

        Raises:
            FloatingPointError: it has diverged.
        """
        for group in self._optimizer.param_groups:
            group["lr"] = self.config.lr_at(self.count)
        loss, metrics = self.model.loss(windows, self._generator)
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.config.grad_clip)
        if not bool(torch.isfinite(norm)):
            raise FloatingPointError(
                f"the world model's loss or gradient is not finite at step {self.count + 1}; "
                "lower world_model.learn.lr, or imagination.learn.lr in a run"
            )
        self._optimizer.step()
        self._average()
        self.count += 1
        return metrics | {"loss": loss.item(), "grad_norm": norm.item()}

    def state(self) -> dict[str, Any]:
        """A copy of all that `restore` needs; see `snapshot`."""
        weights = {name: copied(model) for name, model in (("model", self.model), ("serving", self.serving))}
        return weights | {
            "count": self.count,
            "rng": copy.deepcopy(self.rng),
            "generator": self._generator.get_state(),
            "optimizer": optimizer_state(self._optimizer),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from what `state` gave."""
        self.model.load_state_dict(state["model"])
        self.serving.load_state_dict(state["serving"])
        self.count, self.rng = state["count"], state["rng"]
        self._generator.set_state(state["generator"])
        restore_optimizer(self._optimizer, state["optimizer"])

    def _average(self) -> None:
        # Early on, when few steps are behind it, the average is short.
        share = min(self.config.average, (1 + self.count) / (10 + self.count))
        with torch.no_grad():
            for mean, now in zip(self.serving.parameters(), self.model.parameters(), strict=True):
                mean.lerp_(now, 1 - share)
            for served, now in zip(self.serving.buffers(), self.model.buffers(), strict=True):
                served.copy_(now)


class Validation:
    """The loss on windows that are not learnt from, always the same ones with the same noise.

    Of the weights that serve, and with the true actions, of a placebo too. It has draws of its own: what is
    learnt is the same with it and without it.

    Args:
        episodes: that are held out; something follows a frame of theirs.
        spec: of the world.
        config: how the model is trained: the windows are like those.
        seed: of which windows, and of the noise.
    """

    def __init__(
        self, episodes: Sequence[Episode], spec: WorldModelSpec, config: LearnConfig, seed: int
    ) -> None:
        at, rng = places(episodes), np.random.default_rng((seed, 9))
        chosen = rng.choice(len(at), min(VALIDATED, len(at)), replace=False)
        self._windows = _windows(episodes, [at[i] for i in chosen], spec, config, rng)
        self._seed = seed

    @torch.no_grad()
    def __call__(self, model: LearnableWorldModel) -> dict[str, float]:
        """As `Learner.step`'s, without ``grad_norm``."""
        loss, metrics = model.loss(self._windows, torch.Generator().manual_seed(self._seed))
        return metrics | {"loss": loss.item()}


def pretrain(
    model: LearnableWorldModel,
    episodes: Sequence[Episode],
    config: LearnConfig,
    seed: int,
    shuffle: bool = False,
    on_step: Callable[[int, dict[str, float]], None] = lambda step, metrics: None,
    held_out: Sequence[Episode] = (),
    on_held_out: Callable[[int, dict[str, float]], None] = lambda step, metrics: None,
) -> Learner:
    """Fits the statistics and trains from the beginning.

    Args:
        model: new.
        episodes: to learn from; others are for judging.
        config: how.
        seed: of everything random.
        shuffle: see `Learner`.
        on_step: told of each step and its losses.
        held_out: episodes that are only looked at.
        on_held_out: told of their losses, every `LearnConfig.validate_every` steps, see `Validation`.
    """
    at = places(episodes)
    learner = Learner(model, config, seed, shuffle)
    model.fit_statistics(learner.draw(episodes, at, min(STATISTICS, 4 * len(at))))
    learner.serving.load_state_dict(model.state_dict())
    validation = None
    if config.validate_every and places(held_out):
        validation = Validation(held_out, model.spec, config, seed)
    for step in range(1, config.steps + 1):
        on_step(step, learner.step(learner.draw(episodes, at)))
        if validation is not None and step % config.validate_every == 0:
            on_held_out(step, validation(learner.serving))
    return learner


def _windows(
    episodes: Sequence[Episode],
    at: Sequence[Place],
    spec: WorldModelSpec,
    config: LearnConfig,
    rng: np.random.Generator,
) -> Windows:
    """Windows at these places; `rng` draws how far back their anchors lie."""
    back = rng.integers(config.anchors + 1, size=len(at))
    return cut(
        episodes,
        at,
        chunk=spec.chunk,
        context=spec.context,
        chunks=config.chunks,
        anchors=back.tolist(),
    )
