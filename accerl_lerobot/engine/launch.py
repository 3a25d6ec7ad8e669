# SPDX-License-Identifier: Apache-2.0
"""The asynchronous engine: places the workers, connects them and watches them.

    rollout ×W ──requests──► inference ──decisions──► rollout   micro-asynchrony: others step meanwhile
        │                        ▲
        └──segments──► replay    │ weights, published without waiting
                          │      │
                          └──► trainer                          macro-asynchrony: no barrier, a measured lag

The trainer is the clock: when it has made its updates the run is over. A rollout worker or inference replica
that ends is restarted alone, see `replicas`; the end of any other worker ends this engine with its traceback,
and `run` makes another one from the last checkpoint. The same goes for a worker that hangs: every wait here
has a timeout. Workers get handles of each other and never hold the engine.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import psutil
import ray
from ray.exceptions import RayActorError, RayError, RayTaskError

from accerl_lerobot.checkpoint.layout import TRAINING_STATE, saved_version
from accerl_lerobot.engine.config import RunConfig
from accerl_lerobot.engine.loop import Engine, Progress, Saved
from accerl_lerobot.engine.placement import actor_options, learns_states, place_workers
from accerl_lerobot.engine.ray_session import RaySession
from accerl_lerobot.engine.replicas import (
    InferenceReplicas,
    RolloutSlot,
    RolloutWorkers,
    WorkerSlot,
    show_last_warnings,
)
from accerl_lerobot.engine.stopping import WorkerError
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import Load
from accerl_lerobot.replay.pacing import ASYNCHRONOUS, Schedule
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodeResult
from accerl_lerobot.transport.contract import ServiceStoppedError
from accerl_lerobot.transport.endpoint import Endpoint

logger = logging.getLogger(__name__)

POLL_S = 0.5
GONE_S, BLAME_S = 3.0, 10.0
"""How long to wait for a killed process, and for the failure that another is the consequence of."""


def end_all(workers: Iterable[WorkerSlot], *, lost: bool = False) -> None:
    """End workers, by Ray unless that is `lost`, and wait until they are gone and write nothing any more."""
    processes = []
    for worker in workers:
        if not lost:
            ray.kill(worker.actor)
        processes += [worker.process] if worker.process else []
    left = psutil.wait_procs(processes, timeout=0.0 if lost else GONE_S)[1]
    for process in left:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()  # one that is stopped does not hear Ray
    psutil.wait_procs(left, timeout=GONE_S)


def _fail(worker: WorkerSlot, error: Exception, text: str = "") -> None:
    if isinstance(error, InputError):  # another process would meet it again
        raise error
    if worker.restart is None:
        raise WorkerError(text or f"{worker.name} worker failed for good:\n{error}") from error
    worker.restart(error)


class RayEngine(Engine):
    """The asynchronous engine of a run whose ``policy.path`` is set.

    Args:
        history: env steps that an observation holds, the policy's ``n_obs_steps``.
        state: the ``training_state`` to resume from, without the episodes under way; None: begin.
        load: makes the policy's adapter, in the processes that have one; None: of LeRobot's checkpoint.
        session: the Ray to use, which outlives this engine; None: one that ends with it.
    """

    def __init__(
        self,
        config: RunConfig,
        tasks: tuple[str, ...],
        history: int = 1,
        state: Path | None = None,
        load: Load | None = None,
        session: RaySession | None = None,
    ) -> None:
        self._config, self._state, self._load = config, state, load
        self._limit = config.launch.stall_s
        self._version = 0 if state is None else saved_version(state)
        self._rollouts = RolloutWorkers(config, tasks, history, state)
        self._inference = InferenceReplicas(config, self._version, state, load, self._on_new_inference)
        self._others: list[WorkerSlot] = []
        self._imagining: list[WorkerSlot] = []  # the one that imagines, and the world model's trainer
        self._updates: list[dict[str, float]] = []
        self._schedule: Schedule = ASYNCHRONOUS
        self._training = self._real_ended = self._done = self._closed = False
        self._last_change = time.monotonic()
        self._last_state: tuple[object, ...] = ()
        self._ray = RaySession(config.launch) if session is None else session
        self._keeps_ray = session is not None
        try:
            self._ray.start()
            self._start()
        except BaseException:
            self.close()
            raise

    def plan(self, plans: list[EpisodePlan]) -> None:
        self._rollouts.plan(plans)
        self._last_change = time.monotonic()  # time before this call is the caller's

    def train(self) -> None:
        self._training, self._last_change = True, time.monotonic()
        self.follow(self._config.launch.schedule)
        self._inference.trainer = self._trainer.actor
        self._trainer.work = self._trainer.actor.run.remote(self._replay.actor, self._deciding)
        # The last replica: the first ones may have one rollout worker more.
        asks: tuple[Any, ...] = (self._deciding[-1], self._inserting)
        for worker in self._imagining:
            worker.work = worker.actor.run.remote(*asks, self._replay.actor)
            asks = (worker.actor,)  # the learner of the world model talks to the one that imagines

    def follow(self, schedule: Schedule) -> None:
        """Change the schedule of collecting and learning, see `replay.pacing`."""
        if schedule == self._schedule:
            return
        in_turn = schedule != ASYNCHRONOUS
        self._rollouts.in_turn, self._schedule = in_turn, schedule
        # The trainer first: replay's turns wait for it to hand over its weights.
        for worker in (self._trainer, self._replay):
            worker.call("follow", schedule, timeout=self._limit)
        self._inference.lock_step(in_turn)

    def poll(self) -> Progress:
        if lost := self._ray.lost:
            raise WorkerError(lost)
        for worker in (*self._inference.workers(), *self._others):
            worker.ask("metrics")
        self._rollouts.ask(self._training and not self._done)
        self._await_end()
        episodes = self._listen()
        for worker in self._everyone():
            worker.show_warnings()
        # Inference last, since others are not listened to during its restart.
        for worker in (*self._others, *self._rollouts.workers(), *self._inference.workers()):
            if why := worker.hung(self._limit):
                _fail(worker, RuntimeError(why), f"{worker.name} worker {why}")
        updates, self._updates = self._updates, []
        if updates:
            self._version = int(updates[-1]["update"])
        progress = Progress(
            version=self._version,
            done=self._done,
            updates=updates,
            episodes=episodes,
            rollout=self._rollouts.counters(),
            replay=self._replay.told or {},
            inference=self._inference.metrics(),
            imagination={k: v for w in self._imagining for k, v in (w.told or {}).items()},
        )
        self._check_moving(progress)
        return progress

    def save(self, directory: Path) -> Saved:
        directory = directory.absolute()
        state = directory / TRAINING_STATE
        # Records that the trainer has sent come first: `hold` returns the rest, up to its version.
        told = self._updates + (self._hear(self._trainer, self._limit) or [])
        self._updates = []
        version, records = self._trainer.call("hold", timeout=self._limit)  # it waits for an update at most
        # At once, so that little comes in that was decided by weights of later updates. The imaginer may
        # know of more than replay then; it is told anew of what comes after.
        self._replay.call("save", state, version, timeout=self._limit)
        for worker in reversed(self._imagining):
            worker.call("save", directory, timeout=self._limit)
        self._trainer.call("write", directory, timeout=self._limit)
        self._rollouts.save(state)
        self._last_change = time.monotonic()
        return Saved(version, told + records)

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        try:
            lost = bool(self._ray.lost)
            if lost:
                self._ray.close()
            else:
                show_last_warnings(list(self._everyone()))
            end_all(self._everyone(), lost=lost)
            if not self._keeps_ray:
                self._ray.close()
        except Exception:
            logger.exception("could not end all workers")

    def pids(self) -> dict[str, int]:
        """Process ids by worker: ``inference``, ``replay``, ``trainer``, ``rollout 0`` …; for fault tests."""
        return {w.name: int(w.call("ready", timeout=self._limit)) for w in self._everyone()}

    def _everyone(self) -> Iterator[WorkerSlot]:
        """All workers, those that others depend on first."""
        yield from self._inference.workers()
        yield from self._others
        yield from self._rollouts.workers()

    def _start(self) -> None:
        from accerl_lerobot.replay.worker import ReplayWorker
        from accerl_lerobot.trainer.peers import SHARE, LearnerSettings, TrainerRank
        from accerl_lerobot.trainer.worker import TrainerWorker
        from accerl_lerobot.world_model.worker import WORLD_MODEL_WORKER, WorldModelWorker

        c, state, timeline = self._config, self._state, self._config.timeline_folder
        plan, imagination = place_workers(c), c.imagination

        def make(name: str, kind: type, concurrency: int, *arguments: Any) -> WorkerSlot:
            options = actor_options(plan.places[name]) | {"max_concurrency": concurrency}
            worker = WorkerSlot(name, ray.remote(kind).options(**options).remote(*arguments))
            self._others.append(worker)
            return worker

        # The ranks first: Ray fills the GPU that is fullest, and each of them needs more than half of one.
        wait_s = SHARE * self._limit
        learner = LearnerSettings(c.policy, c.algorithm, c.trainer, c.seed, state, self._load, wait_s)
        others = range(1, c.trainer.ranks)
        ranks = [make(f"trainer rank {rank}", TrainerRank, 1, rank, learner).actor for rank in others]
        world_model = None
        if learns_states(c):
            arguments = (c.seed, c.trainer.num_threads, timeline)
            world_model = make(WORLD_MODEL_WORKER, WorldModelWorker, 4, *arguments).actor
        self._trainer = make("trainer", TrainerWorker, 4, learner, timeline, ranks, c.folder, world_model)
        self._inference.start(plan)
        imagined = imagination.imagined_replay(c.replay) if imagination.share else None
        stores = (c.replay, c.seed, imagined, c.rollout.episodes > 0, state, c.folder, timeline)
        self._replay = make("replay", ReplayWorker, 1000, *stores)
        if imagination.share:
            from accerl_lerobot.engine.imagination import ImaginationWorker, WorldModelLearningWorker

            for kind in (ImaginationWorker, WorldModelLearningWorker)[: 1 + imagination.learns]:
                self._imagining.append(make(kind.name, kind, 4, c, state, timeline))
        self._rollouts.start(plan)
        for worker, reference in [(w, w.actor.ready.remote()) for w in self._everyone()]:
            here = plan.places[worker.name].node.number == 0
            worker.await_start(reference, worker.start_timeout(self._limit), here)
        self._deciding = self._inference.open()
        self._inserting = self._replay.endpoint("insert", self._limit)
        self._replay.work = self._replay.actor.run.remote()
        self._rollouts.run(self._deciding, self._inserting)

    def _on_new_inference(self, index: int, inference: Endpoint) -> None:
        self._deciding[index] = inference
        self._rollouts.move(index, inference)
        if self._imagining and index == len(self._deciding) - 1:
            self._imagining[0].call("move", inference, timeout=self._limit)
        self._last_change = time.monotonic()  # a restart has timeouts of its own

    def _await_end(self) -> None:
        """Wait a little, and handle every worker whose long call has ended."""
        works = {worker.work: worker for worker in self._everyone() if worker.work is not None}
        if not ray.wait(list(works), num_returns=1, timeout=POLL_S)[0]:
            return
        ended = set(ray.wait(list(works), num_returns=len(works), timeout=0)[0])
        for reference, worker in works.items():
            if reference in ended and worker.work is reference:
                self._ended(worker)

    def _ended(self, worker: WorkerSlot) -> None:
        """Handle the end of a worker's long call: restart it, finish, or raise."""
        reference, worker.work = worker.work, None
        try:
            result = ray.get(reference)
        except RayError as error:
            if isinstance(error, RayTaskError) and isinstance(error.cause, RayError | ServiceStoppedError):
                self._blame()
            _fail(worker, error)
            return
        if worker is self._trainer:
            self._finish(int(result))
        elif not (self._done and worker in (self._replay, *self._imagining)):
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
        self._replay.told = self._replay.call("metrics", timeout=self._limit)

    def _listen(self) -> list[EpisodeResult]:
        episodes: list[EpisodeResult] = []
        for worker in self._everyone():
            answer = self._hear(worker)
            if worker is self._trainer:
                self._updates += answer or []
            elif answer is not None and isinstance(worker, RolloutSlot):
                episodes += worker.take(answer)
        if not self._real_ended and self._rollouts.spent:
            self._real_ended = True
            self._replay.call("change", real_ended=True, timeout=self._limit)
        return episodes

    def _hear(self, worker: WorkerSlot, timeout: float = 0.0) -> Any:
        try:
            return worker.answer(timeout)
        except RayError as error:
            # Where a process has died, its long call has ended as well, which `_await_end` deals with.
            if worker.restart is None or not isinstance(error, RayActorError):
                _fail(worker, error)
            return None

    def _check_moving(self, progress: Progress) -> None:
        """End a run in which every worker answers and nothing moves."""
        imagined = tuple(progress.imagination.get(k) for k in ("decisions", "learn_steps", "validation_s"))
        state = (progress.version, self._rollouts.moves, progress.rollout["restarts"], imagined)
        now = time.monotonic()
        waiting = self._rollouts.outstanding or (self._training and not self._done)
        # Where one worker is to blame, that is found a moment later.
        silent = max(worker.silent_s() for worker in self._everyone())
        suspect = max(silent, self._rollouts.busy_s) > self._limit / 2
        if state != self._last_state or not waiting:
            self._last_state, self._last_change = state, now
        elif now - self._last_change > self._limit and not suspect:
            raise WorkerError(
                f"nothing moved for {self._limit:.0f} s: {progress.rollout}, {progress.replay}, "
                f"{progress.inference}; raise launch.stall_s if a single step takes that long"
            )
