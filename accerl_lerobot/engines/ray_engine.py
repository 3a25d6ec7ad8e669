# SPDX-License-Identifier: Apache-2.0
"""The asynchronous engine: places the workers, connects them and watches them.

    rollout ×W ──requests──► inference ──decisions──► rollout   micro-asynchrony: others step meanwhile
        │                        ▲
        └──segments──► replay    │ weights, taken without the trainer waiting
                          │      │
                          └──► trainer                          macro-asynchrony: no barrier, a measured lag

The trainer is the clock: when it has made its updates the run is over. A rollout worker or inference replica
that ends or hangs is restarted alone, see `supervision`. The loss of any other worker ends this engine with
its traceback, and `run` makes another engine from the last checkpoint. Every wait here has a timeout. Workers
get handles of each other and never hold the engine.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayError

from accerl_lerobot.checkpoint.layout import TRAINING_STATE, saved_version
from accerl_lerobot.engines import Engine, Progress
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.engines.ray_session import NO_HUB_TOKEN, learns_states, place_workers, start_ray
from accerl_lerobot.engines.stopping import WorkerError
from accerl_lerobot.engines.supervision import (
    RESTARTED,
    SAVE_LIMITS,
    START_S,
    RestartedWorker,
    RolloutSlot,
    Worker,
    end_all,
    has_died,
    restore_rollouts,
    save_rollouts,
    total_counters,
)
from accerl_lerobot.inference.batcher import merge_metrics
from accerl_lerobot.metrics import numbered
from accerl_lerobot.policies.config import Load
from accerl_lerobot.replay.buffer import ASYNCHRONOUS, Schedule
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodeResult
from accerl_lerobot.world_model.config import WORLD_LEARNING

logger = logging.getLogger(__name__)

POLL_S = 0.5


class InferenceReplica(RestartedWorker):
    """An inference replica. A request carries its noise, and clients ask a restarted replica again.

    So a restart loses nothing, except in ``accerl eval`` of a policy that keeps something between decisions:
    `StockAdapter` refuses to go on with such an episode.
    """

    trainer: Any = None  # handle of the trainer, once it publishes weights
    together = 0  # observations that are decided in lock step; 0: as they come

    def ready_arguments(self) -> tuple[Any, ...]:
        return () if self.trainer is None else (self.trainer,)

    def begin(self) -> None:
        self.note_long_call(self.actor.serve.remote())
        if self.trainer is not None:
            self.actor.follow.remote(self.trainer)  # also where `train` asked while it was restarting
        if self.together:
            self.actor.lock_step.remote(self.together)


class RayEngine(Engine):
    """The asynchronous engine of a run whose ``policy.path`` is set; starts Ray if it is not there.

    Args:
        history: env steps that an observation holds, the policy's ``n_obs_steps``.
        state: the ``training_state`` to resume from, without the episodes under way; None: begin.
        load: makes the policy's adapter, in the processes that have one; None: of LeRobot's checkpoint.
        learns: False: only planned episodes are played, and no process learns.
    """

    def __init__(
        self,
        config: RunConfig,
        tasks: tuple[str, ...],
        history: int = 1,
        state: Path | None = None,
        load: Load | None = None,
        learns: bool = True,
    ) -> None:
        self._config = config
        self._learns = learns
        self._limit = config.launch.stall_s
        self._version = 0 if state is None else saved_version(state)
        self._rollouts: list[RolloutSlot] = []
        self._inference: list[InferenceReplica] = []
        self._others: list[Worker] = []
        self._trainer: Any = None  # a `Worker`, if it learns
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
            self._place(tasks, history, state, load)
            if state is not None:
                restore_rollouts(state, self._rollouts)
            self._await_start()
        except BaseException:
            self.close()
            raise

    def plan(self, plans: list[EpisodePlan]) -> None:
        for worker in self._rollouts:
            worker.assign(plans[worker.index :: len(self._rollouts)])
        self._last_change = time.monotonic()  # time before this call is the caller's

    def train(self) -> None:
        self._training = True
        self._last_change = time.monotonic()
        self.set_schedule(self._config.launch.schedule)
        self._trainer.long_call = self._trainer.actor.run.remote(self._replay.actor)
        for replica in self._inference:
            replica.trainer = self._trainer.actor
            replica.actor.follow.remote(replica.trainer)  # `begin` asks again after a restart

    def set_schedule(self, schedule: Schedule) -> None:
        """Change the schedule of collecting and learning, see `replay.buffer`."""
        if schedule == self._schedule:
            return
        self._schedule = schedule
        # The trainer first: replay's turns wait for it to hand over its weights.
        for worker in (self._trainer, self._replay):
            worker.call("set_schedule", schedule)
        for index, replica in enumerate(self._inference):
            clients = len(self._rollouts[index :: len(self._inference)])
            together = clients * self._config.rollout.environments
            replica.together = 0 if schedule == ASYNCHRONOUS else together
            replica.actor.lock_step.remote(replica.together)

    def poll(self) -> Progress:
        self._ask()
        self._wait_for_ends()
        episodes = self._listen()
        self._end_collection()
        self._hand_over_world()
        self._supervise()
        updates = self._updates
        self._updates = []
        if updates:
            self._version = int(updates[-1]["update"])
        served = [replica.last_answer for replica in self._inference if replica.last_answer]
        inference = merge_metrics(served)
        inference["restarts"] = float(sum(replica.all_restarts for replica in self._inference))
        world_model = None if self._world_learner is None else self._world_learner.last_answer
        progress = Progress(
            version=self._version,
            done=self._done,
            updates=updates,
            episodes=episodes,
            rollout=dict(total_counters(self._rollouts)),
            replay=self._replay.last_answer or {},
            inference=inference,
            world_model=world_model or {},
        )
        self._check_moving(progress)
        return progress

    def save(self, directory: Path) -> Progress:
        directory = directory.absolute()
        state = directory / TRAINING_STATE
        # Records that the trainer has sent come first: `copy_state` returns the rest, up to its version.
        self._hear(self._trainer, self._limit)
        limit = SAVE_LIMITS * self._limit
        version, records = self._trainer.call("copy_state", timeout=limit)  # it waits for an update at most
        # At once, so that little comes in that was decided by weights of later updates.
        self._replay.call("save", state, version, timeout=limit)
        if self._world_learner is not None:
            self._world_learner.call("save", directory, timeout=limit)
        self._trainer.call("write", directory, timeout=limit)
        save_rollouts(state, self._rollouts)
        self._last_change = time.monotonic()
        updates = self._updates + records
        self._updates = []
        return Progress(version=version, updates=updates)

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
        return {w.name: int(w.call("ready")) for w in self._everyone()}

    def _everyone(self) -> Iterator[Worker]:
        """All workers, those that others depend on first."""
        yield from self._inference
        yield from self._others
        yield from self._rollouts

    def _place(self, tasks: tuple[str, ...], history: int, state: Path | None, load: Load | None) -> None:
        """Create all workers."""
        from accerl_lerobot.inference.worker import InferenceWorker
        from accerl_lerobot.replay.worker import ReplayWorker
        from accerl_lerobot.rollout.worker import RolloutWorker

        config = self._config
        timeline = config.timeline_folder
        in_cluster = config.launch.address is not None
        placement = place_workers(config)

        def actor(role: str, kind: type, concurrency: int, *arguments: Any, **options: Any) -> Any:
            options |= placement.options(role) | {"max_concurrency": concurrency}
            return ray.remote(kind).options(**options).remote(*arguments)

        def add(name: str, *arguments: Any) -> Worker:
            self._others.append(Worker(name, actor(*arguments), config.launch))
            return self._others[-1]

        stores = (config.replay, config.seed, state, config.folder, timeline, in_cluster)
        self._replay = add("replay", "replay", ReplayWorker, 1000, *stores)
        replicas = numbered("inference", config.inference.workers)
        if self._learns:
            self._trainer = self._place_trainer(add, replicas, state, load)
        for name in replicas:
            deciding = (config.policy, config.inference, self._version, state, load, timeline, name)
            handle = actor("inference", InferenceWorker, 1000, *deciding, in_cluster, **RESTARTED)
            self._inference.append(InferenceReplica(name, handle, config.launch))
        for index in range(config.rollout.workers):
            name = f"rollout {index}"
            collecting = (config.env, config.rollout, name, history, timeline, config.imagination)
            handle = actor("rollout", RolloutWorker, 4, *collecting, **RESTARTED, **NO_HUB_TOKEN)
            self._rollouts.append(RolloutSlot(index, handle, config, tasks))

    def _place_trainer(
        self, add: Callable[..., Worker], replicas: list[str], state: Path | None, load: Load | None
    ) -> Worker:
        """Create the trainer and the workers that learn with it; `add` makes one of them."""
        from accerl_lerobot.trainer.worker import RANK_WAIT_SHARE, LearnerSettings, TrainerRank, TrainerWorker
        from accerl_lerobot.world_model.worker import WORLD_MODEL_WORKER, WorldModelWorker

        config = self._config
        timeline = config.timeline_folder
        # The ranks before others with a network: Ray fills the GPU that is fullest, and each rank needs more
        # than half of one.
        settings = LearnerSettings(
            policy=config.policy,
            algorithm=config.algorithm,
            trainer=config.trainer,
            seed=config.seed,
            state=state,
            load=load,
            timeout_s=RANK_WAIT_SHARE * self._limit,
        )
        ranks = [
            add(f"trainer rank {rank}", "trainer", TrainerRank, 1, rank, settings).actor
            for rank in range(1, config.trainer.ranks)
        ]
        world_model = online = None
        if learns_states(config):
            learning = (config.seed, config.trainer.num_threads, config.policy.device, timeline)
            world_model = add(WORLD_MODEL_WORKER, "world_model", WorldModelWorker, 4, *learning).actor
        if config.imagination.learns:
            from accerl_lerobot.world_model.training import OnlineLearningWorker

            self._world_learner = add(
                WORLD_LEARNING, "world_model", OnlineLearningWorker, 4, config, state, timeline
            )
            online = self._world_learner.actor
        training = (settings, timeline, ranks, world_model, replicas, online)
        return add("trainer", "trainer", TrainerWorker, 4 + len(replicas), *training)

    def _await_start(self) -> None:
        """Wait until all workers are ready, and have them begin."""
        workers = list(self._everyone())
        ready = [worker.actor.ready.remote(*worker.ready_arguments()) for worker in workers]
        for worker, reference in zip(workers, ready, strict=True):
            worker.pid = worker.result(reference, "ready", START_S)
        self._replay.long_call = self._replay.actor.run.remote()
        if self._world_learner is not None:
            self._world_learner.long_call = self._world_learner.actor.run.remote()
        for slot in self._rollouts:
            replica = self._inference[slot.index % len(self._inference)]
            slot.services = (replica.endpoint, self._replay.endpoint)
        for worker in (*self._inference, *self._rollouts):
            worker.begin()

    def _ask(self) -> None:
        """Ask each worker that has answered for the next report."""
        for worker in self._everyone():
            if isinstance(worker, RestartedWorker) and worker.is_starting:
                continue
            if isinstance(worker, RolloutSlot):
                worker.ask_report(self._training and not self._done, self._schedule != ASYNCHRONOUS)
            else:
                worker.ask("metrics")

    def _wait_for_ends(self) -> None:
        """Wait a little, and handle every worker whose long call has ended."""
        calls = {worker.long_call: worker for worker in self._everyone() if worker.long_call is not None}
        if not ray.wait(list(calls), num_returns=1, timeout=POLL_S)[0]:
            return
        ended = ray.wait(list(calls), num_returns=len(calls), timeout=0)[0]
        for reference, worker in calls.items():
            if reference in ended:
                worker.long_call = None
                try:
                    result = ray.get(reference)
                except RayError as error:
                    worker.handle_loss(error)
                else:
                    self._ended(worker, result)

    def _ended(self, worker: Worker, result: Any) -> None:
        """Handle the end of a worker's long call that did not fail."""
        if worker is self._trainer:
            self._finish(int(result))
            return
        closed = self._done and worker is self._replay
        if not closed:
            raise WorkerError(f"{worker.name} worker ended without being asked to")

    def _finish(self, version: int) -> None:
        """The trainer has made its updates: complete its records and those of replay."""
        self._done = True
        self._version = version
        self.set_schedule(ASYNCHRONOUS)
        self._hear(self._trainer, self._limit)
        self._updates += self._trainer.call("metrics")
        self._replay.call("close")
        self._hear(self._replay, self._limit)
        self._replay.last_answer = self._replay.call("metrics")

    def _listen(self) -> list[EpisodeResult]:
        """Take all answers that have come; returns the episodes in them."""
        episodes: list[EpisodeResult] = []
        for worker in self._everyone():
            answer = self._hear(worker)
            if answer is not None and isinstance(worker, RolloutSlot):
                episodes += worker.take(answer)
        return episodes

    def _end_collection(self) -> None:
        """Tell replay once every exploring episode of ``rollout.episodes`` is in it."""
        if self._collected or self._config.imagination.environments:
            return
        if all(slot.spent for slot in self._rollouts):
            self._collected = True
            self._replay.call("end")

    def _hear(self, worker: Worker, timeout: float = 0.0) -> Any:
        """Take the answer to the last question, if it has come; records of updates are kept."""
        try:
            answer = worker.answer(timeout)
        except RayError as error:
            # Where a process has died, its long call has ended as well, which `_wait_for_ends` deals with.
            if not (has_died(error) and isinstance(worker, RestartedWorker)):
                worker.handle_loss(error)
            return None
        if worker is self._trainer:
            self._updates += answer or []
        return answer

    def _hand_over_world(self) -> None:
        """Give a new version of the world model to the rollout workers."""
        learner = self._world_learner
        if learner is None or not learner.last_answer:
            return
        version = int(learner.last_answer["version"])
        if version <= self._world_version:
            return
        self._world_version = version
        newest = learner.actor.weights.remote()
        for slot in self._rollouts:
            slot.world = newest
            slot.actor.imagine_with.remote(newest)

    def _supervise(self) -> None:
        """Give up workers that hang, and go on with those that are being restarted."""
        for worker in (*self._others, *self._rollouts, *self._inference):
            if isinstance(worker, RestartedWorker) and worker.is_starting:
                self._last_change = time.monotonic()  # a restart has a timeout of its own
                if worker.advance_start():
                    worker.begin()
            elif why := worker.why_given_up():
                worker.handle_loss(WorkerError(f"{worker.name} worker {why}"))

    def _check_moving(self, progress: Progress) -> None:
        """End a run in which every worker answers and nothing moves."""
        moves = sum(slot.last_answer.moves for slot in self._rollouts if slot.last_answer is not None)
        state = (progress.version, moves, progress.rollout["restarts"])
        planned = any(slot.outstanding for slot in self._rollouts)
        awaited = planned or (self._training and not self._done)
        now = time.monotonic()
        if state != self._last_state or not awaited:
            self._last_state = state
            self._last_change = now
        elif now - self._last_change > 2 * self._limit:  # a single worker that hangs is found earlier
            hint = "raise launch.stall_s if a single step takes that long"
            raise WorkerError(f"nothing moved for {2 * self._limit:.0f} s; {hint}")
