# SPDX-License-Identifier: Apache-2.0
"""The asynchronous engine: places the workers, connects them and watches them.

    rollout ×W ──requests──► inference ──decisions──► rollout   micro-asynchrony: others step meanwhile
        │                        ▲
        └──segments──► replay    │ weights, taken without the trainer waiting
                          │      │
                          └──► trainer                          macro-asynchrony: no barrier, a measured lag

The trainer is the clock: when it has made its updates the run is over. A rollout worker or inference replica
that ends or hangs is restarted alone, see `supervision`; the loss of any other worker ends this engine with
its traceback, and `run` makes another one from the last checkpoint. Every wait here has a timeout. Workers
get handles of each other and never hold the engine.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayActorError, RayError, RayTaskError

from accerl_lerobot.checkpoint.layout import TRAINING_STATE, saved_version
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.engines.contract import Engine, Progress, Saved
from accerl_lerobot.engines.placement import learns_states, place_workers
from accerl_lerobot.engines.ray_session import NO_HUB_TOKEN, start_ray
from accerl_lerobot.engines.stopping import WorkerError
from accerl_lerobot.engines.supervision import (
    RESTARTED,
    RestartedWorker,
    RolloutSlot,
    Worker,
    end_all,
    restore_rollouts,
    save_rollouts,
    total_counters,
)
from accerl_lerobot.inference.batcher import merge_metrics
from accerl_lerobot.metrics import numbered
from accerl_lerobot.policies.config import Load
from accerl_lerobot.replay.buffer import ASYNCHRONOUS, Schedule
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodeResult
from accerl_lerobot.transport.connection import ServiceStoppedError
from accerl_lerobot.world_model.config import WORLD_LEARNING

logger = logging.getLogger(__name__)

POLL_S = 0.5
BLAME_S = 10.0  # how long to wait for the failure that another is the consequence of


class InferenceReplica(RestartedWorker):
    """An inference replica; a restart loses nothing, as a request carries its noise and clients ask again."""

    trainer: Any = None  # handle of the trainer, once it publishes weights
    follows = False  # True if its process was told of the trainer when it began
    together = 0  # observations that are decided in lock step; 0: as they come

    def ready_arguments(self) -> tuple[Any, ...]:
        self.follows = self.trainer is not None
        return (self.trainer,) if self.follows else ()

    def begin(self) -> None:
        self.at_work(self.actor.serve.remote())
        if self.trainer is not None and not self.follows:  # training began while it was restarted
            self.actor.follow.remote(self.trainer)
        if self.together:
            self.actor.lock_step.remote(self.together)


class RayEngine(Engine):
    """The asynchronous engine of a run whose ``policy.path`` is set; starts Ray if it is not there.

    Args:
        history: env steps that an observation holds, the policy's ``n_obs_steps``.
        state: the ``training_state`` to resume from, without the episodes under way; None: begin.
        load: makes the policy's adapter, in the processes that have one; None: of LeRobot's checkpoint.
    """

    def __init__(
        self,
        config: RunConfig,
        tasks: tuple[str, ...],
        history: int = 1,
        state: Path | None = None,
        load: Load | None = None,
    ) -> None:
        self._config, self._limit = config, config.launch.stall_s
        self._version = 0 if state is None else saved_version(state)
        self._rollouts: list[RolloutSlot] = []
        self._inference: list[InferenceReplica] = []
        self._others: list[Worker] = []
        self._world_learner: Worker | None = None  # trains the world model of imagined environments
        self._world_version = 0  # of the models that the rollout workers were given last
        self._updates: list[dict[str, float]] = []
        self._schedule: Schedule = ASYNCHRONOUS
        self._training = self._collected = self._done = self._closed = False
        self._last_change = time.monotonic()
        self._last_state: tuple[object, ...] = ()
        self._owns_ray = not ray.is_initialized()
        try:
            if self._owns_ray:
                start_ray(config.launch)
            self._start(tasks, history, state, load)
        except BaseException:
            self.close()
            raise

    def plan(self, plans: list[EpisodePlan]) -> None:
        for worker in self._rollouts:
            worker.assign(plans[worker.index :: len(self._rollouts)])
        self._last_change = time.monotonic()  # time before this call is the caller's

    def train(self) -> None:
        self._training, self._last_change = True, time.monotonic()
        self.follow(self._config.launch.schedule)
        self._trainer.work = self._trainer.actor.run.remote(self._replay.actor)
        for replica in self._inference:
            replica.trainer = self._trainer.actor
            if not replica.is_starting:  # one that has died unnoticed is restarted, and follows then
                replica.actor.follow.remote(self._trainer.actor)

    def follow(self, schedule: Schedule) -> None:
        """Change the schedule of collecting and learning, see `replay.buffer`."""
        if schedule == self._schedule:
            return
        self._schedule = schedule
        # The trainer first: replay's turns wait for it to hand over its weights.
        for worker in (self._trainer, self._replay):
            worker.call("follow", schedule, timeout=self._limit)
        for index, replica in enumerate(self._inference):
            clients = len(self._rollouts[index :: len(self._inference)])
            together = clients * self._config.rollout.environments
            replica.together = 0 if schedule == ASYNCHRONOUS else together
            if not replica.is_starting:
                replica.call("lock_step", replica.together, timeout=self._limit)

    def poll(self) -> Progress:
        for worker in (*self._inference, *self._others):
            if not (isinstance(worker, RestartedWorker) and worker.is_starting):
                worker.ask("metrics")
        for slot in self._rollouts:
            slot.ask_report(self._training and not self._done, self._schedule != ASYNCHRONOUS)
        self._await_end()
        episodes = self._listen()
        self._hand_over_world()
        self._supervise()
        updates, self._updates = self._updates, []
        if updates:
            self._version = int(updates[-1]["update"])
        served = [replica.last_answer for replica in self._inference if replica.last_answer]
        restarts = sum(replica.all_restarts for replica in self._inference)
        progress = Progress(
            version=self._version,
            done=self._done,
            updates=updates,
            episodes=episodes,
            rollout=dict(total_counters(self._rollouts)),
            replay=self._replay.last_answer or {},
            inference=merge_metrics(served) | {"restarts": float(restarts)},
            world_model=(self._world_learner.last_answer or {}) if self._world_learner else {},
        )
        self._check_moving(progress)
        return progress

    def save(self, directory: Path) -> Saved:
        directory = directory.absolute()
        state = directory / TRAINING_STATE
        # Records that the trainer has sent come first: `hold` returns the rest, up to its version.
        reported = self._updates + (self._hear(self._trainer, self._limit) or [])
        self._updates = []
        version, records = self._trainer.call("hold", timeout=self._limit)  # it waits for an update at most
        # At once, so that little comes in that was decided by weights of later updates.
        self._replay.call("save", state, version, timeout=self._limit)
        if self._world_learner is not None:
            self._world_learner.call("save", directory, timeout=self._limit)
        self._trainer.call("write", directory, timeout=self._limit)
        save_rollouts(state, self._rollouts)
        self._last_change = time.monotonic()
        return Saved(version, reported + records)

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        try:
            end_all(list(self._everyone()))
        except Exception:
            logger.exception("could not end all workers")
        if self._owns_ray:
            ray.shutdown()

    def pids(self) -> dict[str, int]:
        """Process ids by worker: ``inference``, ``replay``, ``trainer``, ``rollout 0`` …; for fault tests."""
        return {w.name: int(w.call("ready", timeout=self._limit)) for w in self._everyone()}

    def _everyone(self) -> Iterator[Worker]:
        """All workers, those that others depend on first."""
        yield from self._inference
        yield from self._others
        yield from self._rollouts

    def _start(self, tasks: tuple[str, ...], history: int, state: Path | None, load: Load | None) -> None:
        from accerl_lerobot.inference.worker import InferenceWorker
        from accerl_lerobot.replay.worker import ReplayWorker
        from accerl_lerobot.rollout.worker import RolloutWorker
        from accerl_lerobot.trainer.peers import SHARE, LearnerSettings, TrainerRank
        from accerl_lerobot.trainer.worker import TrainerWorker
        from accerl_lerobot.world_model.worker import WORLD_MODEL_WORKER, WorldModelWorker

        c, timeline, imagination = self._config, self._config.timeline_folder, self._config.imagination
        placement, in_cluster = place_workers(c), c.launch.address is not None
        for row in placement.rows():
            logger.info("%s", row)

        def make(kind: type, role: str, concurrency: int, *arguments: Any, **more: Any) -> Any:
            options = placement.options(role) | {"max_concurrency": concurrency} | more
            return ray.remote(kind).options(**options).remote(*arguments)

        def add(name: str, kind: type, role: str, concurrency: int, *arguments: Any) -> Worker:
            actor = make(kind, role, concurrency, *arguments)
            self._others.append(Worker(name, actor, placement.is_here(role)))
            return self._others[-1]

        # The ranks first: Ray fills the GPU that is fullest, and each of them needs more than half of one.
        learner = LearnerSettings(c.policy, c.algorithm, c.trainer, c.seed, state, load, SHARE * self._limit)
        ranks = [
            add(f"trainer rank {rank}", TrainerRank, "trainer", 1, rank, learner).actor
            for rank in range(1, c.trainer.ranks)
        ]
        world_model = None
        if learns_states(c):
            arguments = (c.seed, c.trainer.num_threads, timeline)
            world_model = add(WORLD_MODEL_WORKER, WorldModelWorker, "world_model", 4, *arguments).actor
        replicas = numbered("inference", c.inference.workers)
        if imagination.learns:
            from accerl_lerobot.world_model.online import OnlineLearningWorker

            self._world_learner = add(
                WORLD_LEARNING, OnlineLearningWorker, "world_model", 4, c, state, timeline
            )
        online = self._world_learner.actor if self._world_learner else None
        learning = (learner, timeline, ranks, c.folder, world_model, replicas, online)
        self._trainer = add("trainer", TrainerWorker, "trainer", 4 + len(replicas), *learning)
        deciding = (c.policy, c.inference, self._version, state, load, timeline)
        for name in replicas:
            actor = make(InferenceWorker, "inference", 1000, *deciding, name, in_cluster, **RESTARTED)
            is_here = placement.is_here("inference")
            self._inference.append(InferenceReplica(name, actor, c.launch.max_restarts, is_here))
        stores = (c.replay, c.seed, state, c.folder, timeline, in_cluster)
        self._replay = add("replay", ReplayWorker, "replay", 1000, *stores)
        for index in range(c.rollout.workers):
            collecting = (c.env, c.rollout, f"rollout {index}", history, timeline, imagination)
            actor = make(RolloutWorker, "rollout", 4, *collecting, **RESTARTED, **NO_HUB_TOKEN)
            self._rollouts.append(RolloutSlot(index, actor, c, tasks, placement.is_here("rollout")))
        if state is not None:
            restore_rollouts(state, self._rollouts)
        self._await_start()

    def _await_start(self) -> None:
        """Wait until all workers are ready, and have them begin."""
        ready = []
        for worker in self._everyone():
            arguments = worker.ready_arguments() if isinstance(worker, RestartedWorker) else ()
            ready.append((worker, worker.actor.ready.remote(*arguments)))
        for worker, reference in ready:
            worker.started(worker.result(reference, "ready", worker.start_timeout(self._limit)))
        self._replay.work = self._replay.actor.run.remote()
        for slot in self._rollouts:
            replica = self._inference[slot.index % len(self._inference)]
            slot.services = (replica.endpoint, self._replay.endpoint)
        for restarted in (*self._inference, *self._rollouts):
            restarted.begin()

    def _await_end(self) -> None:
        """Wait a little, and handle every worker whose long call has ended."""
        works = {worker.work: worker for worker in self._everyone() if worker.work is not None}
        if not ray.wait(list(works), num_returns=1, timeout=POLL_S)[0]:
            return
        ended = set(ray.wait(list(works), num_returns=len(works), timeout=0)[0])
        for reference, worker in works.items():
            if reference in ended and worker.work is reference:
                self._ended(worker)

    def _ended(self, worker: Worker) -> None:
        """Handle the end of a worker's long call: restart it, finish, or raise."""
        reference, worker.work = worker.work, None
        try:
            result = ray.get(reference)
        except RayError as error:
            if isinstance(error, RayTaskError) and isinstance(error.cause, RayError | ServiceStoppedError):
                self._blame()
            worker.lost(error)
            return
        if worker is self._trainer:
            self._finish(int(result))
        elif not (self._done and worker is self._replay):
            raise WorkerError(f"{worker.name} worker ended without being asked to")

    def _blame(self) -> None:
        """A worker failed because of another one: raise that one's failure, if it comes."""
        works = {w.work: w for w in self._others if w is not self._trainer and w.work is not None}
        if works:
            for reference in ray.wait(list(works), num_returns=1, timeout=BLAME_S)[0]:
                self._ended(works[reference])

    def _finish(self, version: int) -> None:
        """The trainer has made its updates: complete its records and those of replay."""
        self._done, self._version = True, version
        self.follow(ASYNCHRONOUS)
        self._updates += self._hear(self._trainer, self._limit) or []
        self._updates += self._trainer.call("metrics", timeout=self._limit)
        self._replay.call("close", timeout=self._limit)
        self._hear(self._replay, self._limit)
        self._replay.last_answer = self._replay.call("metrics", timeout=self._limit)

    def _listen(self) -> list[EpisodeResult]:
        """Take all answers that have come; returns the episodes in them."""
        episodes: list[EpisodeResult] = []
        for worker in self._everyone():
            answer = self._hear(worker)
            if worker is self._trainer:
                self._updates += answer or []
            elif answer is not None and isinstance(worker, RolloutSlot):
                episodes += worker.take(answer)
        imagining = self._config.imagination.environments > 0
        if not self._collected and not imagining and all(slot.spent for slot in self._rollouts):
            self._collected = True
            self._replay.call("end", timeout=self._limit)
        return episodes

    def _hand_over_world(self) -> None:
        """Give a new version of the world model to the rollout workers."""
        learner = self._world_learner
        answer = None if learner is None else learner.last_answer
        if learner is None or not answer or answer["version"] <= self._world_version:
            return
        self._world_version = int(answer["version"])
        newest = learner.actor.weights.remote()
        for slot in self._rollouts:
            slot.world = newest
            if not slot.is_starting:
                slot.actor.imagine_with.remote(newest)

    def _hear(self, worker: Worker, timeout: float = 0.0) -> Any:
        try:
            return worker.answer(timeout)
        except RayError as error:
            # Where a process has died, its long call has ended as well, which `_await_end` deals with.
            has_died = isinstance(error, RayActorError) and not isinstance(error, RayTaskError)
            if not (has_died and isinstance(worker, RestartedWorker)):
                worker.lost(error)
            return None

    def _supervise(self) -> None:
        """Give up workers that hang, and go on with those that are being restarted."""
        for worker in self._everyone():
            worker.show_warnings()
        # Inference last: workers that wait for it are silent too.
        for worker in (*self._others, *self._rollouts, *self._inference):
            if isinstance(worker, RestartedWorker) and worker.is_starting:
                worker.advance_start(self._limit)
                self._last_change = time.monotonic()  # a restart has a timeout of its own
            elif why := worker.hung(self._limit):
                worker.lost(RuntimeError(why), f"{worker.name} worker {why}")

    def _check_moving(self, progress: Progress) -> None:
        """End a run in which every worker answers and nothing moves."""
        reports = [slot.last_answer for slot in self._rollouts if slot.last_answer is not None]
        moves = sum(report.moves for report in reports)
        state = (progress.version, moves, progress.rollout["restarts"])
        now = time.monotonic()
        outstanding = any(slot.outstanding for slot in self._rollouts)
        waiting = outstanding or (self._training and not self._done)
        # Where one worker is to blame, that is found a moment later.
        silent = max(worker.silent_s() for worker in self._everyone())
        busy_s = max((report.busy_s for report in reports), default=0.0)
        if state != self._last_state or not waiting:
            self._last_state, self._last_change = state, now
        elif now - self._last_change > self._limit and max(silent, busy_s) <= self._limit / 2:
            raise WorkerError(
                f"nothing moved for {self._limit:.0f} s: {progress.rollout}, {progress.replay}, "
                f"{progress.inference}; raise launch.stall_s if a single step takes that long"
            )
