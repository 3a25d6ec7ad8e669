# SPDX-License-Identifier: Apache-2.0
"""Supervision of the processes of an asynchronous run.

Ray restarts the process of a rollout worker or an inference replica when it has died. The driver ends one
that hangs or whose long call has failed, which Ray then restarts in the same way, and tells each new process
what it has to know. Resuming a run works the same way.
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import psutil
import ray
from ray.exceptions import ActorDiedError, GetTimeoutError, RayActorError, RayError, RayTaskError

from accerl_lerobot import errors
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.engines.stopping import WorkerError
from accerl_lerobot.errors import InputError, last_exception
from accerl_lerobot.experience import REAL
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodePlans, EpisodeResult, budgets, incarnation_after
from accerl_lerobot.rollout.worker import Report
from accerl_lerobot.transport.connection import Endpoint

logger = logging.getLogger(__name__)

START_S = 600.0  # timeout for the start of a worker; `LaunchConfig.stall_s` counts from its first answer
STEADY_S = 30.0  # a worker that has run for so long starts counting restarts anew
WARNINGS_S, LAST_WARNINGS_S = 5.0, 1.0
"""Interval at which a worker hands over its warnings, and how long its last ones are waited for."""
GONE_S = 3.0  # how long to wait for a killed process
MOST_BEGUN = 16  # real episodes whose resets a restarted rollout process repeats, if it imagines
ROLLOUT = "rollout"  # name of the rollout workers' part of a checkpoint
FINAL = (RayTaskError, ActorDiedError)  # errors after which another process would not start either
RESTARTED = {"max_restarts": -1}
"""Options of an actor that Ray restarts; `RestartedWorker` ends it after too many restarts."""


class Worker:
    """A worker without which the run cannot go on, with a long call that must not end unasked.

    Questions are asked one at a time, without waiting, and answers picked up later, so a worker that hangs
    cannot hang the engine, its silence has a length, and orders arrive in order, which Ray does not promise
    for an actor with threads.
    """

    def __init__(self, name: str, actor: Any, is_here: bool = True) -> None:
        self.name, self.actor = name, actor
        self.endpoint = Endpoint(name=name, actor=actor)
        self.work: Any = None  # reference of the long call
        self.process: psutil.Process | None = None  # None: not known yet, or on another node
        self.last_answer: Any = None
        self._is_here = is_here
        self._question: Any = None
        self._asked = 0.0
        self._warnings: Any = None  # handed over at the next look
        self._warnings_since = -math.inf

    def start_timeout(self, limit: float) -> float:
        """Seconds that a new process may take before it answers, where an answer may take `limit` later."""
        return max(START_S, limit)

    def started(self, pid: int) -> None:
        """Note the process id, which a worker returns once it is ready."""
        self.process = None
        if self._is_here:
            with contextlib.suppress(psutil.NoSuchProcess):  # the next question will tell
                self.process = psutil.Process(pid)

    def ask(self, method: str, *arguments: Any) -> bool:
        """Ask unless an answer is outstanding; returns True if it did."""
        if self._question is not None:
            return False
        self._question = getattr(self.actor, method).remote(*arguments)
        self._asked = time.monotonic()
        return True

    def answer(self, timeout: float = 0.0) -> Any:
        """The answer to the last question, once; None if there is none yet."""
        if self._question is None or not ray.wait([self._question], timeout=timeout)[0]:
            return None
        question, self._question = self._question, None
        self.last_answer = ray.get(question)
        return self.last_answer

    def silent_s(self) -> float:
        """Seconds for which an answer has been outstanding."""
        if self._question is None or ray.wait([self._question], timeout=0)[0]:
            return 0.0
        return time.monotonic() - self._asked

    def hung(self, limit: float) -> str:
        """Reason to give it up; empty: none."""
        silent = self.silent_s()
        return f"has not answered for {silent:.0f} s" if silent > limit else ""

    def call(self, method: str, *arguments: Any, timeout: float, **fields: Any) -> Any:
        return self.result(getattr(self.actor, method).remote(*arguments, **fields), method, timeout)

    def result(self, reference: Any, method: str, timeout: float) -> Any:
        """See `call`, for a call that has been made."""
        try:
            return ray.get(reference, timeout=timeout)
        except GetTimeoutError as error:
            raise WorkerError(f"{self.name} worker did not answer {method} within {timeout:.0f} s") from error
        except RayError as error:
            raise WorkerError(f"{self.name} worker failed in {method}:\n{error}") from error

    def lost(self, error: Exception, text: str = "") -> None:
        """Deal with a failure: here the run cannot go on, with this text."""
        if isinstance(error, InputError):  # another process would meet it again
            raise error
        raise WorkerError(text or f"{self.name} worker failed for good:\n{error}") from error

    def show_warnings(self) -> None:
        """Show what its process has warned of, as far as it has handed that over."""
        if self._warnings is not None and ray.wait([self._warnings], timeout=0)[0]:
            warned, self._warnings = self._warnings, None
            with contextlib.suppress(RayError):  # where it has died, others find that out
                errors.show_warnings(ray.get(warned))
        if self._warnings is None and time.monotonic() > self._warnings_since + WARNINGS_S:
            self._warnings_since = time.monotonic()
            self._warnings = self.actor.__ray_call__.remote(errors.collected_warnings)

    def last_warnings(self) -> list[Any]:
        """References of what its process has warned of and not handed over."""
        asked = [self.actor.__ray_call__.remote(errors.collected_warnings)]
        return asked if self._warnings is None else [*asked, self._warnings]


class RestartedWorker(Worker):
    """A worker whose process Ray restarts.

    A new process first answers ``ready``; `begin` starts its long call then.
    """

    def __init__(self, name: str, actor: Any, max_restarts: int, is_here: bool = True) -> None:
        super().__init__(name, actor, is_here)
        self.restarts = self.all_restarts = 0  # in a row, and since this engine began
        self._max_restarts = max_restarts
        self._since = math.inf  # when it was at work
        self._starting: Any = None  # reference of ``ready``, while the process is restarted

    def ready_arguments(self) -> tuple[Any, ...]:
        """Arguments of ``ready`` for a new process."""
        return ()

    def begin(self) -> None:
        """Start the long call of a process that is ready."""

    @property
    def is_starting(self) -> bool:
        return self._starting is not None

    def at_work(self, reference: Any) -> None:
        self.work, self._since = reference, time.monotonic()

    def lost(self, error: Exception, text: str = "") -> None:
        """Have another process take its place, unless that was so too often."""
        if isinstance(error, InputError):
            raise error
        if time.monotonic() - self._since > STEADY_S:
            self.restarts = 0
        if self.restarts >= self._max_restarts:
            times = f" after {self.restarts} restarts" if self.restarts else ""
            raise WorkerError(f"{self.name} worker failed for good{times}:\n{error}") from error
        self.restarts += 1
        self.all_restarts += 1
        number = f"({self.restarts} of {self._max_restarts} times)"
        reason = last_exception(str(error))[:200]
        logger.warning("%s worker is restarted %s: %s", self.name, number, reason)
        if isinstance(error, RayTaskError) or not isinstance(error, RayActorError):
            self._end_process()
        self.work = self._question = self._warnings = self.last_answer = None
        self._since = math.inf
        self._asked = time.monotonic()
        self._ask_ready()

    def advance_start(self, limit: float) -> None:
        """Begin the long call of a restarted process once it is ready."""
        if self._starting is None:
            return
        try:
            pid = ray.get(self._starting, timeout=0)
        except RayError as error:
            waits, waited = isinstance(error, GetTimeoutError), time.monotonic() - self._asked
            if not waits and (isinstance(error, FINAL) or not isinstance(error, RayActorError)):
                raise WorkerError(f"{self.name} worker did not start again:\n{error}") from error
            if waited > self.start_timeout(limit):
                raise WorkerError(f"{self.name} worker did not start again within {waited:.0f} s") from error
            if not waits:
                self._ask_ready()  # the process before was on its way out, or the new one has died
            return
        self._starting = None
        if self.process is not None and pid == self.process.pid:  # Ray had only lost sight of it
            self._end_process()
            self._ask_ready()
            return
        self.started(pid)
        self.begin()
        logger.info("%s worker is up again", self.name)

    def _ask_ready(self) -> None:
        self._starting = self.actor.ready.remote(*self.ready_arguments())

    def _end_process(self) -> None:
        """End a process that hangs or has failed; one that has been stopped does not hear Ray."""
        if self.process is None:
            ray.kill(self.actor, no_restart=False)
            return
        with contextlib.suppress(psutil.NoSuchProcess):
            self.process.kill()


class RolloutSlot(RestartedWorker):
    """A rollout worker, and what its next process has to know. A restart loses unfinished segments, and plays
    planned episodes again.

    `budget`: exploring episodes left.
    """

    def __init__(
        self, index: int, actor: Any, config: RunConfig, tasks: tuple[str, ...], is_here: bool = True
    ) -> None:
        super().__init__(f"rollout {index}", actor, config.launch.max_restarts, is_here)
        self.index = index
        self.services: tuple[Endpoint, ...] = ()  # an inference replica, and replay
        self.incarnation = 0  # grows with every process; part of its seeds and of its segments' keys
        self.outstanding: dict[tuple[str, int], EpisodePlan] = {}  # planned episodes without a result
        self.past: Counter[str] = Counter()  # counters of processes that have ended
        self.budget = budgets(config.rollout)[index]
        self.spent = self.budget == 0  # True if replay has all episodes of the budget
        self.begun: list[tuple[str, int]] = []  # newest real episodes, for imagined ones to begin like them
        self.world: Any = None  # reference of a version of the world model, and its weights
        self._unsent: list[EpisodePlan] = []
        self._tasks, self._seed, self._environments = tasks, config.seed, config.rollout.environments

    @property
    def counters(self) -> Counter[str]:
        """Sums over all processes since the run began."""
        total = self.past.copy()
        if self.last_answer is not None:
            total.update(self.last_answer.counters)
        return total

    @property
    def next_incarnation(self) -> int:
        return incarnation_after(self.incarnation, 0 if self.last_answer is None else self.last_answer.starts)

    def ready_arguments(self) -> tuple[Any, ...]:
        plans = EpisodePlans(self._tasks, self._seed, self.budget, self.index, self.incarnation)
        return plans, self.begun

    def begin(self) -> None:
        if self.world is not None:
            self.actor.imagine_with.remote(self.world)
        self.at_work(self.actor.run.remote(*self.services))

    def take(self, report: Report) -> list[EpisodeResult]:
        """Note a report; the episodes in it."""
        self.spent = report.spent
        plans = [episode.plan for episode in report.episodes]
        real = [(plan.task, plan.seed) for plan in plans if plan.explore and plan.source == REAL]
        self.begun = (self.begun + real)[-MOST_BEGUN:]
        if self.budget is not None:
            self.budget -= len(real)
        known = self.outstanding
        return [e for e in report.episodes if known.pop((e.plan.group, e.plan.index), None) or e.plan.explore]

    def assign(self, plans: list[EpisodePlan]) -> None:
        self.outstanding |= {(plan.group, plan.index): plan for plan in plans}
        self._unsent += plans

    def ask_report(self, training: bool, in_turn: bool) -> None:
        """Ask for a report, unless one is outstanding; `in_turn`: wait for replay after each segment."""
        if not self.is_starting and self.ask("report", training, self._unsent, in_turn):
            self._unsent = []

    def start_timeout(self, limit: float) -> float:
        """See the base class; its environments are made one after the other."""
        return max(START_S, limit * self._environments)

    def hung(self, limit: float) -> str:
        """Also an environment that does not return."""
        report: Report | None = self.last_answer
        why = super().hung(limit)
        if why or report is None or report.busy_s <= limit:
            return why
        what = "its environment has not returned" if report.in_environment else "it has done nothing"
        return f"{what} for {report.busy_s:.0f} s"

    def lost(self, error: Exception, text: str = "") -> None:
        self.past = self.counters
        self.past["restarts"] += 1
        self.incarnation = self.next_incarnation
        super().lost(error, text)
        self._unsent = list(self.outstanding.values())


def save_rollouts(directory: Path, workers: Sequence[RolloutSlot]) -> None:
    """Write the rollout workers' part of ``training_state``."""
    slots = []
    for worker in workers:
        outstanding, incarnation = list(worker.outstanding.values()), worker.next_incarnation - 1
        slot = {"incarnation": incarnation, "budget": worker.budget, "outstanding": outstanding}
        slots.append(slot | {"begun": worker.begun})
    snapshot.save(directory / ROLLOUT, {"past": dict(total_counters(workers)), "slots": slots})


