# SPDX-License-Identifier: Apache-2.0
"""Training of a world model on the policy's episodes during a run.

The loss is that of the pre-training with its defaults. Batches are of real windows only: some from the
pre-training data, the others from the policy's episodes, the newest and the failed ones more often, as
demonstrations do not show how the policy fails.
"""

from __future__ import annotations

import contextlib
import copy
import math
import os
import threading
from collections import OrderedDict, deque
from collections.abc import Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from accerl_lerobot import errors
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import TRAINING_STATE, WORLD_MODEL
from accerl_lerobot.checkpoint.tensors import copied
from accerl_lerobot.errors import expanded
from accerl_lerobot.experience import REAL, Segment
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.timeline import CHECKPOINT, COMPUTE, WAIT_IN, open_clock
from accerl_lerobot.world_model.config import (
    IMAGINATION,
    WORLD_LEARNING,
    LearnConfig,
    OnlineLearnConfig,
    SuccessLearnConfig,
    WorldModelConfig,
)
from accerl_lerobot.world_model.contract import WorldModelSpec
from accerl_lerobot.world_model.data import Episode, WindowStart, load_datasets, model_arrays
from accerl_lerobot.world_model.imagined import LEARN, ImaginedWorld, load_world
from accerl_lerobot.world_model.learners import Examples, Learner, SuccessLearner
from accerl_lerobot.world_model.store import LEARNT, load_roles, save_world_model

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import RunConfig

BATCH, LEARNING_RATE = 16, 3e-4  # windows per gradient step, and the learning rate after the first steps
OFFLINE, RECENT, FAILURES = 0.5, 0.7, 0.6
"""Share of windows from the pre-training data; of the others, from the newest quarter of episodes; and of
those, from failures."""
MEMORY = 400  # real episodes kept for training
MOST_PENDING = 16  # episodes whose steps may be due, where episodes come faster than it can train
MOST_UNFINISHED = 1024
"""Incomplete episodes; of more the oldest are dropped, such as those of a worker that died."""
ONLINE = "online_world_model"  # name of its part of a checkpoint
ENDLESS = 10**9  # steps of a learning rate that never falls


def episode_from_segments(segments: Sequence[Segment], spec: WorldModelSpec) -> Episode:
    """Joins the segments of a whole episode, in order; it has a frame per decision."""
    # A segment's first observation is the last one of the segment before.
    parts = [{k: v[:-1] for k, v in segment.observations.items()} for segment in segments[:-1]]
    parts.append(segments[-1].observations)
    frames, robot = model_arrays({k: np.concatenate([part[k] for part in parts]) for k in parts[0]}, spec)
    steps = np.concatenate([segment.steps for segment in segments])
    chunks = np.concatenate([segment.actions for segment in segments])
    actions = chunks[np.arange(chunks.shape[1]) < steps[:, None]]
    return Episode(
        frames=frames,
        times=np.concatenate([[0], np.cumsum(steps)]).astype(np.int64),
        state=robot.astype(np.float32),
        actions=actions,
        success_at=len(actions) - 1 if segments[-1].success else -1,
        task=segments[-1].task,
        own=True,
    )


