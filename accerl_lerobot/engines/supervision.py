# SPDX-License-Identifier: Apache-2.0
"""Supervision of the processes of an asynchronous run.

Ray restarts the process of a rollout worker or an inference replica when it has died. The driver ends a
process that hangs or whose long call has failed, which Ray then restarts in the same way, and tells each new
process its episodes. Resuming a run works the same way.
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

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.engines.config import LaunchConfig, RunConfig
from accerl_lerobot.engines.stopping import WorkerError
from accerl_lerobot.errors import InputError, collected_warnings, last_exception, show_warnings
from accerl_lerobot.experience import REAL
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodePlans, EpisodeResult, budgets, incarnation_after
from accerl_lerobot.rollout.worker import Report
from accerl_lerobot.transport import Endpoint

logger = logging.getLogger(__name__)

SAVE_LIMITS = 4  # how often ``launch.stall_s`` a worker may take to write its part of a checkpoint
START_S = 600.0  # timeout for the start of a worker, or ``launch.stall_s`` if that is more
STEADY_S = 30.0  # a worker that has run for so long starts counting restarts anew
LAST_WARNINGS_S = 1.0  # how long the last warnings of workers are waited for
GONE_S = 10.0  # how long to wait for the end of processes; Ray kills one that has been stopped after 5 s
MOST_BEGUN = 16  # real episodes whose resets a restarted rollout process repeats, if it imagines
ROLLOUT = "rollout"  # name of the rollout workers' part of a checkpoint
RESTARTED = {"max_restarts": -1}
"""Options of an actor that Ray restarts; `RestartedWorker` ends the run after too many restarts."""


class Worker:
    """A worker without which the run cannot go on, with a long call that must not end unasked.

    Questions are asked one at a time, without waiting, and answers picked up later. So a worker that hangs
    cannot hang the engine, its silence has a length, and orders arrive in order, which Ray does not promise
    for an actor with threads.
    """

    def __init__(self, name: str, actor: Any, launch: LaunchConfig) -> None:
        self.name = name
        self.actor = actor
        self._launch = launch
        self.endpoint = Endpoint(name=name, actor=actor)
        self.pid = 0  # of its process, once that is ready
        self.long_call: Any = None  # reference of it
        self.last_answer: Any = None
        self._question: list[Any] = []  # references of the answer, and of what its process has warned of
        self._asked = 0.0

    def ready_arguments(self) -> tuple[Any, ...]:
        """Arguments of ``ready`` for a new process."""
        return ()

    def ask(self, method: str, *arguments: Any) -> bool:
        """Ask unless an answer is outstanding; returns True if it did."""
        if self._question:
            return False
        answer = getattr(self.actor, method).remote(*arguments)
        self._question = [answer, self.ask_warnings()]
        self._asked = time.monotonic()
        return True

    def ask_warnings(self) -> Any:
        """Reference of what its process has warned of since it was asked last."""
        return self.actor.__ray_call__.remote(collected_warnings)

    def answer(self, timeout: float = 0.0) -> Any:
        """The answer to the last question; None if it has not come, or has been taken. Shows new warnings."""
        question = self._question
        if not question or not self._is_answered(timeout):
            return None
        self._question = []
        self.last_answer, warnings = ray.get(question)
        show_warnings(warnings)
        return self.last_answer

    def _is_answered(self, timeout: float = 0.0) -> bool:
        ready, _ = ray.wait(self._question, num_returns=len(self._question), timeout=timeout)
        return len(ready) == len(self._question)

    def why_given_up(self) -> str:
        """The reason to give the worker up; empty if there is none."""
        if not self._question or self._is_answered():
            return ""
        silent = time.monotonic() - self._asked
        return f"has not answered for {silent:.0f} s" if silent > self._launch.stall_s else ""

    def call(self, method: str, *arguments: Any, timeout: float = 0.0) -> Any:
        """The result of a method of the actor."""
        return self.result(getattr(self.actor, method).remote(*arguments), method, timeout)

    def result(self, reference: Any, method: str, timeout: float = 0.0) -> Any:
        """The result of a call that has been made; waits for ``launch.stall_s``, or for longer."""
        timeout = max(timeout, self._launch.stall_s)
        try:
            return ray.get(reference, timeout=timeout)
        except GetTimeoutError as error:
            why = f"did not answer {method} within {timeout:.0f} s; if it needs longer, raise launch.stall_s"
            raise WorkerError(f"{self.name} worker {why}") from error
        except RayError as error:
            raise WorkerError(f"{self.name} worker failed in {method}:\n{error}") from error

    def handle_loss(self, error: Exception) -> None:
        """Deal with a failure: here the run cannot go on."""
        if isinstance(error, InputError | WorkerError):  # another process would meet bad input again
            raise error
        raise WorkerError(f"{self.name} worker failed for good:\n{error}") from error


class RestartedWorker(Worker):
    """A worker whose process Ray restarts.

    A new process first answers ``ready``. Then `begin` starts its long call.
    """

    def __init__(self, name: str, actor: Any, launch: LaunchConfig) -> None:
        super().__init__(name, actor, launch)
        self.restarts = self.all_restarts = 0  # in a row, and since this engine began
        self._since = math.inf  # when its long call began
        self._starting: Any = None  # reference of ``ready``, while the process is restarted

    @property
    def is_starting(self) -> bool:
        return self._starting is not None

    def begin(self) -> None:
        """Start the long call of a process that is ready."""
        raise NotImplementedError

    def note_long_call(self, reference: Any) -> None:
        """Note the long call of a process."""
        self.long_call = reference
        self._since = time.monotonic()

    def handle_loss(self, error: Exception) -> None:
        """Have another process take the place of the lost one, unless that was so too often."""
        if isinstance(error, InputError):
            raise error
        if time.monotonic() - self._since > STEADY_S:
            self.restarts = 0
        most = self._launch.max_restarts
        if self.restarts >= most:
            times = f" after {self.restarts} restarts" if self.restarts else ""
            raise WorkerError(f"{self.name} worker failed for good{times}:\n{error}") from error
        self.restarts += 1
        self.all_restarts += 1
        number = f"({self.restarts} of {most} times)"
        reason = last_exception(str(error))[:200]
        logger.warning("%s worker is restarted %s: %s", self.name, number, reason)
        if not has_died(error):
            ray.kill(self.actor, no_restart=False)
        self.long_call = self.last_answer = None
        self._question = []
        self._since = math.inf
        self._asked = time.monotonic()
        self._ask_ready()

    def advance_start(self) -> bool:
        """True if a restarted process is ready now."""
        waited = time.monotonic() - self._asked
        if waited > max(START_S, self._launch.stall_s):
            raise WorkerError(f"{self.name} worker did not start again within {waited:.0f} s")
        try:
            pid = ray.get(self._starting, timeout=0)
        except GetTimeoutError:
            return False
        except (RayTaskError, ActorDiedError) as error:  # another process would not start either
            raise WorkerError(f"{self.name} worker did not start again:\n{error}") from error
        except RayError:  # the process before was on its way out, or the new one has died
            self._ask_ready()
            return False
        if pid == self.pid:  # the lost process has answered
            ray.kill(self.actor, no_restart=False)
            self._ask_ready()
            return False
        self.pid = pid
        self._starting = None
        logger.info("%s worker is up again", self.name)
        return True

    def _ask_ready(self) -> None:
        self._starting = self.actor.ready.remote(*self.ready_arguments())


class RolloutSlot(RestartedWorker):
    """A rollout worker, and the orders for its next process.

    A restart loses unfinished segments, and plays planned episodes again.
    """

    def __init__(self, index: int, actor: Any, config: RunConfig, tasks: tuple[str, ...]) -> None:
        super().__init__(f"rollout {index}", actor, config.launch)
        self.index = index
        self.services: tuple[Endpoint, ...] = ()  # an inference replica, and replay
        self.incarnation = 0  # grows with every process; part of its seeds and of its segments' keys
        self.outstanding: dict[tuple[str, int], EpisodePlan] = {}  # planned episodes without a result
        self.past: Counter[str] = Counter()  # counters of processes that have ended
        self.budget = budgets(config.rollout)[index]  # exploring episodes left; None: any number
        self.begun: list[tuple[str, int]] = []  # newest real episodes, for imagined ones to begin like them
        self.world: Any = None  # reference of a version of the world model, and its weights
        self._unsent: list[EpisodePlan] = []
        self._tasks = tasks
        self._seed = config.seed

    @property
    def counters(self) -> Counter[str]:
        """Sums over all processes since the run began."""
        total = self.past.copy()
        if self.last_answer is not None:
            total.update(self.last_answer.counters)
        return total

    @property
    def next_incarnation(self) -> int:
        seeds_used = 0 if self.last_answer is None else self.last_answer.seeds_used
        return incarnation_after(self.incarnation, seeds_used)

    @property
    def spent(self) -> bool:
        """True if replay has all episodes of the budget."""
        if self.last_answer is None:
            return self.budget == 0
        return bool(self.last_answer.spent)

    def ready_arguments(self) -> tuple[Any, ...]:
        plans = EpisodePlans(self._tasks, self._seed, self.budget, self.index, self.incarnation)
        return plans, self.begun

    def begin(self) -> None:
        if self.world is not None:
            self.actor.imagine_with.remote(self.world)
        self.note_long_call(self.actor.run.remote(*self.services))

    def take(self, report: Report) -> list[EpisodeResult]:
        """Note a report; the episodes in it."""
        results = []
        for episode in report.episodes:
            plan = episode.plan
            if plan.explore:
                results.append(episode)
                if plan.source == REAL:
                    self.begun.append((plan.task, plan.seed))
                    del self.begun[:-MOST_BEGUN]
                    if self.budget is not None:
                        self.budget -= 1
            elif self.outstanding.pop((plan.group, plan.index), None) is not None:
                results.append(episode)
        return results

    def assign(self, plans: list[EpisodePlan]) -> None:
        """Queue planned episodes for the next report."""
        for plan in plans:
            self.outstanding[plan.group, plan.index] = plan
        self._unsent += plans

    def ask_report(self, training: bool, in_turn: bool) -> None:
        """Ask for a report, unless one is outstanding; `in_turn`: wait for replay after each segment."""
        if self.ask("report", training, self._unsent, in_turn):
            self._unsent = []

    def why_given_up(self) -> str:
        """The reason to give the worker up, which may be an environment that does not return."""
        why = super().why_given_up()
        report: Report | None = self.last_answer
        if why or report is None or report.busy_s <= self._launch.stall_s:
            return why
        cause = "its environment has not returned" if report.in_environment else "it has done nothing"
        return f"{cause} for {report.busy_s:.0f} s"

    def handle_loss(self, error: Exception) -> None:
        self.past = self.counters
        self.past["restarts"] += 1
        self.incarnation = self.next_incarnation
        self._unsent = list(self.outstanding.values())
        super().handle_loss(error)


def has_died(error: Exception) -> bool:
    """True if an error tells that the process of an actor has ended, and not that its call has failed."""
    return isinstance(error, RayActorError) and not isinstance(error, RayTaskError)


def save_rollouts(directory: Path, workers: Sequence[RolloutSlot]) -> None:
    """Write the rollout workers' part of ``training_state``."""
    slots = []
    for worker in workers:
        slot = {
            "incarnation": worker.next_incarnation - 1,
            "budget": worker.budget,
            "outstanding": list(worker.outstanding.values()),
            "begun": worker.begun,
        }
        slots.append(slot)
    snapshot.save(directory / ROLLOUT, {"past": dict(total_counters(workers)), "slots": slots})