def restore_rollouts(directory: Path, workers: Sequence[RolloutSlot]) -> None:
    """Go on from what `save_rollouts` has written."""
    if not (directory / f"{ROLLOUT}.json").is_file():
        hint = "this run was in one process; resume it with launch.engine=local"
        raise InputError("launch.engine", "ray", hint)
    saved = snapshot.load(directory / ROLLOUT)
    if len(saved["slots"]) != len(workers):
        hint = f"this run has {len(saved['slots'])}; leave the field out"
        raise InputError("rollout.workers", len(workers), hint)
    workers[0].past = Counter(saved["past"])
    for worker, slot in zip(workers, saved["slots"], strict=True):
        worker.incarnation, worker.budget = slot["incarnation"] + 1, slot["budget"]
        worker.begun = slot["begun"]
        worker.spent = worker.budget == 0
        worker.assign(slot["outstanding"])


def total_counters(workers: Iterable[RolloutSlot]) -> Counter[str]:
    """Counters of all rollout workers since the run began."""
    total = Counter(restarts=0)
    for worker in workers:
        total.update(worker.counters)
    return total


def end_all(workers: Sequence[Worker]) -> None:
    """End workers, show what they have warned of, and wait until they are gone and write nothing any more."""
    asked = [reference for worker in workers for reference in worker.last_warnings()]
    for warned in ray.wait(asked, num_returns=len(asked), timeout=LAST_WARNINGS_S)[0] if asked else ():
        with contextlib.suppress(RayError):
            errors.show_warnings(ray.get(warned))
    for worker in workers:
        ray.kill(worker.actor)
    processes = [worker.process for worker in workers if worker.process is not None]
    left = psutil.wait_procs(processes, timeout=GONE_S)[1]
    for process in left:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()  # one that is stopped does not hear Ray
    psutil.wait_procs(left, timeout=GONE_S)
