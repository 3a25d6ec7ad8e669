# SPDX-License-Identifier: Apache-2.0
"""Imagined rollouts of a run: what imagines, the learner of its world model, and their two processes.

    Imagination   consumes    decisions from inference, real segments from replay, promoted models
                  produces    imagined segments for replay
                  waits for   decisions; and replay, while segments are pending there
                  outlives    inference: unanswered requests go to its successor
    WorldLearning consumes    real segments from replay
                  produces    world models that have passed validation, for imagination
                  waits for   real experience

Both end with the process, or when replay says that the run is over. Until a model has passed, batches are
real; from then on the trainer waits for imagined segments as it does for real ones.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import TRAINING_STATE, WORLD_MODEL
from accerl_lerobot.engine.config import DatasetConfig, RunConfig
from accerl_lerobot.engine.preflight import policy_to_be
from accerl_lerobot.envs import make_world
from accerl_lerobot.envs.base import WorldSpec
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Segment
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.policies.loading import load_lerobot_config
from accerl_lerobot.timeline import CHECKPOINT, COMPUTE, TRANSPORT, WAIT_IN, WAIT_OUT, WEIGHT_SYNC, open_clock
from accerl_lerobot.transport.endpoint import Endpoint, ReconnectingClient
from accerl_lerobot.world_model.config import IMAGINATION, WORLD_LEARNING, OnlineLearnConfig
from accerl_lerobot.world_model.contract import WorldModelSpec
from accerl_lerobot.world_model.data import fingerprint, load_episodes
from accerl_lerobot.world_model.online import OnlineLearner, PretrainingEpisodes, Promotion
from accerl_lerobot.world_model.registry import (
    ImaginationModels,
    check_fit,
    learned_part,
    make_models,
)
from accerl_lerobot.world_model.rollouts import Imagination, RolloutSettings
from accerl_lerobot.world_model.store import OWN_RUN, Source, find_source, load_sources
from accerl_lerobot.world_model.validation import (
    DATASET,
    ONLINE,
    check_disjoint,
    name_section,
    open_datasets,
)

MAX_PENDING = 2
"""Messages to replay that may be pending before imagination pauses."""
LEARNER = "world_learner"
"""Name of the learner's state."""
PAUSE_S = 0.02
"""Sleep of a worker with nothing to do."""
SWAP_S = 30.0
"""Largest wait of a checkpoint for a promoted model to be taken over."""
POLL_S = 0.2
"""Interval at which replay is asked for new real segments."""
EARLIER = "earlier"
"""`Episode.source` of the pre-training episodes."""


def make_imagination(config: RunConfig, on_segment: Callable[[Segment], object]) -> Imagination:
    """Builds the imagination of a run."""
    world = _world_spec(config)
    models = load_models(config, world)
    run = RolloutSettings(
        decision_cost=config.rollout.decision_cost,
        time_limit_fails=config.rollout.time_limit == "fail",
        seed=config.seed,
    )
    sources = _sources(config, models.model.spec)
    return Imagination(models, world, config.imagination, run, on_segment, sources)


def _sources(config: RunConfig, spec: WorldModelSpec) -> list[Source]:
    """Datasets that a world model is trained on in the run, beside the run's own episodes."""
    if not config.imagination.learns:
        return []
    sources = list(load_sources(Path(str(config.imagination.path)), "imagination"))
    sections = _dataset_sections(config.imagination.learn)
    for section, meta in open_datasets(sections, spec).items():
        if find_source(sources, known := fingerprint(meta)) is None:  # then it trains on all of it
            every = tuple(range(meta.total_episodes))
            name = sections[section].repo_id or ""
            sources.append(Source(repo_id=name, fingerprint=known, learnt=every, held_out=()))
    return [*sources, OWN_RUN]


def load_models(config: RunConfig, world: WorldSpec) -> ImaginationModels:
    """Loads a run's world model; its ``policy.path`` must be set."""
    policy = load_lerobot_config(config.policy)
    executed = getattr(policy, "n_action_steps", 1)
    return _models(config, world, executed, policy.n_obs_steps)