def restore_rollouts(directory: Path, workers: Sequence[RolloutSlot]) -> None:
    """Go on from what `save_rollouts` has written."""
    saved = snapshot.load(directory / ROLLOUT)
    workers[0].past = Counter(saved["past"])
    for worker, slot in zip(workers, saved["slots"], strict=True):
        worker.incarnation = slot["incarnation"] + 1
        worker.budget = slot["budget"]
        worker.begun = slot["begun"]
        worker.assign(slot["outstanding"])


def total_counters(workers: Iterable[RolloutSlot]) -> Counter[str]:
    """Counters of all rollout workers since the run began."""
    total = Counter(restarts=0)
    for worker in workers:
        total.update(worker.counters)
    return total


def end_all(workers: Sequence[Worker]) -> None:
    """End workers, show their last warnings, and wait until their processes write nothing any more."""
    asked = [worker.ask_warnings() for worker in workers]
    if asked:
        ready, _ = ray.wait(asked, num_returns=len(asked), timeout=LAST_WARNINGS_S)
        for reference in ready:
            with contextlib.suppress(RayError):  # the process has died
                show_warnings(ray.get(reference))
    for worker in workers:
        ray.kill(worker.actor)
    deadline = time.monotonic() + GONE_S
    # A process of another node is waited for in vain if its number is taken here.
    while any(_runs(worker.pid) for worker in workers) and time.monotonic() < deadline:
        time.sleep(0.02)


def _runs(pid: int) -> bool:
    """True while a process of this id is alive."""
    try:
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False
