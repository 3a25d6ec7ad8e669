# SPDX-License-Identifier: Apache-2.0
"""Gradient steps of a pixel world model and its success model, before a run and during it.

The world model trains on real frames only; its own predictions are input, never a target. The success model
trains on frames after chunks of replayed episodes, recorded ones and those that the world model predicts
from the executed actions, with the outcomes that the episodes really had. The weights that are used and saved
are a moving average of those that are trained.

During a run half of each batch is from the recorded episodes of the pre-training, half from the policy's own
episodes: demonstrations do not show how the policy fails.
"""

from __future__ import annotations

import copy
import math
import os
import queue
import threading
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.utils import clip_grad_norm_

from accerl_lerobot import errors
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import TRAINING_STATE, WORLD_MODEL
from accerl_lerobot.checkpoint.tensors import copied, follow, optimizer_state, restore_optimizer
from accerl_lerobot.errors import InputError, step_if_finite
from accerl_lerobot.experience import REAL, Segment
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.timeline import CHECKPOINT, COMPUTE, WAIT_IN, open_clock
from accerl_lerobot.world_model.config import WORLD_LEARNING
from accerl_lerobot.world_model.contract import (
    Episode,
    Windows,
    WindowStart,
    cut_windows,
    episode_of,
    load_episodes,
    replay,
    starts_of,
)
from accerl_lerobot.world_model.imagined import World, about_learning, save_world, world_of

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import RunConfig

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
ONLINE = "online_world_model"  # name of the trainer's part of a checkpoint
ONLINE_LR = 3e-4  # learning rate during a run
MEMORY = 400  # newest episodes of the run that are trained on
MOST_PENDING = 16  # episodes whose steps may be due, where episodes come faster than it can train


@snapshot.kind
class Labelled(NamedTuple):
    """N frames, with their tasks' codes and outcomes."""

    frames: Tensor  # uint8 (N, V, H, W, 3)
    codes: Tensor  # float32 (N, 16), see `experience.task_codes`
    success: Tensor  # bool (N,)