def make_learner(config: RunConfig, models: ImaginationModels | None = None) -> OnlineLearner:
    """Builds the learner of a run's world model, which starts at `models`; None: at the saved ones."""
    learn = config.imagination.learn
    world = _world_spec(config)
    models = models or load_models(config, world)
    model, success = learned_part(models.model), models.success
    longest = _longest(world, model.spec.chunk)
    assert success is not None  # as `check_imagination` has found
    sources = load_sources(Path(str(config.imagination.path)), "imagination")
    known = PretrainingEpisodes([], [])
    sections = _dataset_sections(learn)
    for section, meta in open_datasets(sections, model.spec).items():
        with name_section(section):
            # Not ``online``, even if a policy recorded them: in validation this run's own failures count.
            episodes = load_episodes(sections[section], model.spec, EARLIER, both=False)
            check_disjoint(sections[section], episodes, known.learnt + known.held_out)
        source = find_source(sources, fingerprint(meta))
        known.learnt.extend(episodes if source is None else [episodes[i] for i in source.learnt])
        known.held_out.extend([] if source is None else [episodes[i] for i in source.held_out])
    return OnlineLearner(model, success, config.imagination, known, longest, seed=config.seed)


def check_imagination(config: RunConfig) -> None:
    """Refuses, before a run begins, what `make_imagination` would refuse in the middle of it."""
    policy = policy_to_be(config)
    executed = getattr(policy, "n_action_steps", 1)
    models = _models(config, _world_spec(config), executed, policy.n_obs_steps, first=True)
    if config.imagination.learns:
        open_datasets(_dataset_sections(config.imagination.learn), models.model.spec)


def _dataset_sections(learn: OnlineLearnConfig) -> dict[str, DatasetConfig]:
    """The datasets that are named, by their config section."""
    sections = {DATASET: learn.dataset, ONLINE: learn.online}
    return {f"imagination.learn.{name}": of for name, of in sections.items() if of.repo_id is not None}


def _longest(world: WorldSpec, chunk: int) -> int:
    """Decisions of a rollout at most."""
    return math.ceil(world.max_steps / chunk)


def _world_spec(config: RunConfig) -> WorldSpec:
    world = make_world(config.env)
    try:
        return world.spec
    finally:
        world.close()


def _models(
    config: RunConfig, world: WorldSpec, executed: int, history: int, *, first: bool = False
) -> ImaginationModels:
    """Loads and checks the models; `first`: see `make_models`."""
    if (reward := getattr(config.env, "reward", "success")) != "success":
        remedy = "use success with imagination.share: that is what imagined rollouts are rewarded for"
        raise InputError("env.reward", reward, remedy)
    if not getattr(config.env, "terminate_on_success", True):
        remedy = "use true with imagination.share: imagined rollouts end with a success, real ones must too"
        raise InputError("env.terminate_on_success", False, remedy)
    models = make_models(config.imagination, config.env, world, executed, config.policy.device, first=first)
    if config.imagination.learns and models.success is None:
        remedy = "it has no success model to train on; use imagination.learn.steps_per_episode=0"
        raise InputError("imagination.path", config.imagination.path, remedy)
    check_fit(models.model.spec, world, executed, history, models.success is not None)
    imagined, longest = config.imagination.imagined_replay(config.replay), _longest(world, executed)
    imagined.check(batch_decisions=config.trainer.batch_decisions, segment_decisions=longest)
    return models


