# SPDX-License-Identifier: Apache-2.0
"""Training steps of a world model and of its success model.

A world model trains on real frames only; its own predictions are input, never a target. The weights that are
used and saved are a moving average of those that are trained.

A success model trains on pairs of frames that are up to a chunk apart, half of them successes. Distances are
drawn alike in successes and failures, so that they do not give the label away. Some pairs are imagined, as
those to be classified later: a chunk that succeeded was cut short by that, so its last action is held to fill
it up, and chunks of failures are shortened and filled up as often.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.checkpoint.tensors import copied, optimizer_state, restore_optimizer
from accerl_lerobot.world_model.config import LearnConfig, SuccessLearnConfig
from accerl_lerobot.world_model.contract import LearnableWorldModel, WorldModel
from accerl_lerobot.world_model.data import Episode, Windows, WindowStart, cut_windows, window_starts
from accerl_lerobot.world_model.metrics import shuffle_across_groups
from accerl_lerobot.world_model.rollout_eval import replay
from accerl_lerobot.world_model.success_plugin import SuccessPairsConfig
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import (
    SuccessPairsRewardModel,
    as_floats,
    probabilities,
)

STATISTICS_WINDOWS = 2048
"""Windows from which normalisation statistics are taken."""
EASY = 0.1
"""How often a failure of P(success) = 0 is drawn, beside one of P(success) = 1."""

OnStep = Callable[[int, dict[str, float]], None]
"""Receives the number of a gradient step, from 1, and its metrics."""


class Learner:
    """Trains a world model.

    Example:
        >>> learner = Learner(model, LearnConfig(), seed=0)
        >>> learner.step(windows)["image"]
        >>> prediction = learner.serving.step(state, actions, seeds)

    The model's statistics must be fitted. With `shuffle` it is trained with the actions of other windows, as
    a placebo.
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

    def draw(
        self, episodes: Sequence[Episode], at: Sequence[WindowStart], count: int | None = None
    ) -> Windows:
        """Draws windows uniformly, a batch by default."""
        chosen = self.rng.integers(len(at), size=count or self.config.batch)
        return self.windows(episodes, [at[i] for i in chosen])

    def windows(self, episodes: Sequence[Episode], at: Sequence[WindowStart]) -> Windows:
        """Cuts windows, with anchors as far back as rollouts will go."""
        spec, config = self.model.spec, self.config
        back = self.rng.integers(config.anchors + 1, size=len(at)).tolist()
        windows = cut_windows(
            episodes, at, chunk=spec.chunk, context=spec.context, chunks=config.chunks, anchors=back
        )
        if self._shuffle:
            donors = shuffle_across_groups(len(windows), windows.episode.tolist(), self.rng)
            windows = replace(windows, actions=windows.actions[donors])
        return windows

    def step(self, windows: Windows) -> dict[str, float]:
        """Makes a gradient step; returns the losses and ``grad_norm``.

        Raises:
            FloatingPointError: the training has diverged.
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
                "lower world_model.learn.lr; in a run, use imagination.learn.steps_per_episode=0"
            )
        self._optimizer.step()
        self._average()
        self.count += 1
        return metrics | {"loss": loss.item(), "grad_norm": norm.item()}

    def state(self) -> dict[str, Any]:
        """Copies all that `restore` needs; see `snapshot`."""
        weights = {name: copied(model) for name, model in (("model", self.model), ("serving", self.serving))}
        return weights | {
            "count": self.count,
            "rng": copy.deepcopy(self.rng),
            "generator": self._generator.get_state(),
            "optimizer": optimizer_state(self._optimizer),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from a `state`."""
        self.model.load_state_dict(state["model"])
        self.serving.load_state_dict(state["serving"])
        self.count, self.rng = state["count"], state["rng"]
        self._generator.set_state(state["generator"])
        restore_optimizer(self._optimizer, state["optimizer"])

    def _average(self) -> None:
        # The average is over fewer steps at the beginning.
        decay = min(self.config.average, (1 + self.count) / (10 + self.count))
        with torch.no_grad():
            for mean, now in zip(self.serving.parameters(), self.model.parameters(), strict=True):
                mean.lerp_(now, 1 - decay)
            for served, now in zip(self.serving.buffers(), self.model.buffers(), strict=True):
                served.copy_(now)


