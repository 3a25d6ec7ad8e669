# SPDX-License-Identifier: Apache-2.0
"""The world-model process: it learns the state that critic and teacher stand on.

consumes    transitions that the trainer draws from its memory of the run's episodes
produces    versions of the model, which the trainer takes over between two updates: it computes remembered
            states anew, and publishes model and teacher to inference together
waits for   transitions; the trainer waits for the model's first steps, and never again
ends        with the trainer
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any, NamedTuple

import ray

from accerl_lerobot import errors
from accerl_lerobot.checkpoint.tensors import copied
from accerl_lerobot.experience import Observations
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.timeline import CHECKPOINT, COMPUTE, WAIT_IN, open_clock
from accerl_lerobot.world_model.states import BATCH, StateLearner, StateModel, Transitions

WORLD_MODEL_WORKER = "world model"


class Learned(NamedTuple):
    """Outcome of the steps of one call."""

    metrics: list[dict[str, float]]  # parts of the loss, by step
    steps: int  # made in all
    weights: dict[str, Any]  # CPU tensors of the model


class WorldModelWorker:
    """Becomes a threaded Ray actor in `engines.ray_engine`; one call at a time touches the model."""

    def __init__(self, seed: int, num_threads: int, device: str, timeline: Path | None = None) -> None:
        errors.collect_warnings()
        self._clock = open_clock(timeline, WORLD_MODEL_WORKER)
        import torch

        torch.set_num_threads(num_threads)
        torch.manual_seed(seed)
        self._device = device
        self._learner: StateLearner | None = None
        self._lock = threading.Lock()
        self._clock.enter(WAIT_IN)

    def ready(self) -> int:
        """This process's id."""
        return os.getpid()

    def metrics(self) -> dict[str, float]:
        """Nothing: the trainer reports. Answering shows that it is not stuck."""
        self._clock.beat()
        return {}

    def begin(self, model: StateModel, state: dict[str, Any]) -> None:
        """Go on from a learner's `state`; `model` is on the CPU."""
        import torch

        device = "cpu"
        if self._device != "cpu" and torch.cuda.is_available():
            device = "cuda"
        with self._lock:
            self._learner = StateLearner(model.to(device))
            self._learner.restore(state)

    def learn(self, transitions: Transitions, numbers: Observations) -> Learned:
        """Make the steps that `StateLearner.submit` makes."""
        with self._lock:
            learner = self._learner
            assert learner is not None  # the trainer begins before it submits
            with self._clock.during(COMPUTE):
                fault_point("world_model.learn")
                learner.submit(transitions, numbers)
            return Learned(learner.collect(), learner.count, copied(learner.model))

    def state(self) -> dict[str, Any]:
        """The learner's `state`, between two calls of `learn`."""
        with self._lock, self._clock.during(CHECKPOINT):
            assert self._learner is not None
            return self._learner.state()


class RemoteStateLearner:
    """A `StateLearner` in the process of a `WorldModelWorker`, as the trainer sees it.

    Args:
        actor: handle of the worker.
        learner: what it goes on from.
        timeout_s: longest wait for an answer.
    """

    def __init__(self, actor: Any, learner: StateLearner, timeout_s: float) -> None:
        self._actor = actor
        self._timeout_s = timeout_s
        self._first_steps = learner.model.first_steps
        self._submitted = learner.count
        self._count = learner.count
        self._pending: deque[Any] = deque()  # calls without an answer, in their order
        self._since = 0.0  # when the worker began with the first of them, at the latest
        self._made: list[dict[str, float]] = []
        self._weights: dict[str, Any] = copied(learner.model)
        model = learner.model.cpu().eval()
        self._answer(actor.begin.remote(model, learner.state()))

    @property
    def busy(self) -> bool:
        self._take()
        return bool(self._pending)

    @property
    def behind(self) -> int:
        return max(0, self._first_steps - self._submitted)

    @property
    def ready(self) -> bool:
        return self._count >= self._first_steps

    def submit(self, transitions: Transitions, numbers: Observations) -> None:
        if not self._pending:
            self._since = time.monotonic()
        self._submitted += len(transitions.tasks) // BATCH
        transitions = transitions.to("cpu")  # the worker may have no GPU, or another one
        self._pending.append(self._actor.learn.remote(transitions, numbers))

    def wait(self) -> None:
        while self._pending:
            self._receive(self._answer(self._pending[0]))

    def collect(self) -> list[dict[str, float]]:
        self._take()
        made = self._made
        self._made = []
        return made

    def publish(self, model: StateModel) -> None:
        model.load_state_dict(self._weights)

    def state(self) -> dict[str, Any]:
        state: dict[str, Any] = self._answer(self._actor.state.remote())
        return state

    def _take(self) -> None:
        """Receive what is ready.

        Raises:
            TimeoutError: there has been no answer for too long.
        """
        while self._pending and ray.wait([self._pending[0]], timeout=0)[0]:
            self._receive(ray.get(self._pending[0]))
        if self._pending and time.monotonic() - self._since > self._timeout_s:
            raise TimeoutError(f"the world-model worker has not answered for {self._timeout_s:g} s")

    def _receive(self, learned: Learned) -> None:
        self._pending.popleft()
        self._since = time.monotonic()
        self._made += learned.metrics
        self._count = learned.steps
        self._weights = learned.weights

    def _answer(self, reference: Any) -> Any:
        return ray.get(reference, timeout=self._timeout_s)