class OnlineLearner:
    """Trains a copy of both models as real segments come in: `add`, and `step` while steps are pending.

    Args:
        known: episodes of the pre-training, in whose windows it goes on to be trained.
        roles: what the saved world model knows of episodes, by their keys, see `store`.
        longest: chunks of an imagined episode at most.
    """

    def __init__(
        self,
        world: ImaginedWorld,
        config: OnlineLearnConfig,
        known: Sequence[Episode] = (),
        roles: Mapping[str, str] | None = None,
        longest: int = 15,
        seed: int = 0,
    ) -> None:
        self.config = config
        self.roles = dict(roles or {}) | {episode.key: LEARNT for episode in known}
        self.pending_steps = 0.0  # gradient steps that are due
        training = WorldModelConfig(
            learn=LearnConfig(steps=ENDLESS, batch=BATCH, lr=LEARNING_RATE),
            success=SuccessLearnConfig(lr=LEARNING_RATE),
            longest=longest,
        )
        self._learner = Learner(copy.deepcopy(world.model).requires_grad_(True), training, seed)
        self._success = SuccessLearner(copy.deepcopy(world.success).requires_grad_(True), training, seed)
        self._offline = [episode for episode in known if len(episode.frames) > 1]
        self._learnt: deque[Episode] = deque(maxlen=MEMORY)
        self._rng = np.random.default_rng((seed, 4))
        self._unfinished: OrderedDict[tuple[str, int], dict[int, Segment]] = OrderedDict()
        self._seen: set[str] = set()  # keys of segments, which a trainer may draw more than once
        self._examples: Examples | None = None

    @property
    def version(self) -> int:
        """Gradient steps made."""
        return self._learner.count

    @property
    def world(self) -> ImaginedWorld:
        """The models to use now, which share their weights with this learner."""
        world = ImaginedWorld(self._learner.serving, self._success.model)
        world.version = self.version
        return world

    def add(self, segment: Segment) -> None:
        """Takes a real segment, once."""
        if segment.source != REAL or segment.key in self._seen:
            return
        self._seen.add(segment.key)
        parts = self._completed(segment)
        if parts is None or (parts[-1].success and not parts[-1].terminated):
            return  # incomplete, or the step of its success is unknown
        episode = episode_from_segments(parts, self._learner.model.spec)
        self._learnt.append(episode)
        self.roles[episode.key] = LEARNT
        self._take_examples()
        most = MOST_PENDING * self.config.steps_per_episode
        self.pending_steps = min(self.pending_steps + self.config.steps_per_episode, most)

    def step(self) -> dict[str, float]:
        """Makes one gradient step of either model."""
        self.pending_steps -= 1
        metrics = self._learner.step(self._learner.cut(self._episodes, self._draw()))
        if self._examples is not None:
            success = self._success.step(self._examples, self._learner.serving)
            metrics |= {f"success_{k}": v for k, v in success.items()}
        return metrics

    def state(self) -> dict[str, Any]:
        """Copies all that `restore` needs."""
        return {
            "pending_steps": self.pending_steps,
            "roles": dict(self.roles),
            "learner": self._learner.state(),
            "success": self._success.state(),
            "learnt": list(self._learnt),
            "rng": copy.deepcopy(self._rng),
            "unfinished": {name: dict(parts) for name, parts in self._unfinished.items()},
            "seen": sorted(self._seen),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from a `state`."""
        self.pending_steps, self._rng = state["pending_steps"], state["rng"]
        self.roles = state["roles"]
        self._learner.restore(state["learner"])
        self._success.restore(state["success"])
        self._learnt.extend(state["learnt"])
        self._unfinished.update(state["unfinished"])
        self._seen.update(state["seen"])
        self._take_examples()

    def metrics(self) -> dict[str, float]:
        return {"learn_steps": float(self.version), "learn_episodes": float(len(self._learnt))}

    @property
    def _episodes(self) -> list[Episode]:
        return [*self._offline, *self._learnt]

    def _take_examples(self) -> None:
        """Take the success model's examples from all episodes; none while there is one kind of outcome."""
        self._examples = None
        with contextlib.suppress(ValueError):
            self._examples = Examples(self._episodes, self._learner.model.spec.chunk)

    def _completed(self, segment: Segment) -> list[Segment] | None:
        """The whole episode, in order, if it is complete with this segment."""
        name = segment.origin[:2]
        parts = self._unfinished.setdefault(name, {})
        parts[segment.origin.decision] = segment
        if len(self._unfinished) > MOST_UNFINISHED:
            self._unfinished.popitem(last=False)
        ordered = [parts[decision] for decision in sorted(parts)]
        starts = accumulate(map(len, ordered[:-1]), initial=0)
        if sorted(parts) != [*starts] or not ordered[-1].terminated:
            return None
        self._unfinished.pop(name, None)
        return ordered

    def _draw(self) -> list[WindowStart]:
        """Draws a batch from the pre-training episodes, which have the first indices, and the policy's."""
        known = len(self._offline)
        offline = round(OFFLINE * BATCH) if known else 0
        chosen = self._rng.integers(known, size=offline).tolist() if offline else []
        weights = episode_weights([e.success for e in self._learnt])
        chosen += (known + self._rng.choice(len(weights), size=BATCH - offline, p=weights)).tolist()
        episodes = self._episodes
        return [WindowStart(e, int(self._rng.integers(len(episodes[e].frames) - 1))) for e in chosen]


def episode_weights(successes: Sequence[bool]) -> np.ndarray:
    """Probability of drawing each of the policy's episodes, oldest first."""
    count = len(successes)
    newest = np.arange(count) >= count - max(1, count // 4)
    weights = np.where(newest, RECENT / newest.sum(), (1 - RECENT) / max(1, (~newest).sum()))
    failed = ~np.asarray(successes, bool)
    if failed.any() and not failed.all():
        for which, share in ((failed, FAILURES), (~failed, 1 - FAILURES)):
            weights[which] *= share / weights[which].sum()
    return np.asarray(weights / weights.sum())


def make_learner(config: RunConfig) -> OnlineLearner:
    """The learner of a run's world model, which starts at the saved one.

    Of ``imagination.learn.dataset`` it is trained on the episodes that were not held out before.
    """
    world, imagination = load_world(config.imagination), config.imagination
    roles = load_roles(expanded(str(imagination.path), f"{IMAGINATION}.path"))
    held_out = {key for key, role in roles.items() if role != LEARNT}
    known = load_datasets({LEARN: imagination.learn.dataset}, world.model.spec).get(LEARN, [])
    known = [episode for episode in known if episode.key not in held_out]
    longest = math.ceil(config.env.max_steps / world.model.spec.chunk)
    return OnlineLearner(world, imagination.learn, known, roles, longest, config.seed)


def save_online(directory: Path, learner: OnlineLearner) -> None:
    """Writes the learned models into a checkpoint, as ``accerl world-model`` writes them."""
    world = learner.world
    save_world_model(directory / WORLD_MODEL, world.model, world.success, learner.roles)


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
        self._newest = self._learner.version, copied(self._learner.world)
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
                self._learner.step()
        if self._learner.version > self._newest[0]:
            self._newest = self._learner.version, copied(self._learner.world)

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