class Trainer:
    """Trains a copy of `world`; `serving` is the one to use. Randomness is torch's global generator's.

    Args:
        recorded: episodes that it begins with.
        steps: gradient steps over which the learning rate falls; None: it stays.
        steps_per_episode: gradient steps that are due for each episode of `add`.
    """

    def __init__(
        self,
        world: World,
        recorded: Sequence[Episode],
        lr: float,
        steps: int | None = None,
        steps_per_episode: float = 0.0,
    ) -> None:
        self.world = copy.deepcopy(world).train().requires_grad_(True)
        self.serving = copy.deepcopy(world).eval().requires_grad_(False)
        self.pending_steps = 0.0  # gradient steps that are due
        self.played: deque[Episode] = deque(maxlen=MEMORY)
        self._recorded = starts_of(recorded)
        self._lr = lr
        self._steps = steps
        self._steps_per_episode = steps_per_episode
        self._optimizer = torch.optim.AdamW(self.world.parameters(), lr=lr, weight_decay=WEIGHT_DECAY)
        self._skipped_in_a_row = 0
        self._labelled: Labelled | None = None

    def fit_statistics(self) -> None:
        """Fits the statistics of a new model."""
        windows = self._cut(draw(self._groups(), STATISTICS_WINDOWS), CHUNKS)
        self.world.model.fit_statistics(windows)
        self.serving.load_state_dict(self.world.state_dict())

    def add(self, segment: Segment) -> None:
        """Takes a segment of the run; one that is a whole real episode, and is new, is learned from."""
        whole = segment.terminated and segment.origin.decision == 0
        if segment.source != REAL or not whole:
            return
        episode = episode_of(segment, self.world.model.spec)
        if episode.key in self.serving.learnt:
            return
        self.serving.learnt.append(episode.key)
        self.played.append(episode)
        due = self.pending_steps + self._steps_per_episode
        self.pending_steps = min(due, max(1.0, MOST_PENDING * self._steps_per_episode))

    def step(self) -> dict[str, float]:
        """Makes a gradient step; returns the losses and ``grad_norm``.

        The success model is left out while there are only successes, or only failures.
        """
        self.pending_steps -= 1
        count = self.serving.version
        windows = self._cut(draw(self._groups(), BATCH), CHUNKS)
        loss, metrics = self.world.model.loss(windows)
        if self._labelled is None or count % REFRESH_EVERY == 0:
            self._labelled = self._replayed()
        if self._labelled is not None:
            success_loss = self.world.success.loss(*balanced(self._labelled))
            metrics["success"] = success_loss.item()
            loss = loss + success_loss
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = clip_grad_norm_(self.world.model.parameters(), GRAD_CLIP).item()
        success_norm = clip_grad_norm_(self.world.success.parameters(), GRAD_CLIP).item()
        for group in self._optimizer.param_groups:
            group["lr"] = self._rate()
        self._skipped_in_a_row = step_if_finite(
            self._optimizer,
            "a step of the world model",
            loss.item(),
            norm + success_norm,
            self._skipped_in_a_row,
            "lower world_model.lr; in a run, use imagination.learn.steps_per_episode=0",
        )
        self.serving.version = count + 1
        # The average is over fewer steps at the beginning.
        decay = min(AVERAGE, (count + 1) / (10 + count))
        follow(self.serving, self.world, 1 - decay)
        for served, now in zip(self.serving.buffers(), self.world.buffers(), strict=True):
            served.copy_(now)
        return metrics | {"loss": loss.item(), "grad_norm": norm}

    def metrics(self) -> dict[str, float]:
        return {"learn_steps": self.serving.version, "learn_episodes": len(self.played)}

    def state(self) -> dict[str, Any]:
        """Copies all that `restore` needs; see `snapshot`."""
        return {
            "world": copied(self.world),
            "serving": copied(self.serving),
            "version": self.serving.version,
            "learnt": list(self.serving.learnt),
            "played": list(self.played),
            "pending_steps": self.pending_steps,
            "skipped_in_a_row": self._skipped_in_a_row,
            "optimizer": optimizer_state(self._optimizer),
            "labelled": self._labelled,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from a `state`."""
        self.world.load_state_dict(state["world"])
        self.serving.load_state_dict(state["serving"])
        self.serving.version = state["version"]
        self.serving.learnt = state["learnt"]
        self.played.extend(state["played"])
        self.pending_steps = state["pending_steps"]
        self._skipped_in_a_row = state["skipped_in_a_row"]
        self._labelled = state["labelled"]
        restore_optimizer(self._optimizer, state["optimizer"])

    def _groups(self) -> list[list[WindowStart]]:
        """Starts of windows in recorded and in played episodes."""
        return [self._recorded, starts_of(self.played)]

    def _cut(self, at: Sequence[WindowStart], chunks: int | None = None) -> Windows:
        return cut_windows(at, self.world.model.spec, chunks, self.world.device)

    def _replayed(self) -> Labelled | None:
        """Frames of as many successes as failures, half of them replayed from their first frame on."""
        at = []
        for outcome in (True, False):
            groups = []
            for group in self._groups():
                groups.append([start for start in group if start.episode.success == outcome])
            if not any(groups):
                return None
            at += draw(groups, REPLAYED // 2)
        at[::2] = [start._replace(frame=0) for start in at[::2]]
        windows = self._cut(at)
        known = windows.known
        imagined = replay(self.serving.model, windows)[known]
        frames = torch.cat([windows.frames[known], imagined])
        success = windows.success[known].repeat(2)
        return Labelled(frames, windows.known_codes.repeat(2, 1), success)

    def _rate(self) -> float:
        count = self.serving.version
        rate = self._lr * min(1.0, (count + 1) / WARMUP)
        if self._steps is None:
            return rate
        done = min(1.0, count / self._steps)
        return rate * (0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * done)))


def draw(groups: Sequence[list[WindowStart]], count: int) -> list[WindowStart]:
    """So many starts, from each group that has any equally many, all of a group with the same chance."""
    groups = [group for group in groups if group]
    drawn = []
    for group in groups:
        for row in torch.randint(len(group), (count // len(groups),)).tolist():
            drawn.append(group[row])
    return drawn


def balanced(labelled: Labelled) -> Labelled:
    """A batch of as many successes as failures."""
    rows = []
    for of_outcome in (labelled.success, ~labelled.success):
        candidates = of_outcome.nonzero()[:, 0]
        rows.append(candidates[torch.randint(len(candidates), (SUCCESS_BATCH // 2,))])
    chosen = torch.cat(rows)
    return Labelled(*(part[chosen] for part in labelled))


def make_trainer(config: RunConfig) -> Trainer:
    """The trainer of a run's world model, which goes on with the episodes that it was trained on."""
    learn = config.imagination.learn
    world = world_of(config.imagination)
    recorded: list[Episode] = []
    if learn.dataset.repo_id is not None:
        with about_learning():
            for episode in load_episodes(learn.dataset, world.model.spec):
                if episode.key in world.learnt:
                    recorded.append(episode)
            if not recorded:
                hint = "the world model of imagination.path was trained on no episode of it; name another"
                raise InputError("dataset.repo_id", learn.dataset.repo_id, hint)
    return Trainer(world, recorded, ONLINE_LR, steps_per_episode=learn.steps_per_episode)


def save_online(directory: Path, trainer: Trainer) -> None:
    """Writes the learned models into a checkpoint, as ``accerl world-model`` writes them."""
    save_world(directory / WORLD_MODEL, trainer.serving)


class OnlineLearningWorker:
    """The world-model process of a run that imagines; becomes a threaded Ray actor in `engines.ray_engine`.

    consumes    the trainer's batches, of which it takes whole real episodes
    produces    versions of both models, which the driver hands to the rollout workers
    waits for   a batch; no other process waits for it
    ends        with the run
    """

    def __init__(self, config: RunConfig, state: Path | None = None, timeline: Path | None = None) -> None:
        errors.collect_warnings()
        self._clock = open_clock(timeline, WORLD_LEARNING)
        torch.set_num_threads(config.trainer.num_threads)
        torch.manual_seed(config.seed)
        self._trainer = make_trainer(config)
        if state is not None:
            self._trainer.restore(snapshot.load(state / ONLINE))
        self._lock = threading.Lock()  # held while the trainer changes, for one step at a time
        self._inbox: queue.SimpleQueue[list[Segment]] = queue.SimpleQueue()
        self._publish()
        self._clock.enter(WAIT_IN)

    def ready(self) -> int:
        return os.getpid()

    def learn(self, batch: list[Segment]) -> None:
        """Leave a batch to `run`."""
        self._inbox.put(batch)

    def run(self) -> None:
        """Makes the steps that are due, until the process ends."""
        while True:
            while self._trainer.pending_steps >= 1:
                fault_point("learning.step")
                with self._lock, self._clock.during(COMPUTE):
                    self._trainer.step()
            self._publish()
            self._take()
            while not self._inbox.empty():
                self._take()

    def metrics(self) -> dict[str, float]:
        """Counts; ``version`` is that of `weights`."""
        self._clock.beat()
        return self._trainer.metrics() | {"version": self._newest[0]}

    def weights(self) -> tuple[int, dict[str, Any]]:
        """The newest version and its weights."""
        return self._newest

    def save(self, directory: Path) -> None:
        """Write the trainer's part of a checkpoint."""
        with self._lock, self._clock.during(CHECKPOINT):
            snapshot.save(directory / TRAINING_STATE / ONLINE, self._trainer.state())
            save_online(directory, self._trainer)

    def _take(self) -> None:
        batch = self._inbox.get()
        with self._lock, self._clock.during(COMPUTE):
            for segment in batch:
                self._trainer.add(segment)

    def _publish(self) -> None:
        serving = self._trainer.serving
        self._newest = (serving.version, copied(serving))
