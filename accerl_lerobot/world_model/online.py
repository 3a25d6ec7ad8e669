# SPDX-License-Identifier: Apache-2.0
"""Training of a pixel world model on the policy's episodes during a run.

Half of each batch is from the pre-training data, half from the policy's episodes: demonstrations do not show
how the policy fails.
"""

from __future__ import annotations

import copy
import os
import threading
from collections import OrderedDict, deque
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from accerl_lerobot import errors
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import TRAINING_STATE, WORLD_MODEL
from accerl_lerobot.checkpoint.tensors import copied
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import REAL, Segment
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.timeline import CHECKPOINT, COMPUTE, WAIT_IN, open_clock
from accerl_lerobot.world_model.config import WORLD_LEARNING, OnlineLearnConfig
from accerl_lerobot.world_model.contract import Episode, WorldModelSpec, load_episodes, model_arrays
from accerl_lerobot.world_model.imagined import LEARN, World, read_content, save_world, world_of, world_path
from accerl_lerobot.world_model.training import Trainer, uniform

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import RunConfig

ONLINE = "online_world_model"  # name of its part of a checkpoint
LEARNING_RATE = 3e-4
MEMORY = 400  # real episodes kept for training
MOST_PENDING = 16  # episodes whose steps may be due, where episodes come faster than it can train
MOST_UNFINISHED = 1024
"""Incomplete episodes; of more the oldest are dropped, such as those of a worker that died."""


def episode_from_segments(segments: Sequence[Segment], spec: WorldModelSpec) -> Episode:
    """Joins the segments of a whole episode, in order; it has a frame per decision."""
    # A segment's first observation is the last one of the segment before.
    *others, last = segments
    parts = [{name: rows[:-1] for name, rows in segment.observations.items()} for segment in others]
    parts.append(last.observations)
    observations = {name: np.concatenate([part[name] for part in parts]) for name in last.observations}
    frames, robot = model_arrays(observations, spec)
    steps = np.concatenate([segment.steps for segment in segments])
    chunks = np.concatenate([segment.actions for segment in segments])
    actions = chunks[np.arange(chunks.shape[1]) < steps[:, None]]
    success_at = -1
    if last.success:
        success_at = len(actions) - 1
    return Episode(
        frames=frames,
        times=np.concatenate([[0], np.cumsum(steps)]).astype(np.int64),
        state=robot,
        actions=actions,
        success_at=success_at,
        task=last.task,
    )


