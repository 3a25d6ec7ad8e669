# SPDX-License-Identifier: Apache-2.0
"""Gradient steps of a pixel world model and its success model, before a run and during it.

The world model trains on real frames only; its own predictions are input, never a target. The success model
trains on frames after chunks of replayed episodes, recorded ones and those that the world model predicts
from the executed actions, with the outcomes that the episodes really had. The weights that are used and saved
are a moving average of those that are trained.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import clip_grad_norm_

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.checkpoint.tensors import copied, optimizer_state, restore_optimizer
from accerl_lerobot.world_model.contract import Episode, Windows, WindowStart, cut_windows, replay
from accerl_lerobot.world_model.imagined import World

BATCH = 16  # windows per gradient step
CHUNKS = 2  # chunks of a window
SUCCESS_BATCH = 32  # frames per gradient step of the success model, half of them successes
WEIGHT_DECAY = 1e-2
GRAD_CLIP = 1.0
WARMUP = 50  # steps in which the learning rate rises
AVERAGE = 0.99  # decay of the moving average of the weights
STATISTICS_WINDOWS = 2048  # windows from which normalisation statistics are taken
REPLAYED = 48  # episodes that are replayed at a time for the success model
REFRESH_EVERY = 50  # gradient steps until others are


@kind
class Labelled(NamedTuple):
    """N frames, with their tasks' codes and outcomes."""

    frames: Tensor  # uint8 (N, V, H, W, 3)
    tasks: Tensor  # float32 (N, 16), see `experience.task_codes`
    success: Tensor  # bool (N,)