def train_from_scratch(
    model: LearnableWorldModel,
    episodes: Sequence[Episode],
    config: LearnConfig,
    seed: int,
    *,
    shuffle: bool = False,
    on_step: OnStep = lambda step, metrics: None,
) -> Learner:
    """Fits the statistics of a new model and trains it."""
    at = window_starts(episodes)
    learner = Learner(model, config, seed, shuffle)
    model.fit_statistics(learner.draw(episodes, at, min(STATISTICS_WINDOWS, 4 * len(at))))
    learner.serving.load_state_dict(model.state_dict())
    for step in range(1, config.steps + 1):
        on_step(step, learner.step(learner.draw(episodes, at)))
    return learner


# The success model.

Pairs = tuple[np.ndarray, ...]
"""The frames before and after, uint8 (B, V, H, W, 3) each; bool (B,), True if the latter shows a success; and
float (B,), the progress by then, NaN for episodes without a success."""


class Examples:
    """Examples for a success model: frames of successes and of failures, and chunks that led to them.

    Raises:
        ValueError: there is no frame, or no chunk, of either kind.
    """

    def __init__(self, episodes: Sequence[Episode], chunk: int) -> None:
        self.episodes, self.chunk = episodes, chunk
        self._frames: dict[bool, list[WindowStart]] = {True: [], False: []}
        self._chunks: dict[bool, list[WindowStart]] = {True: [], False: []}
        self._near: list[WindowStart] = []
        for e, episode in enumerate(episodes):
            for f, achieved in enumerate(episode.achieved):
                self._frames[bool(achieved)].append(WindowStart(e, f))
                if not achieved and episode.success and episode.success_at - episode.times[f] < 2 * chunk:
                    self._near.append(WindowStart(e, f))
        for e, episode in enumerate(episodes):
            for f in range(episode.starts):
                start = int(episode.times[f])
                self._chunks[start <= episode.success_at < start + chunk].append(WindowStart(e, f))
        for name, of in (("frames", self._frames), ("chunks", self._chunks)):
            if not of[True] or not of[False]:
                raise ValueError(f"{len(of[True])} {name} show a success and {len(of[False])} do not")

    def sample(self, count: int, rng: np.random.Generator) -> Pairs:
        """Draws recorded pairs: half successes, then as many failures, at the same distances; of these, half
        are from the last two chunks before a success, if there are any."""
        later = self._halves(self._frames, count, rng)
        near = count // 4 if self._near else 0
        if near:
            later[-near:] = [self._near[i] for i in rng.integers(len(self._near), size=near)]
        earlier = []
        for at in later:
            times = self.episodes[at.episode].times
            then = times[at.frame] - rng.integers(self.chunk + 1)
            earlier.append(WindowStart(at.episode, max(0, int(np.searchsorted(times, then, "right")) - 1)))
        before, after = (
            np.stack([self.episodes[e].frames[f] for e, f in frames]) for frames in (earlier, later)
        )
        success = np.array([self.episodes[e].achieved[f] for e, f in later])
        return before, after, success, np.array([self.progress(at) for at in later])

    def chunks(self, count: int, rng: np.random.Generator) -> list[WindowStart]:
        """Draws starts of chunks: half achieved the task, then as many that did not."""
        return self._halves(self._chunks, count, rng)

    def progress(self, at: WindowStart, ahead: int = 0) -> float:
        """Share of the way to the episode's success, `ahead` env steps later; NaN without a success."""
        episode = self.episodes[at.episode]
        if not episode.success:
            return float("nan")
        return min(1.0, (int(episode.times[at.frame]) + ahead) / max(1, episode.success_at))

    def _halves(
        self, of: dict[bool, list[WindowStart]], count: int, rng: np.random.Generator
    ) -> list[WindowStart]:
        sizes = {True: count // 2, False: count - count // 2}
        return [of[k][i] for k, n in sizes.items() for i in rng.integers(len(of[k]), size=n)]


@kind
@dataclass(frozen=True, kw_only=True)
class ImaginedPairs:
    """Pairs of frames from imagined replays of episodes, labelled with the real outcomes."""

    before: np.ndarray
    """uint8 (M, V, H, W, 3)."""
    after: np.ndarray
    """uint8 (M, V, H, W, 3), a chunk later."""
    success: np.ndarray
    """bool (M,), True if the task had been achieved by then."""
    progress: np.ndarray
    """float (M,), see `Examples.progress`."""
    weights: np.ndarray
    """float (M,), how often each is drawn."""

    @classmethod
    def imagine(
        cls,
        examples: Examples,
        world: WorldModel,
        success: SuccessPairsRewardModel,
        count: int,
        depth: int,
        rng: np.random.Generator,
    ) -> ImaginedPairs:
        """Replays `count` episodes for `depth` chunks at most, half of them successes and half from their
        first frame; failures that `success` classifies as successes get the largest weights.
        """
        at = [WindowStart(e, 0 if rng.random() < 0.5 else f) for e, f in examples.chunks(count, rng)]
        replayed = replay(world, examples.episodes, at, depth, rng)
        rows, depths = np.nonzero(replayed.executed)
        achieved = replayed.windows.success[rows, depths]
        before = np.stack([replayed.before(d)[m] for m, d in zip(rows, depths, strict=True)])
        after = replayed.predictions.ends[rows, depths]
        progress = np.array(
            [examples.progress(at[m], (d + 1) * world.spec.chunk) for m, d in zip(rows, depths, strict=True)]
        )
        weights = np.where(achieved, 1.0, EASY + probabilities(success, before, after))
        return cls(before=before, after=after, success=achieved, progress=progress, weights=weights)

    def sample(self, count: int, rng: np.random.Generator) -> Pairs:
        """Draws pairs, half of them successes."""
        chosen = []
        for which, size in ((self.success, count // 2), (~self.success, count - count // 2)):
            if which.any():
                weights = self.weights * which
                chosen += rng.choice(len(which), size=size, p=weights / weights.sum()).tolist()
        return self.before[chosen], self.after[chosen], self.success[chosen], self.progress[chosen]


class SuccessLearner:
    """Trains a success model."""

    def __init__(self, model: SuccessPairsRewardModel, config: SuccessLearnConfig, seed: int) -> None:
        self.model, self.config = model.train(), config
        self.rng = np.random.default_rng((seed, 2))
        self._generator = torch.Generator().manual_seed(seed)
        self._imagined: ImaginedPairs | None = None
        self._count = 0
        self._optimizer = torch.optim.AdamW(
            model.parameters(), lr=config.lr, weight_decay=config.weight_decay
        )

    def step(self, examples: Examples, world: WorldModel) -> dict[str, float]:
        """Makes a gradient step on recorded pairs and on pairs that the world model imagines.

        Raises:
            FloatingPointError: the training has diverged.
        """
        config = self.config
        imagined = round(config.imagined * config.batch)
        parts = []
        if imagined < config.batch:
            parts.append(examples.sample(config.batch - imagined, self.rng))
        if imagined:
            if self._imagined is None or self._count % config.refresh_every == 0:
                sizes = (config.episodes, config.depth)
                self._imagined = ImaginedPairs.imagine(examples, world, self.model, *sizes, self.rng)
            parts.append(self._imagined.sample(imagined, self.rng))
        self._count += 1
        before, after, success, progress = (np.concatenate(x) for x in zip(*parts, strict=True))
        device = self.model.out.weight.device
        loss, metrics = self.model.loss(
            as_floats(before, device),
            as_floats(after, device),
            torch.from_numpy(success.astype(np.float32)).to(device),
            torch.from_numpy(progress.astype(np.float32)).to(device),
            self._generator,
        )
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), 1.0)
        if not bool(torch.isfinite(norm)):
            raise FloatingPointError(
                f"the success model's loss or gradient is not finite at step {self._count}; "
                "lower world_model.success.lr; in a run, use imagination.learn.steps_per_episode=0"
            )
        self._optimizer.step()
        return metrics

    def state(self) -> dict[str, Any]:
        """Copies all that `restore` needs; see `snapshot`."""
        return {
            "model": copied(self.model),
            "count": self._count,
            "rng": copy.deepcopy(self.rng),
            "generator": self._generator.get_state(),
            "optimizer": optimizer_state(self._optimizer),
            "imagined": self._imagined,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from a `state`."""
        self.model.load_state_dict(state["model"])
        self._count, self.rng, self._imagined = state["count"], state["rng"], state["imagined"]
        self._generator.set_state(state["generator"])
        restore_optimizer(self._optimizer, state["optimizer"])


def new_success_model(chunk: int) -> SuccessPairsRewardModel:
    """Builds an untrained one on the CPU."""
    return SuccessPairsRewardModel(SuccessPairsConfig(chunk=chunk, device="cpu"))