class OnlineLearner:
    """Trains a copy of a world as real segments come in: `add`, and `step` while steps are pending.

    Args:
        offline: episodes of the pre-training, in which it goes on to be trained.
        learnt: keys of all episodes of the pre-training.
    """

    def __init__(
        self,
        world: World,
        config: OnlineLearnConfig,
        offline: Sequence[Episode] = (),
        learnt: Collection[str] = (),
        seed: int = 0,
    ) -> None:
        self.config = config
        self.learnt = set(learnt)
        self.pending_steps = 0.0  # gradient steps that are due
        self._trainer = Trainer(copy.deepcopy(world), LEARNING_RATE, seed)
        self._offline = list(offline)
        self._own: deque[Episode] = deque(maxlen=MEMORY)
        self._unfinished: OrderedDict[tuple[str, int], dict[int, Segment]] = OrderedDict()
        self._ended: set[tuple[str, int]] = set()  # episodes whose segments a trainer may draw again

    @property
    def version(self) -> int:
        """Gradient steps made."""
        return self._trainer.count

    @property
    def world(self) -> World:
        """The models to use now, which share their weights with this learner."""
        world = self._trainer.serving
        world.version = self.version
        return world

    def add(self, segment: Segment) -> None:
        """Takes a real segment, once."""
        name = segment.origin[:2]
        if segment.source != REAL or name in self._ended:
            return
        parts = self._unfinished.setdefault(name, {})
        parts[segment.origin.decision] = segment
        if len(self._unfinished) > MOST_UNFINISHED:
            self._unfinished.popitem(last=False)
        ordered = [parts[decision] for decision in sorted(parts)]
        last = ordered[-1]
        if not last.terminated or sum(map(len, ordered)) != last.origin.decision + len(last):
            return
        self._unfinished.pop(name, None)
        self._ended.add(name)
        episode = episode_from_segments(ordered, self._trainer.world.model.spec)
        self._own.append(episode)
        self.learnt.add(episode.key)
        more = self.config.steps_per_episode
        most = max(1.0, MOST_PENDING * more)
        self.pending_steps = min(self.pending_steps + more, most)

    def step(self) -> dict[str, float]:
        """Makes one gradient step of both models."""
        self.pending_steps -= 1
        episodes = [*self._offline, *self._own]
        weights = uniform(self._own)
        if self._offline:
            weights = np.concatenate([uniform(self._offline), weights]) / 2
        return self._trainer.step(episodes, weights)

    def state(self) -> dict[str, Any]:
        """Copies all that `restore` needs."""
        return {
            "pending_steps": self.pending_steps,
            "learnt": sorted(self.learnt),
            "trainer": self._trainer.state(),
            "own": list(self._own),
            "unfinished": {name: dict(parts) for name, parts in self._unfinished.items()},
            "ended": sorted(self._ended),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from a `state`."""
        self.pending_steps = state["pending_steps"]
        self.learnt = set(state["learnt"])
        self._trainer.restore(state["trainer"])
        self._own.extend(state["own"])
        self._unfinished.update(state["unfinished"])
        self._ended.update(state["ended"])

    def metrics(self) -> dict[str, float]:
        return {"learn_steps": float(self.version), "learn_episodes": float(len(self._own))}


def make_learner(config: RunConfig) -> OnlineLearner:
    """The learner of a run's world model, which starts at the saved one and goes on with its episodes."""
    imagination = config.imagination
    dataset = imagination.learn.dataset
    world = world_of(imagination)
    learnt = set(read_content(world_path(imagination), "imagination").get("learnt") or ())
    offline: list[Episode] = []
    if dataset.repo_id is not None:
        episodes = load_episodes(dataset, world.model.spec, LEARN)
        offline = [episode for episode in episodes if episode.key in learnt]
        if not offline:
            hint = "the world model of imagination.path was trained on no episode of it; name another"
            raise InputError(f"{LEARN}.repo_id", dataset.repo_id, hint)
    return OnlineLearner(world, imagination.learn, offline, learnt, config.seed)


def save_online(directory: Path, learner: OnlineLearner) -> None:
    """Writes the learned models into a checkpoint, as ``accerl world-model`` writes them."""
    save_world(directory / WORLD_MODEL, learner.world, learner.learnt)


class OnlineLearningWorker:
    """The world-model process of a run that imagines; becomes a threaded Ray actor in `launch`.

    consumes    the trainer's batches, of which it takes the real segments
    produces    versions of both models, which the driver hands to the rollout workers
    waits for   a batch; no other process waits for it
    ends        with the run
    """

    def __init__(self, config: RunConfig, state: Path | None = None, timeline: Path | None = None) -> None:
        errors.collect_warnings()
        self._clock = open_clock(timeline, WORLD_LEARNING)
        import torch

        torch.set_num_threads(config.trainer.num_threads)
        torch.manual_seed(config.seed)
        self._learner = make_learner(config)
        if state is not None:
            self._learner.restore(snapshot.load(state / ONLINE))
        self._lock = threading.Lock()  # held while the learner changes, for one step at a time
        self._learning = threading.Lock()  # held by the call that makes the steps
        self._inbox: deque[Segment] = deque()
        self._failure: Exception | None = None
        self._newest = (self._learner.version, copied(self._learner.world))
        self._clock.enter(WAIT_IN)

    def ready(self) -> int:
        return os.getpid()

    def learn(self, batch: list[Segment]) -> None:
        """Make the steps that are due with these segments; if some are under way, leave it to them."""
        self._inbox.extend(segment for segment in batch if segment.source == REAL)
        while self._inbox and self._learning.acquire(blocking=False):
            try:
                self._clock.enter(COMPUTE)
                self._learn()
            except Exception as error:
                self._failure = error  # `metrics` raises it, which the driver asks for
                return
            finally:
                self._clock.enter(WAIT_IN)
                self._learning.release()

    def _learn(self) -> None:
        while self._inbox:
            with self._lock:
                self._learner.add(self._inbox.popleft())
        while self._learner.pending_steps >= 1:
            fault_point("learning.step")
            with self._lock:
                self._clock.enter(COMPUTE)  # a checkpoint may have been saved since the last step
                self._learner.step()
        if self._learner.version > self._newest[0]:
            self._newest = (self._learner.version, copied(self._learner.world))

    def metrics(self) -> dict[str, float]:
        """Counts; ``version`` is that of `weights`."""
        self._clock.beat()
        if self._failure is not None:
            raise self._failure
        return self._learner.metrics() | {"version": float(self._newest[0])}

    def weights(self) -> tuple[int, dict[str, Any]]:
        """The newest version and its weights."""
        return self._newest

    def save(self, directory: Path) -> None:
        """Write the learner's part of a checkpoint."""
        with self._lock:
            self._clock.enter(CHECKPOINT)
            snapshot.save(directory / TRAINING_STATE / ONLINE, self._learner.state())
            save_online(directory, self._learner)
            self._clock.enter(WAIT_IN)