class Trainer:
    """Trains a world; `serving` is the one to use.

    Args:
        steps: gradient steps over which the learning rate falls; None: it stays.
    """

    def __init__(self, world: World, lr: float, seed: int, steps: int | None = None) -> None:
        self.world = world.train().requires_grad_(True)
        self.serving = copy.deepcopy(world).requires_grad_(False).eval()
        self.count = 0
        self.rng = np.random.default_rng((seed, 1))
        self._lr = lr
        self._steps = steps
        self._generator = torch.Generator().manual_seed(seed)
        self._optimizer = torch.optim.AdamW(world.parameters(), lr=lr, weight_decay=WEIGHT_DECAY)
        self._labelled: Labelled | None = None

    def fit_statistics(self, episodes: Sequence[Episode]) -> None:
        """Fits the statistics of a new model."""
        weights = uniform(episodes)
        self.world.model.fit_statistics(self._draw(episodes, weights, STATISTICS_WINDOWS))
        self.serving.load_state_dict(self.world.state_dict())

    def step(self, episodes: Sequence[Episode], weights: np.ndarray) -> dict[str, float]:
        """Makes a gradient step on episodes drawn by `weights`; returns the losses and ``grad_norm``.

        The success model is left out while there are only successes, or only failures.
        """
        windows = self._draw(episodes, weights, BATCH)
        loss, metrics = self.world.model.loss(windows, self._generator)
        if self._labelled is None or self.count % REFRESH_EVERY == 0:
            self._labelled = self._replayed(episodes, weights)
        if self._labelled is not None:
            success_loss = self.world.success.loss(*self._halves(self._labelled), self._generator)
            metrics["success"] = success_loss.item()
            loss = loss + success_loss
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = clip_grad_norm_(self.world.model.parameters(), GRAD_CLIP).item()
        success_norm = clip_grad_norm_(self.world.success.parameters(), GRAD_CLIP).item()
        if not math.isfinite(norm + success_norm):
            raise FloatingPointError(
                f"the world model's loss or gradient is not finite at step {self.count + 1}; "
                "lower world_model.lr; in a run, use imagination.learn.steps_per_episode=0"
            )
        for group in self._optimizer.param_groups:
            group["lr"] = self._rate()
        self._optimizer.step()
        self.count += 1
        self._average()
        return metrics | {"loss": loss.item(), "grad_norm": norm}

    def state(self) -> dict[str, Any]:
        """Copies all that `restore` needs; see `snapshot`."""
        return {
            "world": copied(self.world),
            "serving": copied(self.serving),
            "count": self.count,
            "rng": copy.deepcopy(self.rng),
            "generator": self._generator.get_state(),
            "optimizer": optimizer_state(self._optimizer),
            "labelled": self._labelled,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from a `state`."""
        self.world.load_state_dict(state["world"])
        self.serving.load_state_dict(state["serving"])
        self.count = state["count"]
        self.rng = state["rng"]
        self._labelled = state["labelled"]
        self._generator.set_state(state["generator"])
        restore_optimizer(self._optimizer, state["optimizer"])

    def _draw(self, episodes: Sequence[Episode], weights: np.ndarray, count: int) -> Windows:
        """Windows that begin at frames of equal chance in episodes drawn by `weights`."""
        chosen = self.rng.choice(len(episodes), size=count, p=weights)
        at = []
        for e in chosen.tolist():
            frame = self.rng.integers(episodes[e].starts)
            at.append(WindowStart(e, int(frame)))
        return cut_windows(episodes, at, self.world.model.spec, CHUNKS)

    def _replayed(self, episodes: Sequence[Episode], weights: np.ndarray) -> Labelled | None:
        """Frames of as many successes as failures, half of them replayed from their first frame on."""
        succeeded = np.array([episode.success for episode in episodes])
        at = []
        for of_outcome in (weights * succeeded, weights * ~succeeded):
            if not of_outcome.any():
                return None
            chances = of_outcome / of_outcome.sum()
            for e in self.rng.choice(len(episodes), size=REPLAYED // 2, p=chances).tolist():
                frame = int(self.rng.integers(episodes[e].starts_before_success))
                if self.rng.random() < 0.5:
                    frame = 0
                at.append(WindowStart(e, frame))
        windows = whole_windows(episodes, at, self.world)
        known = windows.known
        recorded = windows.frames[known]
        imagined = replay(self.serving.model, windows)[known]
        success = windows.success[known]
        return Labelled(torch.cat([recorded, imagined]), windows.known_tasks.repeat(2, 1), success.repeat(2))

    def _halves(self, labelled: Labelled) -> Labelled:
        """A batch of as many successes as failures."""
        rows = []
        for of_outcome in (labelled.success, ~labelled.success):
            candidates = of_outcome.nonzero()[:, 0].numpy()
            rows.append(self.rng.choice(candidates, SUCCESS_BATCH // 2))
        chosen = torch.from_numpy(np.concatenate(rows))
        return Labelled(*(part[chosen] for part in labelled))

    def _rate(self) -> float:
        rising = min(1.0, (self.count + 1) / WARMUP)
        if self._steps is None:
            return self._lr * rising
        done = min(1.0, self.count / self._steps)
        falling = 0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * done))
        return self._lr * rising * falling

    @torch.no_grad()
    def _average(self) -> None:
        # The average is over fewer steps at the beginning.
        decay = min(AVERAGE, self.count / (9 + self.count))
        for mean, now in zip(self.serving.parameters(), self.world.parameters(), strict=True):
            mean.lerp_(now, 1 - decay)
        for served, now in zip(self.serving.model.buffers(), self.world.model.buffers(), strict=True):
            served.copy_(now)


def uniform(episodes: Sequence[Episode]) -> np.ndarray:
    """Weights by which all frames have the same chance."""
    starts = np.array([episode.starts for episode in episodes], float)
    return starts / starts.sum()


def whole_windows(episodes: Sequence[Episode], at: Sequence[WindowStart], world: World) -> Windows:
    """Windows that go on to the end of the longest of the episodes."""
    spec = world.model.spec
    longest = max(len(episodes[start.episode]) for start in at)
    return cut_windows(episodes, at, spec, math.ceil(longest / spec.chunk))
