# SPDX-License-Identifier: Apache-2.0
"""The engine in one process, without Ray: the same parts, called in turn, deterministic for a seed.

Every poll all environments, real and imagined, get a decision and step it, and there is one update, as
the pace allows. For tests and debugging. The trainer's own policy acts, so lag comes from replay alone.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import PRETRAINED, TRAINING_STATE, WEIGHTS
from accerl_lerobot.engines import Engine, Progress
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.envs import make_environment
from accerl_lerobot.experience import Decision, Request
from accerl_lerobot.policies.config import Load, loader
from accerl_lerobot.replay.buffer import Replay
from accerl_lerobot.replay.journal import EPISODES, Journal
from accerl_lerobot.rollout.runner import (
    MOST_STARTS,
    EpisodePlan,
    EpisodePlans,
    FirstObservations,
    RolloutRunner,
)
from accerl_lerobot.seeds import global_generators, restore_global_generators
from accerl_lerobot.timeline import CHECKPOINT, COMPUTE, WAIT_IN, open_clock

logger = logging.getLogger(__name__)

LOCAL = "local"


class LocalEngine(Engine):
    """Single-process engine."""

    state_name = LOCAL  # of this engine's own part of a checkpoint

    def __init__(
        self,
        config: RunConfig,
        tasks: tuple[str, ...],
        history: int = 1,
        state: Path | None = None,
        load: Load | None = None,
    ) -> None:
        self._clock = open_clock(config.timeline_folder, LOCAL)
        import torch

        from accerl_lerobot.algorithms.update import make_update

        torch.manual_seed(config.seed)
        torch.set_num_threads(config.trainer.num_threads)
        self._config = config
        self._adapter = loader(load)(config.policy)
        self._update = make_update(self._adapter, config.algorithm, config.trainer)
        journal = None if config.folder is None else Journal(config.folder / EPISODES)
        self._replay = Replay(config.replay, journal)
        self._rng = np.random.default_rng(config.seed)
        self._training = False
        count = config.rollout.environments * config.rollout.workers
        environments = [
            make_environment(config.env, history, config.rollout.reward_model) for _ in range(count)
        ]
        first: FirstObservations = deque(maxlen=MOST_STARTS)
        self._world: Any = None
        self._world_learner: Any = None
        if config.imagination.environments:
            from accerl_lerobot.world_model.imagined import imagined_environments
            from accerl_lerobot.world_model.training import make_trainer

            imagined = config.imagination.environments * config.rollout.workers
            spec = environments[0].spec
            self._world, more = imagined_environments(config.imagination, imagined, spec, first)
            environments += more
            if config.imagination.learns:
                self._world_learner = make_trainer(config)
        self._plans = EpisodePlans(tasks, config.seed, config.rollout.episodes or None)
        self._runner = RolloutRunner(environments, self._plans, config.rollout, first)
        if state is not None:
            self._restore(state)
        self._clock.enter(WAIT_IN)

    def plan(self, plans: list[EpisodePlan]) -> None:
        self._plans.queue(plans)

    def train(self) -> None:
        self._training = True

    def poll(self) -> Progress:
        self._clock.enter(COMPUTE)
        self._store()
        self._act()
        self._store()
        self._learn_world()
        updates = []
        n = self._config.trainer.batch_decisions
        if self._exploring and self._replay.may_sample(n):
            segments = self._replay.sample(n, self._update.version, self._rng)
            if segments:
                metrics = self._update.step(segments)
                metrics["update"] = float(self._update.version)
                updates.append(metrics)
        self._clock.enter(WAIT_IN)
        episodes = list(self._runner.results)
        self._runner.results.clear()
        learner = self._world_learner
        return Progress(
            version=self._update.version,
            done=self._training and not self._exploring,
            updates=updates,
            episodes=episodes,
            rollout=asdict(self._runner.counters),
            replay=self._replay.metrics(),
            world_model={} if learner is None else learner.metrics(),
            inference={"version": float(self._update.version)},
        )

    def save(self, directory: Path) -> Progress:
        self._clock.enter(CHECKPOINT)
        self._adapter.save(directory / PRETRAINED, self._adapter.copy_weights())
        state = directory / TRAINING_STATE
        snapshot.save(state / WEIGHTS, self._adapter.export_trainable())
        snapshot.save(state / "trainer", self._update.state())
        snapshot.save(state / "replay", self._replay.state())
        engine = {
            "generators": global_generators(),
            "rng": self._rng.bit_generator.state,
            "outbox": list(self._runner.segments),
            "plans": self._plans.state(),
            "runner": self._runner.state(),
        }
        snapshot.save(state / self.state_name, engine)
        if self._world_learner is not None:
            from accerl_lerobot.checkpoint.tensors import copied
            from accerl_lerobot.world_model.training import ONLINE, save_online

            acting = {"version": self._world.version, "weights": copied(self._world)}
            snapshot.save(state / ONLINE, {"learner": self._world_learner.state(), "acting": acting})
            save_online(directory, self._world_learner)
        self._clock.enter(WAIT_IN)
        return Progress(version=self._update.version)

    def _restore(self, directory: Path) -> None:
        self._adapter.load_trainable(snapshot.load(directory / WEIGHTS))
        self._update.restore(snapshot.load(directory / "trainer"))
        self._replay.restore(snapshot.load(directory / "replay"))
        engine = snapshot.load(directory / self.state_name)
        self._rng.bit_generator.state = engine["rng"]
        self._runner.segments.extend(engine["outbox"])
        self._plans.restore(engine["plans"])
        self._runner.restore(engine["runner"])
        if self._world_learner is not None:
            from accerl_lerobot.world_model.training import ONLINE

            saved = snapshot.load(directory / ONLINE)
            self._world_learner.restore(saved["learner"])
            self._world.load(saved["acting"]["version"], saved["acting"]["weights"])
        restore_global_generators(engine["generators"])

    def close(self) -> None:
        try:
            self._clock.close()
            self._runner.close()
        except Exception:
            logger.exception("could not close all environments")

    @property
    def _exploring(self) -> bool:
        if not self._training or self._update.version >= self._config.trainer.updates:
            return False
        return not self._replay.exhausted(self._config.trainer.batch_decisions)

    def _act(self) -> None:
        """One decision in every environment that may continue."""
        runner = self._runner
        self._plans.exploring = self._exploring
        may_explore = self._replay.may_insert()
        due: dict[int, Request] = {}
        for slot in range(len(runner)):
            request = runner.request(slot)
            if request is None or (request.explore and not self._exploring):
                request = runner.begin_episode(slot)
            if request is not None and (may_explore or not request.explore):
                due[slot] = request
        if due:
            decisions = self._decide(list(due.values()))
            for slot, decision in zip(due, decisions, strict=True):
                runner.advance(slot, decision)

    def _decide(self, requests: list[Request]) -> list[Decision]:
        return self._adapter.decide(requests, self._update.version)

    def _learn_world(self) -> None:
        """One gradient step of the world model, if one is due; its environments use it once none is."""
        learner = self._world_learner
        if learner is None or not self._training or learner.pending_steps < 1:
            return
        learner.step()
        if learner.pending_steps < 1:
            self._world.load(learner.serving.version, learner.serving.state_dict())

    def _store(self) -> None:
        outbox = self._runner.segments
        while outbox and self._replay.may_insert():
            segment = outbox.popleft()
            if self._replay.insert(segment) and self._world_learner is not None:
                self._world_learner.add(segment)
        if self._world is None and self._plans.spent and not outbox and not self._runner.exploring:
            self._replay.ended = True