class ImaginationWorker:
    """Becomes a threaded Ray actor in `launch`: `run` on one thread, everything else beside it."""

    def __init__(self, config: RunConfig, state: Path | None = None, timeline: Path | None = None) -> None:
        self._clock = open_clock(timeline, IMAGINATION)
        import torch

        torch.set_num_threads(config.trainer.num_threads)
        self._limit = config.launch.stall_s
        # The engine notices inference that hangs after `stall_s`; this is in case it does not.
        self._patience_s = 2 * self._limit
        self._share, self._batch = config.imagination.share, config.inference.max_batch
        self._outbox: list[Segment] = []
        self._imagination = make_imagination(config, self._outbox.append)
        self._lock = threading.Lock()
        self._imagining = threading.Lock()
        """Held while the imagination changes; outside, the outbox is empty."""
        self._deciding = ReconnectingClient("inference")
        self._promoted: Promotion | None = None
        self._may_promote = config.imagination.learns
        self._cursor = 0
        if state is not None:
            saved = snapshot.load(state / IMAGINATION)
            self._imagination.restore(saved["imagination"])
            self._cursor = saved["cursor"]
        self._clock.enter(WAIT_IN)

    def ready(self) -> int:
        """Returns this process's id once the world model is loaded."""
        return os.getpid()

    def promote(self, promotion: Promotion) -> None:
        """Uses this model from the next chunk on."""
        with self._lock:
            self._promoted = promotion

    def expect(self, may_promote: bool) -> None:
        """Notes whether another model may be promoted."""
        with self._lock:
            self._may_promote = may_promote

    def move(self, inference: Endpoint) -> None:
        """Sends requests to this endpoint from now on."""
        self._deciding.move(inference)

    def metrics(self) -> dict[str, float]:
        """See `Imagination.metrics`."""
        self._clock.beat()
        return self._imagination.metrics()

    def save(self, directory: Path) -> None:
        """Writes its part of a checkpoint, once it has taken over what was promoted."""
        began = time.monotonic()
        while self._promoted is not None and time.monotonic() < began + min(SWAP_S, self._limit / 2):
            time.sleep(PAUSE_S)
        left = began + self._limit - time.monotonic()
        with _within(left, self._imagining, "an imagination step"):
            saved = {"imagination": self._imagination.state(), "cursor": self._cursor}
            snapshot.save(directory / TRAINING_STATE / IMAGINATION, saved)
            self._imagination.save_promoted(directory / WORLD_MODEL)

    def run(self, inference: Endpoint, inserting: Endpoint, replay: Any) -> None:
        """Imagines until replay is closed."""
        news, reported = _News(replay, self._cursor), None
        deciding, connection = self._deciding, inserting.connect()
        deciding.move(inference)
        pending: set[int] = set()
        while not news.closed:
            self._clock.enter(CHECKPOINT)
            with self._imagining:
                self._clock.enter(COMPUTE)
                may_promote = self._swap()
                for segment in news.fresh():
                    self._imagination.remember(segment)
                self._cursor = news.cursor
            # Both at once: a run that imagines nothing and expects no model has nothing to wait for.
            if reported != (self._imagination.on, may_promote):
                reported = (self._imagination.on, may_promote)
                share = self._share if self._imagination.on else 0.0
                _await(replay.mix.remote(share, any(reported)))
            self._clock.enter(TRANSPORT)
            for ticket, stored in connection.done(0.0):
                pending.discard(ticket)
                if not stored:
                    return
            self._clock.enter(COMPUTE)
            with self._imagining:
                requests = [] if len(pending) >= MAX_PENDING else self._imagination.requests()
            if not requests:
                self._clock.enter(WAIT_OUT if len(pending) >= MAX_PENDING else WAIT_IN)
                time.sleep(PAUSE_S)
                continue
            parts = [requests[i : i + self._batch] for i in range(0, len(requests), self._batch)]
            self._clock.enter(WAIT_IN)
            answers = deciding.ask(parts, self._patience_s)
            self._clock.enter(CHECKPOINT)
            with self._imagining:
                self._clock.enter(COMPUTE)
                fault_point("imagination.step")
                self._imagination.advance([decision for answer in answers for decision in answer])
                self._clock.enter(TRANSPORT)
                if self._outbox:
                    pending.add(connection.send(self._outbox))
                    self._outbox.clear()

    def _swap(self) -> bool:
        """Takes over what was promoted; True if more may come."""
        with self._lock:
            promoted, self._promoted = self._promoted, None
            may_promote = self._may_promote
        if promoted is not None:
            self._clock.enter(WEIGHT_SYNC)
            self._imagination.swap(promoted)
            self._clock.enter(COMPUTE)
        return may_promote


