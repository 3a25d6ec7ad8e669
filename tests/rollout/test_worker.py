# SPDX-License-Identifier: Apache-2.0
"""The rollout process's loop, with inference and replay played by the test."""

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.experience import Decision, Request, Segment
from accerl_lerobot.rollout import worker as module
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodePlans, EpisodeResult, RolloutConfig
from accerl_lerobot.rollout.worker import MAX_PENDING, RolloutWorker
from tests.rollout.environments import evaluate
from tests.runs import HANGS_S, eventually

WORLD = SimulatedConfig(max_steps=8, tolerance=0.05)


class PlayedClient:
    """A service of the test's own: its replies are what a function returns, or what comes into its future."""

    def __init__(self, answer: Callable[[Any], Any]) -> None:
        self._answer = answer
        self._under_way: dict[int, Future[Any]] = {}
        self._sent = 0

    def send(self, message: Any, ticket: int | None = None) -> int:
        answer = self._answer(message)
        if not isinstance(answer, Future):
            future: Future[Any] = Future()
            future.set_result(answer)
            answer = future
        self._sent += 1
        ticket = self._sent if ticket is None else ticket
        self._under_way[ticket] = answer
        return ticket

    def done(self, timeout: float) -> list[tuple[int, Any]]:
        wait(self._under_way.values(), timeout=timeout, return_when=FIRST_COMPLETED)
        done = [ticket for ticket, future in self._under_way.items() if future.done()]
        return [(ticket, self._under_way.pop(ticket).result()) for ticket in done]

    def close(self) -> None:
        self._under_way.clear()


def played(answer: Callable[[Any], Any]) -> Any:
    """An endpoint at which `answer` replies."""
    return SimpleNamespace(name="played", connect=lambda *_: PlayedClient(answer))


class OverError(Exception):
    """Ends a loop that has no end."""


def planned(count: int) -> list[EpisodePlan]:
    return [evaluate(seed=50 + i, index=i, task="match") for i in range(count)]


class Stage:
    """A worker whose loop runs on a thread; `inference` answers at once, `replay` as the test says."""

    def __init__(self, config: RolloutConfig, insert: Callable[[list[Segment]], Any]) -> None:
        self.worker = RolloutWorker(WORLD, config)
        self.worker.ready(EpisodePlans(("match",), 0, None))
        self.episodes: list[EpisodeResult] = []
        self.explored = 0
        self.over = False
        self.held: list[tuple[Future[list[Decision]], int]] | None = None  # of evaluations, until `release`
        self.failure: BaseException | None = None
        self._insert = insert
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def order(self, training: bool, plans: list[EpisodePlan] | None = None) -> module.Report:
        report = self.worker.report(training, plans or [])
        self.episodes += report.episodes
        return report

    @property
    def evaluated(self) -> list[int]:
        return [e.plan.index for e in self.episodes if not e.plan.explore]

    def until(self, condition: Callable[[], bool]) -> None:
        def happened() -> bool:
            assert self.failure is None
            self.order(True)
            return condition()

        assert eventually(happened, HANGS_S)

    def _decide(self, requests: list[Request]) -> list[Decision] | Future[list[Decision]]:
        if self.over:
            raise OverError
        self.explored += sum(r.explore for r in requests)
        if self.held is not None and not requests[0].explore:
            self.held.append((Future(), len(requests)))
            return self.held[-1][0]
        return decisions(len(requests))

    def release(self) -> None:
        held, self.held = self.held or [], None
        for future, count in held:
            future.set_result(decisions(count))

    def _run(self) -> None:
        try:
            self.worker.run(played(self._decide), played(self._insert))
        except OverError:
            pass
        except BaseException as error:
            self.failure = error


def decisions(count: int) -> list[Decision]:
    zeros = np.zeros((4, 2), np.float32)
    return [Decision(chunk=zeros, latent={"x": zeros}, log_prob=zeros[:, 0], version=0)] * count


@pytest.fixture
def stage() -> Iterator[Callable[..., Stage]]:
    made: list[Stage] = []

    def make(insert: Callable[[list[Segment]], Any], **config: Any) -> Stage:
        made.append(Stage(RolloutConfig(**{"environments": 4, "segment_length": 2, **config}), insert))
        return made[-1]

    yield make
    for one in made:
        one.over = True
        one.release()
        one.worker.report(False, planned(8))  # something to ask for, whatever it waits for
        one.thread.join(timeout=HANGS_S)
        assert not one.thread.is_alive()


def test_exploring_pauses_while_replay_does_not_take_segments_and_evaluation_goes_on(stage):
    inserts: list[Future[bool]] = []
    one = stage(lambda segments: inserts.append(Future()) or inserts[-1], segment_length=1)
    one.held = []
    one.order(True, planned(2))  # two slots evaluate, two explore
    one.until(lambda: len(inserts) >= MAX_PENDING)
    explored = -1
    while explored != one.explored:  # until nothing more is; were exploring to go on, it would
        explored = one.explored
        time.sleep(0.2)
    assert explored <= 2 * MAX_PENDING and not one.evaluated
    one.release()
    one.until(lambda: len(one.evaluated) == 2)
    assert one.explored == explored
    for future in inserts:
        future.set_result(True)
    one.until(lambda: one.explored > explored)


def test_an_insert_that_fails_ends_the_worker(stage):
    def insert(segments: list[Segment]) -> bool:
        raise OSError("replay is gone")

    one = stage(insert)
    one.order(True)
    assert eventually(lambda: isinstance(one.failure, OSError))


@pytest.mark.parametrize("in_environment", [True, False])
def test_a_thread_that_hangs_shows_in_the_report(stage, monkeypatch: Any, in_environment: bool):
    release = threading.Event()
    hanging = "rollout.step" if in_environment else "rollout.send"

    def fault_point(point: str) -> bool:
        if point == hanging:
            release.wait(HANGS_S)
        return False

    monkeypatch.setattr(module, "fault_point", fault_point)
    one = stage(lambda segments: True)
    one.until(lambda: one.order(True).busy_s > 0.4)
    assert one.order(True).in_environment is in_environment
    release.set()
    one.until(lambda: len(one.episodes) >= 2 and one.order(True).busy_s < 0.4)
