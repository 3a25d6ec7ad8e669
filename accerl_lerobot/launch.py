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
"""Places the workers, connects them and watches them.

    rollout ×W ──requests──► inference ──decisions──► rollout        micro-asynchrony: a rollout steps other worlds meanwhile
        │                        ▲
        └──segments──► replay    │ weights, published without waiting
                          │      │
                          └──► trainer                               macro-asynchrony: no barrier, a bounded, measured lag

The trainer is the clock: when it has made its updates the run is over. Any other worker that ends is an event: a rollout
worker is started again (its worlds hold nothing that is not in replay), a few times; any other ends the run with its own
traceback. Workers get handles and never hold the conductor.
"""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

import ray

from accerl_lerobot.config import RunConfig
from accerl_lerobot.engine import Engine, Progress
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodeResult

logger = logging.getLogger(__name__)

POLL_S = 0.5


def start_ray() -> None:
    """A private Ray on this machine: loopback, no dashboard; `ray_environment` gave it its token."""
    ray.init(
        address="local",
        include_dashboard=False,
        _node_ip_address="127.0.0.1",
        log_to_driver=False,
        configure_logging=False,
    )


class RayEngine(Engine):
    """The asynchronous engine.

    Args:
        config: the run; its ``policy.path`` must be set.
        tasks: the training tasks.
    """

    def __init__(self, config: RunConfig, tasks: tuple[str, ...]) -> None:
        from accerl_lerobot.inference.worker import InferenceWorker
        from accerl_lerobot.replay.worker import ReplayWorker
        from accerl_lerobot.trainer.worker import TrainerWorker

        self._config, self._tasks = config, tasks
        self._started_ray = not ray.is_initialized()
        if self._started_ray:
            start_ray()
        gpus = ray.available_resources().get("GPU", 0)
        share = 0 if config.policy.device == "cpu" or not gpus else (1 if gpus > 1 else 0.5)
        self._inference = ray.remote(InferenceWorker).options(num_cpus=0, num_gpus=share, max_concurrency=1000).remote(
            config.policy, config.inference
        )  # fmt: skip
        self._trainer = ray.remote(TrainerWorker).options(num_cpus=0, num_gpus=share, max_concurrency=4).remote(
            config.policy, config.algorithm, config.trainer, config.seed
        )  # fmt: skip
        self._replay = (
            ray.remote(ReplayWorker)
            .options(num_cpus=0, max_concurrency=1000)
            .remote(config.replay, config.seed)
        )
        self._incarnations = [0] * config.rollout.workers
        self._outstanding: list[dict[tuple[str, int], EpisodePlan]] = [{} for _ in self._incarnations]
        self._counters: list[dict[str, float]] = [{} for _ in self._incarnations]
        self._past: dict[str, float] = {"restarts": 0.0}
        self._rollouts = [self._new_rollout(i) for i in range(config.rollout.workers)]
        ray.get([w.ready.remote() for w in (self._inference, self._trainer, *self._rollouts)])
        self._running: dict[Any, tuple[str, int]] = {self._inference.serve.remote(): ("inference", 0)}
        for i in range(len(self._rollouts)):
            self._run_rollout(i)
        self._training = self._done = False
        self._version = 0
        self._last_change, self._last_state = time.monotonic(), ()

    def plan(self, plans: list[EpisodePlan]) -> None:
        n = len(self._rollouts)
        for i, worker in enumerate(self._rollouts):
            mine = plans[i::n]
            self._outstanding[i] |= {(p.group, p.index): p for p in mine}
            worker.plan.remote(mine)

    def train(self) -> None:
        self._training = True
        self._running[self._trainer.run.remote(self._replay, [self._inference])] = ("trainer", 0)
        for worker in self._rollouts:
            worker.train.remote(True)

    def poll(self) -> Progress:
        ended, _ = ray.wait(list(self._running), num_returns=1, timeout=POLL_S)
        for reference in ended:
            self._ended(reference)
        episodes = [e for i in range(len(self._rollouts)) for e in self._drain(i)]
        updates = ray.get(self._trainer.metrics.remote())
        if updates:
            self._version = int(updates[-1]["update"])
        totals = dict(self._past)
        for counters in self._counters:
            for key, value in counters.items():
                totals[key] = totals.get(key, 0.0) + value
        progress = Progress(
            version=self._version,
            done=self._done,
            updates=updates,
            episodes=episodes,
            rollout=totals,
            replay=ray.get(self._replay.metrics.remote()),
            inference=ray.get(self._inference.metrics.remote()),
        )
        self._watch(progress)
        return progress

    def save(self, directory: Path) -> int:
        return int(ray.get(self._trainer.save.remote(str(directory.absolute()))))

    def close(self) -> None:
        if self._started_ray and ray.is_initialized():
            ray.shutdown()

    def rollout_pids(self) -> list[int]:
        """Process ids of the rollout workers, for fault tests."""
        return [int(ray.get(w.pid.remote())) for w in self._rollouts]

    def _new_rollout(self, index: int) -> Any:
        from accerl_lerobot.rollout.worker import RolloutWorker

        c = self._config
        film = (c.evaluation.video_size, c.evaluation.video_every)
        return ray.remote(RolloutWorker).options(num_cpus=0, num_gpus=0, max_concurrency=3).remote(
            c.env, c.rollout, self._tasks, c.seed, index, self._incarnations[index], film
        )  # fmt: skip

    def _run_rollout(self, index: int) -> None:
        reference = self._rollouts[index].run.remote(self._inference, self._replay)
        self._running[reference] = ("rollout", index)

    def _ended(self, reference: Any) -> None:
        """Decides what the end of a worker's long-running call means."""
        role, index = self._running.pop(reference)
        try:
            result = ray.get(reference)
        except ray.exceptions.RayError as error:
            if role == "rollout" and self._past["restarts"] < self._config.rollout.max_restarts:
                self._restart(index, error)
                return
            raise RuntimeError(f"{role} worker {index} failed for good:\n{error}") from error
        if role != "trainer":
            raise RuntimeError(f"{role} worker {index} ended without being asked to")
        self._done, self._version = True, int(result)
        for worker in self._rollouts:
            worker.train.remote(False)
        ray.get(self._replay.close.remote())

    def _restart(self, index: int, error: Exception) -> None:
        logger.warning(
            "rollout worker %d died and is started again: %s", index, str(error).strip().splitlines()[-1]
        )
        ray.kill(self._rollouts[index])
        self._past["restarts"] += 1
        for key, value in self._counters[index].items():
            self._past[key] = self._past.get(key, 0.0) + value
        self._counters[index] = {}
        self._incarnations[index] += 1
        self._rollouts[index] = self._new_rollout(index)
        self._run_rollout(index)
        self._rollouts[index].plan.remote(list(self._outstanding[index].values()))
        if self._training and not self._done:
            self._rollouts[index].train.remote(True)

    def _drain(self, index: int) -> list[EpisodeResult]:
        try:
            episodes, self._counters[index] = ray.get(self._rollouts[index].drain.remote())
        except ray.exceptions.RayError:
            return []  # its `run` has ended as well, and the next poll deals with that
        for episode in episodes:
            self._outstanding[index].pop((episode.plan.group, episode.plan.index), None)
        return list(episodes)

    def _watch(self, progress: Progress) -> None:
        """Ends a run in which nothing moves any more.

        Raises:
            RuntimeError: neither decisions nor updates for `LaunchConfig.stall_s`.
        """
        state = (progress.version, progress.rollout.get("decisions"), progress.rollout.get("restarts"))
        now = time.monotonic()
        waiting = any(self._outstanding) or (self._training and not self._done)
        if state != self._last_state or not waiting:
            self._last_state, self._last_change = state, now
        elif now - self._last_change > self._config.launch.stall_s:
            raise RuntimeError(
                f"nothing moved for {self._config.launch.stall_s:.0f} s: {progress.rollout}, {progress.replay}, "
                f"{progress.inference}; raise launch.stall_s if a single step takes that long"
            )