class WorldLearningWorker:
    """Becomes a threaded Ray actor in `launch`: `run` on one thread, everything else beside it."""

    def __init__(self, config: RunConfig, state: Path | None = None, timeline: Path | None = None) -> None:
        self._clock = open_clock(timeline, WORLD_LEARNING)
        import torch

        torch.set_num_threads(config.trainer.num_threads)
        torch.manual_seed(config.seed)
        self._limit = config.launch.stall_s
        self._learner = make_learner(config)
        self._learning = threading.Lock()
        """Held while the learner changes, but not during a validation, which is of a copy."""
        self._cursor = 0
        if state is not None:
            saved = snapshot.load(state / LEARNER)
            self._learner.restore(saved["learner"])
            self._cursor = saved["cursor"]
        self._clock.enter(WAIT_IN)

    def ready(self) -> int:
        """Returns this process's id once the world model and its datasets are loaded."""
        return os.getpid()

    def metrics(self) -> dict[str, float]:
        """See `OnlineLearner.metrics`."""
        self._clock.beat()
        return self._learner.metrics()

    def save(self, directory: Path) -> None:
        """Writes its part of ``training_state``."""
        with _within(self._limit, self._learning, "a step of learning"):
            saved = {"learner": self._learner.state(), "cursor": self._cursor}
        snapshot.save(directory / TRAINING_STATE / LEARNER, saved)

    def run(self, imaginer: Any, replay: Any) -> None:
        """Trains until replay is closed."""
        news, learner = _News(replay, self._cursor), self._learner
        may_promote: bool | None = None
        hold: bool | None = None
        """As last reported to replay."""
        while not news.closed:
            self._clock.enter(TRANSPORT)
            with self._learning:
                for segment in news.fresh():
                    learner.add(segment)
                self._cursor = news.cursor
            last = news.ended
            due = learner.validation_due(last=False) and not last
            if hold is not due:
                hold = due
                _await(replay.hold.remote(hold))
            if may_promote is not learner.may_promote(last):
                may_promote = learner.may_promote(last)
                _await(imaginer.expect.remote(may_promote))
            if learner.pending_steps >= 1:
                self._clock.enter(CHECKPOINT)
                with self._learning:
                    self._clock.enter(COMPUTE)
                    fault_point("learning.step")
                    learner.step()
            elif learner.validation_due(last):
                self._clock.enter(COMPUTE)
                if promotion := learner.promote(last):
                    self._clock.enter(WEIGHT_SYNC)
                    _await(imaginer.promote.remote(promotion))
                    learner.mark_served()
            else:
                self._clock.enter(WAIT_IN)
                time.sleep(PAUSE_S)


@contextmanager
def _within(seconds: float, lock: threading.Lock, what: str) -> Iterator[None]:
    """Holds a lock that others hold for a moment."""
    if not lock.acquire(timeout=seconds):
        remedy = "raise launch.stall_s if one takes that long"
        raise TimeoutError(f"{what} has not ended for {seconds:.0f} s or more; {remedy}")
    try:
        yield
    finally:
        lock.release()


class _News:
    """New real segments in replay, polled without waiting."""

    def __init__(self, replay: Any, cursor: int) -> None:
        self._replay, self._asked, self._next = replay, None, 0.0
        self.cursor = cursor
        self.ended = self.closed = False

    def fresh(self) -> list[Segment]:
        """Real segments that have come since."""
        if self._asked is None:
            if time.monotonic() < self._next:
                return []
            self._asked = self._replay.news.remote(self.cursor)
        import ray

        done, _ = ray.wait([self._asked], timeout=0)
        if not done:
            return []
        news = ray.get(self._asked)
        self._asked, self._next = None, time.monotonic() + POLL_S
        self.cursor, self.ended, self.closed = news.cursor, news.ended, news.closed
        return list(news.segments)


def _await(reference: Any) -> None:
    import ray  # the engine in one process uses this file too

    ray.get(reference)
