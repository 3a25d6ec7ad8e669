# SPDX-License-Identifier: Apache-2.0
"""Places the workers, connects them and watches them.

    rollout ×W ──requests──► inference ──decisions──► rollout   micro-asynchrony: others step meanwhile
        │                        ▲
        └──segments──► replay    │ weights, published without waiting
                          │      │
                          └──► trainer                          macro-asynchrony: no barrier, a measured lag

    imagination ──requests──► inference ──decisions──► imagination ──segments──► replay
       ▲                                                                 │
       └────── world models that have passed ◄── world learning ◄──real──┘

The trainer is the clock: when it has made its updates the run is over. Another worker that ends is an event:
a rollout worker is started again, a few times (with it go its unfinished segments and groups, nothing else),
and so is an inference service (with it goes nothing); any other ends this engine with its own traceback, and
`run` makes another one that goes on from the last checkpoint. The same goes for one that hangs: nothing here
waits for an answer without a limit. Workers get handles and never hold the conductor.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayError, RayTaskError

from accerl_lerobot.checkpoint.layout import TRAINING_STATE, saved_version
from accerl_lerobot.engine.cluster import on, placed
from accerl_lerobot.engine.config import RunConfig, journal_folder, timeline_folder
from accerl_lerobot.engine.contract import Engine, Progress, Saved, WorkerError
from accerl_lerobot.engine.own_ray import OwnRay
from accerl_lerobot.engine.seats import START_S, Seats
from accerl_lerobot.engine.services import Services
from accerl_lerobot.engine.watched import Watched, end
from accerl_lerobot.inference.batcher import BatcherStats
from accerl_lerobot.metrics import numbered
from accerl_lerobot.policies.config import Load
from accerl_lerobot.replay.turns import ASYNCHRONOUS, Schedule
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodeResult
from accerl_lerobot.transport.contract import ServiceStoppedError
from accerl_lerobot.transport.endpoint import Endpoint, listens
from accerl_lerobot.world_model.imagination.guard import IMAGINATION, combine_metrics

logger = logging.getLogger(__name__)

POLL_S = 0.5
BLAME_S = 10.0
"""How long to wait for the failure that another failure is the consequence of."""


class RayEngine(Engine):
    """The asynchronous engine.

    Args:
        config: the run; its ``policy.path`` must be set.
        tasks: the training tasks.
        history: env steps that an observation holds, the policy's ``n_obs_steps``.
        state: the ``training_state`` to go on from, but for episodes under way, which are lost; None: begin.
        load: makes the policy's adapter, in the processes that have one; None: of LeRobot's checkpoint.
        own: the Ray to use, which outlives this engine; None: one that ends with it.

    Raises:
        InputError: the state is of a run in one process, or this system has no shared memory.
        WorkerError: a worker did not start; carries its own traceback.
    """

    def __init__(
        self,
        config: RunConfig,
        tasks: tuple[str, ...],
        history: int = 1,
        state: Path | None = None,
        load: Load | None = None,
        own: OwnRay | None = None,
    ) -> None:
        listens(config.launch.transport)
        self._config, self._state, self._load = config, state, load
        self._others: list[Watched] = []
        """All but inference services and rollout workers."""
        self._seats = Seats(config, tasks, history, state)
        self._updates: list[dict[str, float]] = []
        self._replay_metrics: dict[str, float] = {}
        self._inference_metrics: dict[str, float] = {}
        self._imagination_metrics: dict[str, dict[str, float]] = {}
        self._of_learner: dict[str, float] = {}
        self._imagination: list[Watched] = []
        self._learner: Watched | None = None
        self._ranks: list[Watched] = []
        """The trainer's, but the first."""
        self._real_ended = False
        self._schedule: Schedule = ASYNCHRONOUS
        self._training = self._done = self._closed = False
        self._version = 0 if state is None else saved_version(state)
        self._inference = Services(config, self._version, state, load)
        self._last_change = time.monotonic()
        self._last_state: tuple[object, ...] = ()
        self._ray = OwnRay(config.launch) if own is None else own
        self._lasting = own is not None
        try:
            self._ray.start()
            self._start()
        except BaseException:
            self.close()
            raise

    def plan(self, plans: list[EpisodePlan]) -> None:
        self._seats.plan(plans)
        self._last_change = time.monotonic()  # whatever the caller did before took its time

    def train(self) -> None:
        self._training, self._last_change = True, time.monotonic()
        self.follow(self._config.launch.schedule)
        readers = self._inference.publishing(self._trainer.actor)
        self._trainer.work = self._trainer.actor.run.remote(
            self._replay.actor, readers, self._config.launch.transport
        )
        imaginers = [worker.actor for worker in self._imagination]
        for worker, (deciding, inserting) in zip(self._imagination, self._imagination_endpoints, strict=True):
            worker.work = worker.actor.run.remote(deciding, inserting, self._replay.actor)
        if self._learner is not None:
            self._learner.work = self._learner.actor.run.remote(imaginers, self._replay.actor)

    def follow(self, schedule: Schedule) -> None:
        """From now on, collecting and learning take turns like this, see `replay.turns`."""
        if schedule == self._schedule:
            return
        in_turn = schedule != ASYNCHRONOUS
        self._seats.in_turn, self._schedule = in_turn, schedule
        # The trainer first: who takes turns waits for it to hand over its weights.
        for worker in (self._trainer, self._replay):
            worker.call("follow", schedule, timeout=self._limit)
        self._inference.lock_step(in_turn)

    def poll(self) -> Progress:
        if lost := self._ray.lost:
            raise WorkerError(lost)
        self._ask()
        self._await_end()
        for number, endpoint in self._inference.advance():
            self._move(number, endpoint)
        episodes = self._listen()
        self._check_hung()
        updates, self._updates = self._updates, []
        if updates:
            self._version = int(updates[-1]["update"])
        progress = Progress(
            version=self._version,
            done=self._done,
            updates=updates,
            episodes=episodes,
            rollout=self._seats.counters(),
            replay=self._replay_metrics,
            inference=self._inference_metrics,
            imagination=combine_metrics(list(self._imagination_metrics.values())) | self._of_learner,
        )
        self._check_moving(progress)
        return progress

    def save(self, directory: Path) -> Saved:
        directory = directory.absolute()
        state = directory / TRAINING_STATE
        # What the trainer has told already is heard first: all other records up to its version come with it.
        told = self._updates + (self._hear(self._trainer, self._limit) or [])
        self._updates = []
        limit = max(START_S, self._limit)  # files may be large
        alive = {"timeout": limit, "silence": self._limit}
        version, records = self._trainer.call("hold", timeout=self._limit)  # it waits for an update at most
        # At once, so that little comes in that was decided by weights of later updates. Workers that imagine
        # may know of more than replay then; they are told anew of what comes after.
        self._replay.call("save", state, version, **alive)
        for imaginer in self._imaginers:
            imaginer.call("save", directory, **alive)
        self._trainer.call("write", directory, **alive)
        self._seats.save(state)
        self._last_change = time.monotonic()
        return Saved(version, told + records)

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        try:
            if lost := bool(self._ray.lost):
                self._ray.close()
            end(self._everyone(), told=not lost)
            if not self._lasting:
                self._ray.close()
        except Exception:
            logger.exception("could not end all workers")

    def pids(self) -> dict[str, int]:
        """Process ids by worker: ``inference``, ``replay``, ``trainer``, ``rollout 0`` …; for fault tests."""
        return {w.name: int(w.call("ready", timeout=self._limit)) for w in self._everyone()}

    def batching(self) -> BatcherStats:
        """Batches of the inference services so far."""
        return self._inference.batching()

    @property
    def _limit(self) -> float:
        return self._config.launch.stall_s

    @property
    def _imaginers(self) -> list[Watched]:
        """In the order in which they are saved: the learner, then the workers that use its model."""
        return [*([self._learner] if self._learner is not None else []), *self._imagination]

    def _everyone(self) -> Iterator[Watched]:
        """All workers, those that others depend on first."""
        yield from self._inference.workers()
        yield from self._others
        yield from self._seats.workers()

    def _start(self) -> None:
        from accerl_lerobot.replay.worker import ReplayWorker
        from accerl_lerobot.trainer.peers import TrainerRank
        from accerl_lerobot.trainer.worker import TrainerWorker

        c, timeline = self._config, timeline_folder(self._config)
        plan, imagination = placed(c), c.imagination

        def make(name: str, kind: type, calls: int, *arguments: Any) -> Any:
            options = on(plan.places[name]) | {"max_concurrency": calls}
            return ray.remote(kind).options(**options).remote(*arguments)

        # The ranks first: Ray fills the GPU that is fullest, and each of them needs more than half of one.
        learner = (c.policy, c.algorithm, c.trainer, c.seed, self._state, self._load)
        peers = [f"trainer rank {rank}" for rank in range(1, c.trainer.ranks)]
        ranks = [make(name, TrainerRank, 1, i, *learner) for i, name in enumerate(peers, start=1)]
        trainer = make("trainer", TrainerWorker, 4, *learner, timeline, ranks, journal_folder(c))
        self._inference.start(plan)
        imagined, counted = imagination.replay if imagination.share else None, c.rollout.episodes > 0
        stores = (c.replay, c.seed, imagined, counted, self._state, journal_folder(c), timeline)
        self._replay = self._other("replay", make("replay", ReplayWorker, 1000, *stores, imagination.workers))
        self._ranks = [self._other(*rank) for rank in zip(peers, ranks, strict=True)]
        self._trainer = self._other("trainer", trainer)
        if imagination.share:
            from accerl_lerobot.engine.imagination_workers import ImaginationWorker, WorldLearningWorker

            for i, n in enumerate(numbered(IMAGINATION, imagination.workers)):
                worker = make(n, ImaginationWorker, 4, c, self._state, timeline, i)
                self._imagination.append(self._other(n, worker))
            if imagination.learns:
                learns = make("world learning", WorldLearningWorker, 4, c, self._state, timeline)
                self._learner = self._other("world learning", learns)
        self._seats.start(plan)
        ready = [(worker, worker.actor.ready.remote()) for worker in self._everyone()]
        for worker, reference in ready:
            here = plan.places[worker.name].node.number == 0
            worker.await_start(reference, max(START_S, self._limit), here)
        way = c.launch.transport, self._limit
        deciding, inserting = self._inference.open(), self._replay.endpoint("insert", *way)
        # Those that get one rollout worker more come first.
        self._imagination_endpoints = [
            (deciding[-1 - i % len(deciding)], inserting) for i in range(len(self._imagination))
        ]
        self._replay.work = self._replay.actor.run.remote()
        self._seats.set_to_work(deciding, inserting)

    def _other(self, name: str, actor: Any) -> Watched:
        self._others.append(Watched(name, actor))
        return self._others[-1]

    def _move(self, number: int, inference: Endpoint) -> None:
        """Tells those who ask an inference service where it is now."""
        self._seats.move(number, inference)
        services = self._config.inference.workers
        for i, worker in enumerate(self._imagination):
            if services - 1 - i % services == number:
                self._imagination_endpoints[i] = inference, self._imagination_endpoints[i][1]
                worker.call("move", inference, timeout=self._limit)

    def _ask(self) -> None:
        self._inference.ask()
        for worker in self._others:
            worker.ask("metrics")
        self._seats.ask(self._training and not self._done)

    def _await_end(self) -> None:
        """Waits a little, and deals with every worker whose long call has ended."""
        works = {worker.work: worker for worker in self._everyone() if worker.work is not None}
        awaited = [*works, *self._inference.awaited()]
        if not ray.wait(awaited, num_returns=1, timeout=POLL_S)[0]:
            return
        ended = set(ray.wait(list(works), num_returns=len(works), timeout=0)[0])
        for reference, worker in works.items():
            if reference in ended and worker.work is reference:
                self._ended(worker)

    def _ended(self, worker: Watched) -> None:
        """Decides what the end of a worker's long call means."""
        reference, worker.work = worker.work, None
        try:
            result = ray.get(reference)
        except RayError as error:
            innocent = RayError | ServiceStoppedError
            if isinstance(error, RayTaskError) and isinstance(error.cause, innocent):
                self._blame()
            if self._inference.restart_worker(worker, error) or self._seats.restart_worker(worker, error):
                return
            raise WorkerError(f"{worker.name} worker failed for good:\n{error}") from error
        if worker is self._trainer:
            self._finish(int(result))
        elif not (self._done and worker in (self._replay, *self._imaginers)):
            raise WorkerError(f"{worker.name} worker ended without being asked to")

    def _blame(self) -> None:
        """A worker failed because of another one: ends the run with that one's failure, if it is found."""
        works = {w.work: w for w in self._others if w is not self._trainer and w.work is not None}
        if works:
            for reference in ray.wait(list(works), num_returns=1, timeout=BLAME_S)[0]:
                self._ended(works[reference])

    def _finish(self, version: int) -> None:
        """The trainer has made its updates; its records and those of replay are completed."""
        self._done, self._version = True, version
        self.follow(ASYNCHRONOUS)
        self._updates += self._hear(self._trainer, self._limit) or []
        self._updates += self._trainer.call("metrics", timeout=self._limit)
        self._replay.call("close", timeout=self._limit)
        self._hear(self._replay, self._limit)
        self._replay_metrics = self._replay.call("metrics", timeout=self._limit)

    def _listen(self) -> list[EpisodeResult]:
        """Picks up the answers that have come; returns the episodes among them."""
        self._updates += self._hear(self._trainer) or []
        self._replay_metrics = self._hear(self._replay) or self._replay_metrics
        self._inference_metrics = self._inference.listen()
        for rank in self._ranks:
            self._hear(rank)
        for worker in self._imagination:
            self._imagination_metrics[worker.name] = self._hear(worker) or self._imagination_metrics.get(
                worker.name, {}
            )
        if self._learner is not None:
            self._of_learner = self._hear(self._learner) or self._of_learner
        episodes = self._seats.listen()
        if not self._real_ended and self._seats.spent:
            self._real_ended = True
            self._replay.call("end_real", timeout=self._limit)
        return episodes

    def _hear(self, worker: Watched, timeout: float = 0.0) -> Any:
        try:
            return worker.answer(timeout)
        except RayError as error:
            raise WorkerError(f"{worker.name} worker failed for good:\n{error}") from error

    def _check_hung(self) -> None:
        """Starts a rollout worker or inference service again that does not answer, or does not get on.

        Raises:
            WorkerError: another worker does not answer.
        """
        for worker in self._others:
            if worker.silent_s() > self._limit:
                raise WorkerError(f"{worker.name} worker has not answered for {worker.silent_s():.0f} s")
        self._inference.check_hung()
        self._seats.check_hung(self._inference.up)

    def _check_moving(self, progress: Progress) -> None:
        """Ends a run in which everybody answers and nothing moves.

        Raises:
            WorkerError: neither decisions nor updates for `LaunchConfig.stall_s`.
        """
        imagined = tuple(progress.imagination.get(k) for k in ("decisions", "learn_steps", "validation_s"))
        state = (progress.version, progress.rollout.get("decisions"), progress.rollout["restarts"], imagined)
        now = time.monotonic()
        waiting = self._seats.outstanding or (self._training and not self._done)
        # Where one worker is to blame, `_check_hung` comes to it a moment later.
        silent = max(worker.silent_s() for worker in self._everyone())
        suspect = max(silent, self._seats.stuck_s) > self._limit / 2
        # A service that is to come has a limit of its own.
        if state != self._last_state or not waiting or not all(self._inference.up):
            self._last_state, self._last_change = state, now
        elif now - self._last_change > self._limit and not suspect:
            raise WorkerError(
                f"nothing moved for {self._limit:.0f} s: {progress.rollout}, {progress.replay}, "
                f"{progress.inference}; raise launch.stall_s if a single step takes that long"
            )
