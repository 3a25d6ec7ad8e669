# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""The rollout process: steps its worlds while other observations wait for a decision.

    consumes    decisions from inference
    produces    segments for replay, results of evaluation episodes for the driver
    waits for   a decision, only when every world has an observation under way
    pauses      exploring worlds while replay keeps segments at the door; evaluation goes on

Imports neither torch nor LeRobot (unless its world does).
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from typing import Any

import ray

from accerl_lerobot.envs import EnvConfig, make_world
from accerl_lerobot.experience import Request, Segment
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodeResult, RolloutConfig, RolloutRunner
from accerl_lerobot.seeds import train_seed

GROUPS = 2
"""Worlds are asked for in this many groups per worker: one is stepped while the other's decisions are made."""
AT_THE_DOOR = 2
"""Insert calls that may be waiting before exploring worlds pause."""


class RolloutWorker:
    """Becomes a threaded Ray actor in `launch`: `run` on one thread, plans and drains on another.

    Args:
        env: the world's config; one instance per slot.
        config: sizes.
        tasks: the training tasks; slot i begins with task i modulo their number.
        seed: the run's.
        index: of this worker.
        incarnation: how often it has been restarted; part of the segments' keys, and of the seeds.
        film: see `RolloutRunner`.
    """

    def __init__(
        self,
        env: EnvConfig,
        config: RolloutConfig,
        tasks: tuple[str, ...],
        seed: int,
        index: int,
        incarnation: int,
        film: tuple[int, int],
    ) -> None:
        self._tasks, self._seed, self._index = tasks, seed, index
        self._episode = incarnation * 1000
        self._planned: deque[EpisodePlan] = deque()
        self._results: list[EpisodeResult] = []
        self._outbox: list[Segment] = []
        self._training = threading.Event()
        self._stopped = threading.Event()
        worlds = [make_world(env) for _ in range(config.worlds)]
        name = f"rollout{index}.{incarnation}"
        self._runner = RolloutRunner(
            worlds, self._next_plan, config, name, self._outbox.append, self._results.append, film
        )

    def ready(self) -> bool:
        """Answers once the worlds exist."""
        return True

    def pid(self) -> int:
        """This process."""
        return os.getpid()

    def plan(self, plans: list[EpisodePlan]) -> None:
        """Queues evaluation episodes; they are taken before any training episode."""
        self._planned.extend(plans)

    def train(self, on: bool) -> None:
        """Whether training episodes are run between planned ones."""
        (self._training.set if on else self._training.clear)()

    def drain(self) -> tuple[list[EpisodeResult], dict[str, float]]:
        """Episodes finished since the last call, and the counters so far."""
        results = [self._results.pop(0) for _ in range(len(self._results))]
        return results, {k: float(v) for k, v in vars(self._runner.counters).items()}

    def stop(self) -> None:
        """Makes `run` return."""
        self._stopped.set()

    def run(self, inference: Any, replay: Any) -> None:
        """Steps worlds until stopped."""
        idle = list(range(len(self._runner)))
        due: dict[int, Request] = {}
        under_way: dict[Any, list[int]] = {}
        door: list[Any] = []
        size = max(1, len(self._runner) // GROUPS)
        while not self._stopped.is_set():
            door = self._still_waiting(door)
            idle = [slot for slot in idle if not self._begin(slot, due)]
            sendable = [slot for slot in due if len(door) < AT_THE_DOOR or not due[slot].explore]
            for start in range(0, len(sendable), size):
                slots = sendable[start : start + size]
                under_way[inference.decide.remote([due.pop(slot) for slot in slots])] = slots
            if not under_way:
                time.sleep(0.005)
                continue
            done, _ = ray.wait(list(under_way), num_returns=1, timeout=0.5)
            for reference in done:
                slots = under_way.pop(reference)
                for slot, decision in zip(slots, ray.get(reference), strict=True):
                    request = self._runner.advance(slot, decision)
                    if request is not None and request.explore and not self._training.is_set():
                        request = self._runner.start(slot)  # training ended: the episode is abandoned
                    if request is None:
                        idle.append(slot)
                    else:
                        due[slot] = request
                if self._outbox:
                    door.append(replay.insert.remote(list(self._outbox)))
                    self._outbox.clear()
        self._runner.close()

    def _begin(self, slot: int, due: dict[int, Request]) -> bool:
        request = self._runner.start(slot)
        if request is not None:
            due[slot] = request
        return request is not None

    def _still_waiting(self, door: list[Any]) -> list[Any]:
        if not door:
            return door
        done, waiting = ray.wait(door, num_returns=len(door), timeout=0)
        for reference in done:
            ray.get(reference)  # an insert that failed ends this worker
        return waiting

    def _next_plan(self) -> EpisodePlan | None:
        if self._planned:
            return self._planned.popleft()
        if not self._training.is_set():
            return None
        number, self._episode = self._episode, self._episode + 1
        task = self._tasks[(number + self._index) % len(self._tasks)]
        return EpisodePlan(task=task, seed=train_seed(self._seed, self._index, number), explore=True)
