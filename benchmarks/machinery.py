# SPDX-License-Identifier: Apache-2.0
"""The asynchronous engine around environments and a policy that are made of time, measured a block at a time.

Each environment is a process of its own, as in a real run, and so are the service, the replay and the
trainer; what takes time in them is slept. So 64 environments are measured on two cores, as long as what is
not slept leaves cores idle: `blocks.Block.processors` says so.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.config.ranges import NonNegative, Positive, Range, Section
from accerl_lerobot.engines.config import LaunchConfig, RunConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.inference.worker import InferenceConfig
from accerl_lerobot.policies.config import Load
from accerl_lerobot.replay.buffer import ReplayConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from benchmarks.simulated_environment import LatencyConfig, read_trace
from benchmarks.throughput import Measured

EPISODE = 16
"""Decisions of an episode."""
MOST_BUSY = 0.6
"""Share of all cores above which the processors, and not what is slept, may be what is measured."""
CHUNK = 4


@dataclass(frozen=True, kw_only=True)
class MachineryConfig(Section):
    """Sizes and durations of what is simulated."""

    environments: Annotated[int, Range("[1, 1000]")] = 64
    """Environments, each a process."""
    latency_ms: Positive = 200.0
    """Mean time an environment takes from a decision to its next observation, in milliseconds."""
    latency_cv: Annotated[float, Range("[0, 10]")] = 0.5
    """Standard deviation of that over its mean, lognormal; 0: always the mean."""
    latency_trace: str | None = None
    """File of the benchmark `latency`, for its law in place of the lognormal one; scaled to `latency_ms`."""
    image_size: Annotated[int, Range("[8, 480]")] = 64
    """Height and width of the one image of an observation; 317 makes it 301 KB."""
    segment_length: Annotated[int, Range("[1, 10000]")] = 4
    """Decisions of a segment; 16 is a multiple of it."""
    decide_ms: NonNegative = 8.0
    """a of t(B) = a + bB, the time of a forward pass for B observations, in milliseconds."""
    decide_each_ms: NonNegative = 0.1
    """b of it."""
    max_batch: Annotated[int, Range("[1, 65536]")] = 64
    """Largest B."""
    max_wait_ms: Annotated[float, Range("[0, 10000)")] = 2.0
    """How long the oldest request waits for others, in milliseconds."""
    update_ms: NonNegative = 800.0
    """Time of an update, in milliseconds; it learns from one segment of each environment."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if EPISODE % self.segment_length:
            raise InputError("segment_length", self.segment_length, f"use a divisor of {EPISODE}")

    @property
    def cv(self) -> float:
        """Standard deviation of the environments' latency over its mean."""
        if self.latency_trace is None:
            return self.latency_cv
        return float(read_trace(self.latency_trace).decisions.std())

    @property
    def batch(self) -> int:
        """Decisions an update learns from."""
        return self.environments * self.segment_length

    @property
    def world_bound(self) -> float:
        """Decisions a second that the environments cannot exceed: an episode costs them a reset as well,
        which
        takes as long as a decision, or what resets take in `latency_trace`."""
        resets = np.ones(1) if self.latency_trace is None else read_trace(self.latency_trace).resets
        reset = float(resets.mean()) if len(resets) else 1.0
        cycle = self.latency_ms * (1 + reset / EPISODE) + self.decide_ms + self.decide_each_ms
        return 1000 * self.environments / cycle

    @property
    def service_bound(self) -> float:
        """Decisions a second that the service cannot exceed."""
        largest = min(self.max_batch, self.environments)
        service = self.decide_ms + self.decide_each_ms * largest
        return 1000 * largest / service if service else float("inf")

    @property
    def trainer_bound(self) -> float:
        """Decisions a second that the trainer cannot exceed."""
        return 1000 * self.batch / self.update_ms if self.update_ms else float("inf")

    @property
    def bound(self) -> float:
        """Decisions a second that no schedule can exceed."""
        return min(self.world_bound, self.service_bound, self.trainer_bound)

    def run_config(self, *, updates: int = 1_000_000, seed: int = 0) -> RunConfig:
        """A run of it."""
        batch, trace = self.batch, self.latency_trace
        return RunConfig(
            seed=seed,
            env=LatencyConfig(
                max_steps=EPISODE * CHUNK,
                reward="dense",
                image_size=self.image_size,
                frame_ms=self.latency_ms,
                latency_cv=self.latency_cv,
                latency_trace=trace and str(Path(trace).expanduser().resolve()),  # workers run elsewhere
            ),
            rollout=RolloutConfig(
                workers=self.environments, environments=1, segment_length=self.segment_length
            ),
            inference=InferenceConfig(max_batch=self.max_batch, max_wait_s=self.max_wait_ms / 1000),
            replay=ReplayConfig(
                capacity=8 * batch,
                min_decisions=batch,
                max_unlearned_decisions=2 * batch,
                samples_per_insert=1.0,
            ),
            trainer=TrainerConfig(
                updates=updates,
                batch_decisions=batch,
                micro_batch=2 * batch,
                lr=0.05,
                value_lr=0.02,
                warmup_updates=5,
                value_warmup_updates=2,
                probe_every=0,
            ),
            launch=LaunchConfig(stall_s=120.0),
        )

    def open(self) -> Measured:
        """An engine of it, which has begun to train."""
        if self.latency_trace is not None:
            read_trace(self.latency_trace)
        return Measured(self.run_config(), ("match",), load=self.load())

    def load(self) -> Load:
        """Its policy, for `RayEngine`."""
        from benchmarks.simulated_policy import SimulatedPolicyConfig, load_simulated

        policy = SimulatedPolicyConfig(
            decide_ms=self.decide_ms,
            decide_each_ms=self.decide_each_ms,
            update_ms=self.update_ms,
            chunk=CHUNK,
        )
        return functools.partial(load_simulated, policy)
