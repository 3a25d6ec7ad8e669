# SPDX-License-Identifier: Apache-2.0
"""Training steps of a world model and of its success model.

A world model trains on real frames only; its own predictions are input, never a target. The weights that are
used and saved are a moving average of those that are trained.

A success model trains on pairs of frames that are up to a chunk apart, half of them successes. Distances are
drawn alike in successes and failures, so that they do not give the label away. Half of the pairs are
imagined, as those to be classified later: a chunk that succeeded was cut short by that, so its last action is
held to fill it up, and chunks of failures are shortened and filled up as often.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.checkpoint.tensors import copied, optimizer_state, restore_optimizer
from accerl_lerobot.experience import task_codes
from accerl_lerobot.world_model.config import LearnConfig, SuccessLearnConfig, WorldModelConfig
from accerl_lerobot.world_model.contract import LearnableWorldModel, WorldModel
from accerl_lerobot.world_model.data import (
    Episode,
    Windows,
    WindowStart,
    cut_windows,
    shuffle_actions,
    window_starts,
)
from accerl_lerobot.world_model.rollout_eval import replay
from accerl_lerobot.world_model.success_model import SuccessPairsConfig, SuccessPairsRewardModel

WEIGHT_DECAY, GRAD_CLIP = 1e-2, 1.0
WARMUP = 50  # steps in which the learning rate of a world model rises
AVERAGE = 0.99  # decay of the moving average of its weights
STATISTICS_WINDOWS = 2048  # windows from which normalisation statistics are taken
REPLAYED, REFRESH_EVERY = 48, 50
"""Episodes that are replayed at a time for a success model; gradient steps until others are."""
EASY = 0.1  # how often a failure of P(success) = 0 is drawn, beside one of P(success) = 1


class _Trainer:
    """A network with an optimiser, and random numbers of its own."""

    name: str  # in errors
    section: str

    def __init__(self, model: nn.Module, lr: float, seed: int, stream: int) -> None:
        self.model, self.count = model.train(), 0
        self.rng = np.random.default_rng((seed, stream))
        self._generator = torch.Generator().manual_seed(seed)
        self._optimizer = torch.optim.AdamW(model.parameters(), lr=lr, weight_decay=WEIGHT_DECAY)

    def _descend(self, loss: Tensor) -> float:
        """Makes a gradient step; returns the gradient's norm, or raises if the training has diverged."""
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), GRAD_CLIP)
        if not bool(torch.isfinite(norm)):
            raise FloatingPointError(
                f"the {self.name}'s loss or gradient is not finite at step {self.count + 1}; "
                f"lower {self.section}.lr; in a run, use imagination.learn.steps_per_episode=0"
            )
        self._optimizer.step()
        self.count += 1
        return norm.item()

    def state(self) -> dict[str, Any]:
        """Copies all that `restore` needs; see `snapshot`."""
        return {
            "model": copied(self.model),
            "count": self.count,
            "rng": copy.deepcopy(self.rng),
            "generator": self._generator.get_state(),
            "optimizer": optimizer_state(self._optimizer),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from a `state`."""
        self.model.load_state_dict(state["model"])
        self.count, self.rng = state["count"], state["rng"]
        self._generator.set_state(state["generator"])
        restore_optimizer(self._optimizer, state["optimizer"])


class Learner(_Trainer):
    """Trains a world model, whose statistics must be fitted; `serving` is the one to use."""

    name, section = "world model", LearnConfig.SECTION
    model: LearnableWorldModel

    def __init__(self, model: LearnableWorldModel, config: WorldModelConfig, seed: int) -> None:
        super().__init__(model, config.learn.lr, seed, 1)
        self.config = config
        self.serving = copy.deepcopy(model).requires_grad_(False).eval()

    def draw(
        self, episodes: Sequence[Episode], at: Sequence[WindowStart], count: int | None = None
    ) -> Windows:
        """Draws windows uniformly, a batch by default."""
        chosen = self.rng.integers(len(at), size=count or self.config.learn.batch)
        return self.cut(episodes, [at[i] for i in chosen])

    def cut(self, episodes: Sequence[Episode], at: Sequence[WindowStart]) -> Windows:
        """Cuts windows, with anchors as far back as rollouts will go."""
        back = self.rng.integers(self.config.longest + 1, size=len(at)).tolist()
        windows = cut_windows(episodes, at, self.model.spec, self.config.learn.chunks, back)
        return shuffle_actions(windows, self.rng) if self.config.shuffle_actions else windows

    def step(self, windows: Windows) -> dict[str, float]:
        """Makes a gradient step; returns the losses and ``grad_norm``."""
        for group in self._optimizer.param_groups:
            group["lr"] = self._lr()
        loss, metrics = self.model.loss(windows, self._generator)
        norm = self._descend(loss)
        self._average()
        return metrics | {"loss": loss.item(), "grad_norm": norm}

    def state(self) -> dict[str, Any]:
        return super().state() | {"serving": copied(self.serving)}

    def restore(self, state: dict[str, Any]) -> None:
        super().restore(state)
        self.serving.load_state_dict(state["serving"])

    def _lr(self) -> float:
        """Constant beyond `LearnConfig.steps`."""
        learn = self.config.learn
        if self.count < WARMUP:
            return learn.lr * (self.count + 1) / WARMUP
        done = min(1.0, (self.count - WARMUP) / max(1, learn.steps - WARMUP))
        return learn.lr * (0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * done)))

    @torch.no_grad()
    def _average(self) -> None:
        # The average is over fewer steps at the beginning.
        decay = min(AVERAGE, self.count / (9 + self.count))
        for mean, now in zip(self.serving.parameters(), self.model.parameters(), strict=True):
            mean.lerp_(now, 1 - decay)
        for served, now in zip(self.serving.buffers(), self.model.buffers(), strict=True):
            served.copy_(now)


def train_from_scratch(
    model: LearnableWorldModel,
    episodes: Sequence[Episode],
    config: WorldModelConfig,
    seed: int,
    on_step: Callable[[int, dict[str, float]], None] = lambda step, metrics: None,
) -> Learner:
    """Fits the statistics of a new model and trains it; `on_step` gets each step's number, from 1."""
    at, learner = window_starts(episodes), Learner(model, config, seed)
    model.fit_statistics(learner.draw(episodes, at, min(STATISTICS_WINDOWS, 4 * len(at))))
    learner.serving.load_state_dict(model.state_dict())
    for step in range(1, config.learn.steps + 1):
        on_step(step, learner.step(learner.draw(episodes, at)))
    return learner


@kind
class Pairs(NamedTuple):
    """B pairs of frames, up to a chunk apart."""

    before: np.ndarray  # uint8 (B, V, H, W, 3)
    after: np.ndarray
    task: np.ndarray  # float32 (B, 16), see `experience.task_codes`
    success: np.ndarray  # bool (B,), True if the task had been achieved by the second frame
    progress: np.ndarray  # float (B,), share of the way to the success by then; NaN for episodes without one


class Examples:
    """Examples for a success model: frames of successes and of failures, and chunks that led to them."""

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
            for f, start in enumerate(episode.times[: episode.starts].tolist()):
                self._chunks[start <= episode.success_at < start + chunk].append(WindowStart(e, f))
        for name, of in (("frames", self._frames), ("chunks", self._chunks)):
            if not of[True] or not of[False]:
                raise ValueError(f"{len(of[True])} {name} show a success and {len(of[False])} do not")

    def sample(self, count: int, rng: np.random.Generator) -> Pairs:
        """Draws recorded pairs: half successes, then as many failures, at the same distances; of these, half
        are from the last two chunks before a success, if there are any."""
        at = _halves(self._frames, count, rng)
        if near := count // 4 if self._near else 0:
            at[-near:] = [self._near[i] for i in rng.integers(len(self._near), size=near)]
        pairs = []
        for episode, f in ((self.episodes[e], f) for e, f in at):
            earlier = episode.frame_at(int(episode.times[f] - rng.integers(self.chunk + 1)))
            progress = episode.progress(int(episode.times[f]))
            code = task_codes([episode.task])[0]
            pairs.append((episode.frames[earlier], episode.frames[f], code, episode.achieved[f], progress))
        return Pairs(*map(np.stack, zip(*pairs, strict=True)))

    def chunks(self, count: int, rng: np.random.Generator) -> list[WindowStart]:
        """Draws starts of chunks: half achieved the task, then as many that did not."""
        return _halves(self._chunks, count, rng)


def _halves(of: dict[bool, list[WindowStart]], count: int, rng: np.random.Generator) -> list[WindowStart]:
    sizes = {True: count // 2, False: count - count // 2}
    return [of[k][i] for k, n in sizes.items() for i in rng.integers(len(of[k]), size=n)]


def imagine_pairs(
    examples: Examples,
    environment: WorldModel,
    success: SuccessPairsRewardModel,
    count: int,
    depth: int,
    rng: np.random.Generator,
) -> tuple[Pairs, np.ndarray]:
    """Replays `count` episodes for `depth` chunks at most, half of them successes and half from their first
    frame: pairs labelled with the real outcomes, and weights (B,) to draw them with. Failures that `success`
    classifies as successes get the largest.
    """
    at = [WindowStart(e, 0 if rng.random() < 0.5 else f) for e, f in examples.chunks(count, rng)]
    windows, predictions, executed = replay(environment, examples.episodes, at, depth, rng)
    rows, depths = np.nonzero(executed)
    begun = [(examples.episodes[at[m].episode], at[m].frame) for m in rows]
    steps = (depths + 1) * environment.spec.chunk
    progress = [e.progress(int(e.times[f]) + n) for (e, f), n in zip(begun, steps.tolist(), strict=True)]
    pairs = Pairs(
        before=predictions.frames[rows, depths],
        after=predictions.ends[rows, depths],
        task=task_codes([windows.task[m] for m in rows]),
        success=windows.success[rows, depths],
        progress=np.array(progress),
    )
    wrong = EASY + success.probabilities(*pairs[:3])
    return pairs, np.where(pairs.success, 1.0, wrong)


def draw_pairs(pairs: Pairs, weights: np.ndarray, count: int, rng: np.random.Generator) -> Pairs:
    """Draws pairs, half of them successes."""
    chosen = []
    for which, size in ((pairs.success, count // 2), (~pairs.success, count - count // 2)):
        if which.any():
            p = weights * which
            chosen += rng.choice(len(which), size=size, p=p / p.sum()).tolist()
    return Pairs(*(part[chosen] for part in pairs))


class SuccessLearner(_Trainer):
    """Trains a success model."""

    name, section = "success model", SuccessLearnConfig.SECTION
    model: SuccessPairsRewardModel

    def __init__(self, model: SuccessPairsRewardModel, config: WorldModelConfig, seed: int) -> None:
        super().__init__(model, config.success.lr, seed, 2)
        self.config = config
        self._imagined: tuple[Pairs, np.ndarray] | None = None

    def step(self, examples: Examples, environment: WorldModel) -> dict[str, float]:
        """Makes a gradient step on recorded pairs and on as many that the world model imagines."""
        batch, longest = self.config.success.batch, self.config.longest
        recorded = examples.sample(batch - batch // 2, self.rng)
        if self._imagined is None or self.count % REFRESH_EVERY == 0:
            self._imagined = imagine_pairs(examples, environment, self.model, REPLAYED, longest, self.rng)
        drawn = draw_pairs(*self._imagined, batch // 2, self.rng)
        pairs = Pairs(*(np.concatenate(both) for both in zip(recorded, drawn, strict=True)))
        before, after, task = self.model.inputs(*pairs[:3])
        success, progress = (torch.from_numpy(x.astype(np.float32)).to(before.device) for x in pairs[3:])
        loss, metrics = self.model.loss(before, after, task, success, progress, self._generator)
        self._descend(loss)
        return metrics

    def state(self) -> dict[str, Any]:
        return super().state() | {"imagined": self._imagined}

    def restore(self, state: dict[str, Any]) -> None:
        super().restore(state)
        self._imagined = state["imagined"]


def new_success_model(chunk: int) -> SuccessPairsRewardModel:
    """Builds an untrained one on the CPU."""
    return SuccessPairsRewardModel(SuccessPairsConfig(chunk=chunk, device="cpu"))
